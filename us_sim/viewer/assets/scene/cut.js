/** The cut: what lies between the image's plane and the eye is left out, so that it can be seen. */

import { THREE } from "nicegui-scene";
import { events } from "../events.js";
import { stage } from "./stage.js";

/** m before the plane that stays: so structures show their outlines on the image. */
const MARGIN = 6e-4;

const across = new THREE.Vector3();
const toEye = new THREE.Vector3();
let frame = null;
let isOn = false;

/** Normal (3) and distance (m): beyond it is what is left out. */
export const cutPlane = new THREE.Vector4(0, 0, 0, 1);
/** The same for materials of three.js, whose planes face what stays. */
export const clippingPlane = new THREE.Plane(new THREE.Vector3(0, 0, 1), 1e3);

stage.beforeDrawing(() => {
  if (!isOn || !frame?.visible) {
    cutPlane.set(0, 0, 0, 1);
    clippingPlane.set(across.set(0, 0, 1), 1e3);
    return;
  }
  across.set(0, 1, 0).applyQuaternion(frame.quaternion);
  toEye.subVectors(stage.camera.position, frame.position);
  if (across.dot(toEye) < 0) across.negate();
  const distance = across.dot(frame.position) + MARGIN;
  cutPlane.set(across.x, across.y, across.z, distance);
  clippingPlane.set(across.negate(), distance);
});

export const cut = {
  get isOn() {
    return isOn;
  },

  /** The group in whose plane y = 0 the image lies. */
  follow(group) {
    frame = group;
  },

  /** Cut, or show all. */
  set(on) {
    isOn = on;
    events.tell("scene-cut", on);
    stage.move();
  },
};
