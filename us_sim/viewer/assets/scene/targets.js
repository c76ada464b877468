/**
 * Where an exercise is to be done: dots on the skin.
 *
 * Dots stand on the skin above the points that are told, and move with it. Points bear the number
 * with which the text of their step begins.
 */

import { THREE } from "nicegui-scene";
import { events } from "../events.js";
import { exercise } from "../exercise.js";
import { probe } from "./probe.js";
import { skin } from "./skin.js";
import { stage } from "./stage.js";

/** By states of steps. */
const COLOURS = { done: "#5fd38a", missed: "#e5735c", next: "#4fa8ff", "to do": "#e8eef2" };
/** m: radius of a point, and of the dots of a line. */
const POINT = 0.0022;
const DOT = 0.0008;
const MOST = 2000;

const group = new THREE.Group();
group.name = "targets";
const dots = new THREE.InstancedMesh(
  new THREE.SphereGeometry(1, 16, 12),
  new THREE.MeshBasicMaterial({ transparent: true }), // over the skin
  MOST,
);
dots.frustumCulled = false;
dots.renderOrder = 8;
group.add(dots);
stage.scene.add(group);

let steps = []; // {step, dots: [{point, vertex, aside, radius}], number}
let isOn = true;
let boundTo; // the skin on which the dots stand
let shown = ""; // all of it that is shown

function take() {
  const told = exercise.steps.map(({ what, state, target }) => [what, state, target]);
  const text = JSON.stringify(told);
  if (text === shown) return;
  shown = text;
  for (const { number } of steps) number?.remove();
  steps = exercise.steps.map((step) => {
    const { what, target = [] } = step;
    const radius = target.length > 1 ? DOT : POINT;
    const dots = target.map((at) => ({ point: new THREE.Vector3(...at), radius }));
    const [, name] = (dots.length === 1 && /^(?:point )?(\d+)(?:: |$)/.exec(what)) || [];
    return { step, dots, number: name && label(name) };
  });
  boundTo = undefined;
  stage.move();
}
events.on("exercise", take);
events.on("scene", take);

const caster = new THREE.Raycaster();

/** Whether the probe's body is seen in place of a point. */
function isBehindProbe(at) {
  if (!probe.frame.visible || !probe.body.visible) return false;
  const way = at.clone().sub(stage.camera.position);
  caster.set(stage.camera.position, way.clone().normalize());
  const hits = caster.intersectObject(probe.body, true);
  return hits.some(({ distance }) => distance < way.length());
}

/** A number beside a point, over the scene. */
function label(textContent) {
  const made = Object.assign(document.createElement("div"), { className: "us-number", textContent });
  stage.place.append(made);
  return made;
}

/** Find the vertex of the skin at rest nearest to each point, and how far beside it the point is. */
function bind(points) {
  boundTo = points;
  if (!points) return;
  const { rest } = points;
  for (const dot of steps.flatMap(({ dots }) => dots)) {
    let best = Infinity;
    for (let i = 0; i < rest.length; i += 3) {
      const far = Math.hypot(rest[i] - dot.point.x, rest[i + 1] - dot.point.y, rest[i + 2] - dot.point.z);
      if (far < best) [best, dot.vertex] = [far, i];
    }
    dot.aside = dot.point.clone().sub(new THREE.Vector3().fromArray(rest, dot.vertex)).setZ(0);
  }
}

stage.beforeDrawing(() => {
  group.visible = isOn && steps.length > 0;
  if (!group.visible) return;
  const points = skin.points;
  if (points !== boundTo) bind(points);
  const { next } = exercise;
  const place = new THREE.Matrix4();
  dots.count = 0;
  for (const { step, dots: those } of steps) {
    const colour = new THREE.Color(COLOURS[step === next ? "next" : step.state]);
    for (const dot of those) {
      if (dots.count === MOST) break;
      const { point, vertex, aside, radius } = dot;
      dot.at = points ? new THREE.Vector3().fromArray(points.positions, vertex).add(aside) : point;
      place.makeScale(radius, radius, radius).setPosition(dot.at);
      dots.setMatrixAt(dots.count, place);
      dots.setColorAt(dots.count, colour);
      dots.count += 1;
    }
  }
  dots.instanceMatrix.needsUpdate = true;
  if (dots.instanceColor) dots.instanceColor.needsUpdate = true;
});

stage.afterDrawing(() => {
  for (const { dots: [dot], number } of steps) {
    if (!number) continue;
    number.hidden = !group.visible || !dot.at || isBehindProbe(dot.at);
    if (number.hidden) continue;
    const { x, y } = stage.project(dot.at);
    number.style.transform = `translate(${x.toFixed(0)}px, ${y.toFixed(0)}px)`;
  }
});

export const targets = {
  group,

  /** Show or hide them. */
  setVisible(on) {
    isOn = on;
    stage.move();
  },
};
