/** Arrows and rings at the probe's face, to move and turn it by, along its own axes. */

import { THREE } from "nicegui-scene";
import { probe } from "./probe.js";
import { onPointer, rayOf } from "./pointer.js";
import { stage } from "./stage.js";

const AXES = {
  x: { colour: "#e0625a", direction: new THREE.Vector3(1, 0, 0) },
  y: { colour: "#67b26f", direction: new THREE.Vector3(0, 1, 0) },
  z: { colour: "#5a8fe0", direction: new THREE.Vector3(0, 0, 1) },
};
/** m: how far arrows reach, and the rings' radius. */
const REACH = 0.04;
const RADIUS = 0.052;
const THICK = 0.0007;
/** How much thicker is what the pointer hits. */
const GRAB = 5;
/** m that rings count as farther away. */
const BEHIND = 10;

const gizmo = new THREE.Group();
gizmo.visible = false;
probe.frame.add(gizmo);
const handles = [];
let handler = null;
let drag = null;

for (const [axis, { colour, direction }] of Object.entries(AXES)) {
  const material = new THREE.MeshBasicMaterial({
    color: colour,
    depthTest: false,
    transparent: true,
    opacity: 0.85,
  });
  const turn = new THREE.Quaternion().setFromUnitVectors(new THREE.Vector3(0, 1, 0), direction);
  const arrow = (thick) => {
    const shaft = new THREE.CylinderGeometry(thick, thick, REACH, 8);
    return new THREE.Mesh(shaft.translate(0, REACH / 2, 0), material);
  };
  const shown = arrow(THICK);
  const tip = new THREE.Mesh(new THREE.ConeGeometry(4 * THICK, 10 * THICK, 12), material);
  tip.position.y = REACH;
  shown.add(tip);
  const ring = new THREE.Mesh(new THREE.TorusGeometry(RADIUS, THICK, 6, 48), material);
  const around = new THREE.Quaternion().setFromUnitVectors(new THREE.Vector3(0, 0, 1), direction);
  for (const [mode, mesh, quaternion] of [
    ["translate", shown, turn],
    ["rotate", ring, around],
  ]) {
    mesh.quaternion.copy(quaternion);
    mesh.renderOrder = tip.renderOrder = 10;
    const grab =
      mode === "translate"
        ? arrow(GRAB * THICK)
        : new THREE.Mesh(new THREE.TorusGeometry(RADIUS, GRAB * THICK, 6, 32), material);
    grab.quaternion.copy(quaternion);
    grab.visible = false;
    gizmo.add(mesh, grab);
    handles.push({ mode, axis, grab, material });
  }
}

/** The handle under the pointer: an arrow before rings, which are lines over it from some sides. */
function under(event) {
  const caster = new THREE.Raycaster();
  caster.ray.copy(rayOf(event));
  gizmo.updateWorldMatrix(true, true); // the probe may have moved since it was drawn
  let nearest = null;
  for (const handle of handles) {
    const [hit] = caster.intersectObject(handle.grab, false);
    if (!hit) continue;
    const distance = handle.mode === "translate" ? hit.distance : hit.distance + BEHIND;
    if (!nearest || distance < nearest.distance) nearest = { ...handle, distance };
  }
  return nearest;
}

/** How far along its axis (m), or around it (rad), the pointer is. */
function amountAt(event, { mode, origin, direction, side }) {
  const ray = rayOf(event);
  if (mode === "translate") {
    // The point of the axis that is nearest to the ray.
    const between = origin.clone().sub(ray.origin);
    const cosine = direction.dot(ray.direction);
    const slope = 1 - cosine * cosine;
    if (slope < 1e-4) return null;
    return (cosine * between.dot(ray.direction) - between.dot(direction)) / slope;
  }
  const plane = new THREE.Plane().setFromNormalAndCoplanarPoint(direction, origin);
  const at = ray.intersectPlane(plane, new THREE.Vector3());
  if (!at) return null;
  at.sub(origin);
  return Math.atan2(at.dot(direction.clone().cross(side)), at.dot(side));
}

onPointer((event, hit) => {
  if (event.type === "pointerdown") return drag !== null || begin(event, hit);
  if (!drag) return false;
  if (event.pointerId !== drag.pointerId) return true;
  if (event.type === "pointermove") {
    const now = amountAt(event, drag);
    if (now !== null) {
      let step = now - drag.last;
      if (drag.mode === "rotate") step = Math.atan2(Math.sin(step), Math.cos(step));
      drag.last = now;
      drag.amount += step;
      tell("move");
    }
  } else {
    tell("end");
    drag.material.opacity = 0.85;
    drag = null;
    stage.move();
  }
  return true;
});

function begin(event) {
  if (!gizmo.visible || !probe.frame.visible || event.button !== 0) return false;
  const handle = under(event);
  if (!handle) return false;
  const { quaternion } = probe.frame;
  const direction = AXES[handle.axis].direction.clone().applyQuaternion(quaternion);
  const side = AXES[handle.axis === "x" ? "y" : "x"].direction.clone().applyQuaternion(quaternion);
  const { pointerId } = event;
  drag = { ...handle, pointerId, origin: probe.frame.position.clone(), direction, side, amount: 0 };
  drag.last = amountAt(event, drag) ?? 0;
  drag.material.opacity = 1;
  tell("start");
  return true;
}

function tell(phase) {
  handler({ phase, mode: drag.mode, axis: drag.axis, amount: drag.amount });
}

/**
 * Show the gizmo and have `handle({phase, mode, axis, amount})` called, or hide it (null).
 *
 * `phase` is "start", "move" or "end"; `mode` "translate" or "rotate"; `amount` m or rad since the
 * start, along or about the probe's own axis `axis` as it was then.
 */
export function setGizmo(handle) {
  handler = handle;
  gizmo.visible = handle !== null;
  stage.move();
}
