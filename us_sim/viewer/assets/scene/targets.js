/**
 * Where an exercise is to be done: dots on the skin, and the plane of a view that is to be found.
 *
 * Dots stand on the skin above the points that are told, and move with it. Of what is not done, the
 * nearest to the probe is next.
 */

import { THREE } from "nicegui-scene";
import { events } from "../events.js";
import { isOfOtherScene } from "../image.js";
import { stream } from "../stream.js";
import { probe } from "./probe.js";
import { skin } from "./skin.js";
import { stage } from "./stage.js";

/** By states of steps. */
const COLOURS = { done: "#5fd38a", missed: "#e5735c", next: "#f2b14c", "to do": "#e8eef2" };
/** m: radius of a point, and of the dots of a line. */
const POINT = 0.0022;
const DOT = 0.0008;
const MOST = 2000;

const group = new THREE.Group();
group.name = "targets";
const dots = new THREE.InstancedMesh(
  new THREE.SphereGeometry(1, 16, 12),
  new THREE.MeshBasicMaterial({ depthTest: false, transparent: true }), // over the probe
  MOST,
);
dots.frustumCulled = false;
dots.renderOrder = 8;
const plane = new THREE.Mesh(
  new THREE.BufferGeometry(),
  new THREE.MeshBasicMaterial({
    transparent: true,
    opacity: 0.4,
    side: THREE.DoubleSide,
    depthWrite: false,
  }),
);
plane.name = "wanted view";
plane.renderOrder = 4;
group.add(dots, plane);
stage.scene.add(group);

let steps = []; // {state, dots: [{point, vertex, aside, radius}], pose}
let scene = "";
let isOn = true;
let boundTo; // the skin on which the dots stand
let told = ""; // all of it that is shown

stream.on("score", (header) => {
  const shown = header.steps.map(({ state, target = [], pose }) => ({ state, target, pose }));
  const text = JSON.stringify([header.scene, shown]);
  if (text === told) return;
  told = text;
  scene = header.scene;
  steps = shown.map(({ state, target, pose }) => {
    const radius = target.length > 1 ? DOT : POINT;
    return { state, pose, dots: target.map((at) => ({ point: new THREE.Vector3(...at), radius })) };
  });
  boundTo = undefined;
  stage.move();
});
stream.watch("score");
events.on("scene", () => stage.move());

/** Find the vertex of the skin at rest nearest to each point, and how far beside it the point is. */
function bind(points) {
  boundTo = points;
  if (!points) return;
  const { rest } = points;
  for (const dot of steps.flatMap((step) => step.dots)) {
    let best = Infinity;
    for (let i = 0; i < rest.length; i += 3) {
      const far = Math.hypot(rest[i] - dot.point.x, rest[i + 1] - dot.point.y, rest[i + 2] - dot.point.z);
      if (far < best) [best, dot.vertex] = [far, i];
    }
    dot.aside = dot.point.clone().sub(new THREE.Vector3().fromArray(rest, dot.vertex)).setZ(0);
  }
}

/** The step that is next: of those that are not done, the nearest to the probe. */
function nextOf(left) {
  const at = new THREE.Vector3(...(probe.pose?.position ?? [0, 0, 0]));
  const far = ({ dots, pose }) => {
    const places = pose ? [new THREE.Vector3(...pose)] : dots.map(({ point }) => point);
    return Math.min(...places.map((place) => place.distanceTo(at)));
  };
  return left.reduce((best, step) => (best && far(best) <= far(step) ? best : step), null);
}

stage.beforeDrawing(() => {
  group.visible = isOn && steps.length > 0 && !isOfOtherScene(scene);
  if (!group.visible) return;
  const points = skin.points;
  if (points !== boundTo) bind(points);
  const next = nextOf(steps.filter(({ state }) => state !== "done"));
  const place = new THREE.Matrix4();
  const at = new THREE.Vector3();
  dots.count = 0;
  plane.visible = false;
  for (const step of steps) {
    const colour = new THREE.Color(COLOURS[step === next ? "next" : step.state]);
    for (const { point, vertex, aside, radius } of step.dots) {
      if (dots.count === MOST) break;
      if (points) at.fromArray(points.positions, vertex).add(aside);
      else at.copy(point);
      place.makeScale(radius, radius, radius).setPosition(at);
      dots.setMatrixAt(dots.count, place);
      dots.setColorAt(dots.count, colour);
      dots.count += 1;
    }
    if (step.pose) {
      plane.visible = true;
      plane.geometry = probe.image.geometry;
      plane.position.fromArray(step.pose);
      plane.quaternion.fromArray(step.pose, 3);
      plane.material.color = colour;
    }
  }
  dots.instanceMatrix.needsUpdate = true;
  if (dots.instanceColor) dots.instanceColor.needsUpdate = true;
});

export const targets = {
  group,

  /** Show or hide them; while hidden they are not sent either. */
  setVisible(on) {
    isOn = on;
    stream.watch("score", on);
    stage.move();
  },
};
