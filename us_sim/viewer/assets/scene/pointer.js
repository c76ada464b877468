/** What is under the pointer, and who takes a drag: the hand, the gizmo, or else the camera. */

import { THREE } from "nicegui-scene";
import { probe } from "./probe.js";
import { skin } from "./skin.js";
import { stage } from "./stage.js";
import { tissue } from "./tissue.js";

const caster = new THREE.Raycaster();
const handlers = [];
const fingers = new Set();
let taker = null;

/** The ray through the pointer. */
export function rayOf(event) {
  const box = stage.canvas.getBoundingClientRect();
  const x = (2 * (event.clientX - box.left)) / box.width - 1;
  const y = 1 - (2 * (event.clientY - box.top)) / box.height;
  stage.camera.updateMatrixWorld(); // it may have moved since it was drawn
  caster.setFromCamera(new THREE.Vector2(x, y), stage.camera);
  return caster.ray;
}

/**
 * The nearest thing under the pointer: {point: [x, y, z] m in `patient`, normal: unit, out of the
 * body, object: "skin", "tissue" or "probe"}, or null. `onBody`: the probe is looked through.
 */
export function pick(event, { onBody = false } = {}) {
  rayOf(event);
  const found = [];
  if (!onBody && probe.frame.visible && probe.body.visible) {
    probe.body.updateWorldMatrix(true, true);
    for (const hit of caster.intersectObject(probe.body, true)) found.push({ ...hit, name: "probe" });
  }
  const sheet = skin.mesh.geometry.attributes.position ? skin : tissue;
  const mesh = sheet === skin ? skin.mesh : tissue.surface;
  if (mesh.geometry.attributes.position) {
    mesh.geometry.computeBoundingSphere();
    for (const hit of caster.intersectObject(mesh, false)) {
      found.push({ ...hit, name: sheet === skin ? "skin" : "tissue" });
    }
  }
  found.sort((a, b) => a.distance - b.distance);
  const [first] = found;
  if (!first) return null;
  const normal = first.face.normal.clone().transformDirection(first.object.matrixWorld);
  return { point: first.point.toArray(), normal: normal.toArray(), object: first.name };
}

/**
 * Have `handler(event, hit) -> boolean` asked first, before the camera; what it takes by true is
 * its own until the pointer is up, and any other finger that came down since: it is given that
 * one's events, too. Those that came first are asked first.
 */
export function onPointer(handler) {
  handlers.push(handler);
}

function offer(event, hit) {
  return handlers.find((handle) => handle(event, hit));
}

stage.canvas.addEventListener(
  "pointerdown",
  (event) => {
    stage.canvas.focus({ preventScroll: true });
    if (taker) taker(event, null);
    else taker = offer(event, pick(event)) ?? null;
    if (!taker) return;
    event.stopImmediatePropagation();
    fingers.add(event.pointerId);
    stage.canvas.setPointerCapture(event.pointerId);
  },
  { capture: true },
);
for (const name of ["pointermove", "pointerup", "pointercancel"]) {
  stage.canvas.addEventListener(
    name,
    (event) => {
      if (!taker) return;
      event.stopImmediatePropagation();
      taker(event, pick(event, { onBody: true }));
      if (name === "pointermove") return;
      fingers.delete(event.pointerId);
      if (!fingers.size) taker = null;
    },
    { capture: true },
  );
}
for (const name of ["wheel", "dblclick"]) {
  stage.canvas.addEventListener(
    name,
    (event) => {
      if (!offer(event, pick(event))) return;
      event.stopImmediatePropagation();
      event.preventDefault();
    },
    { capture: true, passive: false },
  );
}
