/**
 * Where an exercise is to be done: dots on the skin.
 *
 * Dots stand on the skin above the points that are told, and move with it. A point bears, as large
 * as can be read, the number with which the text of its step begins; behind the probe the number is
 * seen through it. A click on it is told as "target", with its place.
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
/** Part of a triangle by which a point on its edge may seem beside it. */
const EDGE = 1e-6;
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
const numbers = Object.assign(document.createElement("div"), { className: "us-numbers" });
stage.canvas.after(numbers);

let steps = []; // {state, dots: [{point, corners, weights, radius}], number}, as exercise.steps
let isOn = true;
let boundTo; // the skin on which the dots stand
let shown = ""; // all of it that is shown

function take() {
  const told = exercise.steps.map(({ what, state, target }) => [what, state, target]);
  const text = JSON.stringify(told);
  if (text === shown) return;
  shown = text;
  for (const { number } of steps) number?.remove();
  steps = exercise.steps.map(({ what, state, target = [] }) => {
    const radius = target.length > 1 ? DOT : POINT;
    const dots = target.map((at) => ({ point: new THREE.Vector3(...at), radius }));
    const [, name] = (dots.length === 1 && /^(?:point )?(\d+)(?:: |$)/.exec(what)) || [];
    return { state, dots, number: name && label(name, dots[0]) };
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

/** A number in place of a dot, over the scene. */
function label(textContent, dot) {
  const made = Object.assign(document.createElement("div"), { className: "us-number", textContent });
  made.hidden = true; // until it is drawn in its place
  made.onclick = () => events.tell("target", dot.at.toArray());
  numbers.append(made);
  return made;
}

/** Find the triangle of the skin at rest above each point, and the weights of its corners there. */
function bind(points) {
  boundTo = points;
  if (!points) return;
  const { rest, triangles } = points;
  for (const dot of steps.flatMap(({ dots }) => dots)) {
    const { x, y } = dot.point;
    let top = Infinity;
    dot.corners = undefined;
    for (let t = 0; t < triangles.length; t += 3) {
      const i = 3 * triangles[t];
      const j = 3 * triangles[t + 1];
      const k = 3 * triangles[t + 2];
      const ax = rest[j] - rest[i];
      const ay = rest[j + 1] - rest[i + 1];
      const bx = rest[k] - rest[i];
      const by = rest[k + 1] - rest[i + 1];
      const area = ax * by - ay * bx;
      const v = ((x - rest[i]) * by - (y - rest[i + 1]) * bx) / area;
      const w = (ax * (y - rest[i + 1]) - ay * (x - rest[i])) / area;
      if (!(v >= -EDGE && w >= -EDGE && v + w <= 1 + EDGE)) continue; // beside, or upright
      const z = (1 - v - w) * rest[i + 2] + v * rest[j + 2] + w * rest[k + 2];
      if (z < top) [top, dot.corners, dot.weights] = [z, [i, j, k], [1 - v - w, v, w]];
    }
  }
}

/** Where a dot stands now, m. */
function placeOf({ point, corners, weights }, points) {
  const place = new THREE.Vector3();
  if (!points || !corners) return place.copy(point);
  const corner = new THREE.Vector3();
  for (const [n, at] of corners.entries()) {
    place.addScaledVector(corner.fromArray(points.positions, at), weights[n]);
  }
  return place;
}

stage.beforeDrawing(() => {
  group.visible = isOn && steps.length > 0;
  if (!group.visible) return;
  const points = skin.points;
  if (points !== boundTo) bind(points);
  const next = exercise.steps.indexOf(exercise.next);
  const place = new THREE.Matrix4();
  dots.count = 0;
  for (const [i, { state, dots: those, number }] of steps.entries()) {
    const style = COLOURS[i === next ? "next" : state];
    const colour = new THREE.Color(style);
    if (number) number.style.background = style;
    for (const dot of those) {
      if (dots.count === MOST) break;
      dot.at = placeOf(dot, points);
      place.makeScale(dot.radius, dot.radius, dot.radius).setPosition(dot.at);
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
    number.hidden = !group.visible || !dot.at;
    if (number.hidden) continue;
    number.classList.toggle("us-behind", isBehindProbe(dot.at));
    const { x, y } = stage.project(dot.at);
    number.style.transform = `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px)`;
    number.style.zIndex = Math.round(-1e4 * stage.camera.position.distanceTo(dot.at));
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
