/** Where one looks from: standard views, and all that there is to see. */

import { THREE } from "nicegui-scene";
import { isTyping } from "../hand/typing.js";
import { cut } from "./cut.js";
import { probe } from "./probe.js";
import { skin } from "./skin.js";
import { stage } from "./stage.js";
import { tissue } from "./tissue.js";

const TURN_MS = 260;
const BESIDE = 1.15;
/** m of the probe that are seen at least. */
const GRIP = 0.06;

/** By name: direction from which one looks, [x, y, z], in `patient` or in `probe`. */
const FROM = {
  start: [0.42, 0.78, -0.5],
  front: [0, 1, -0.08],
  side: [1, 0, -0.08],
  top: [0, 0.02, -1],
  probe: [0, 0.45, -1],
  image: [0, 1, 0],
};

export const VIEWS = [
  ["start", "Overview", "Slantwise, everything (key 0)"],
  ["front", "Front", "From the feet, as the image is seen (key 1)"],
  ["side", "Side", "From the side (key 2)"],
  ["top", "Top", "From above (key 3)"],
  ["probe", "Probe", "Along the probe (key 4)"],
  ["image", "Image", "Facing the image, and what is before it cut away (key 5)"],
];
const KEYS = { 1: "front", 2: "side", 3: "top", 4: "probe", 5: "image", 0: "start", 6: "fit" };

let turning = 0;
/** Whether the person has chosen where from to look. */
let isFitted = false;

/** Middle and radius (m) of what there is to see: the tissue, else the skin, the probe, its image. */
function extent() {
  const box = new THREE.Box3();
  const body = [tissue.surface, skin.mesh].find((mesh) => mesh.geometry.attributes.position);
  if (body) {
    body.geometry.computeBoundingBox();
    box.copy(body.geometry.boundingBox);
  }
  if (probe.frame.visible) {
    if (probe.image.geometry.attributes.position) box.expandByObject(probe.image);
    box.expandByPoint(probe.frame.position);
    box.expandByPoint(probe.frame.localToWorld(new THREE.Vector3(0, 0, -GRIP)));
  }
  if (box.isEmpty()) return { middle: new THREE.Vector3(0, 0, 0.01), radius: 0.09 };
  const size = box.getSize(new THREE.Vector3());
  return { middle: box.getCenter(new THREE.Vector3()), radius: 0.52 * size.length() };
}

function distanceFor(radius) {
  const { camera } = stage;
  const vertical = THREE.MathUtils.degToRad(camera.fov / 2);
  const half = Math.min(vertical, Math.atan(Math.tan(vertical) * camera.aspect));
  return radius / Math.sin(half);
}

/** Turn to a view by its name: start, front, side, top, probe, image or fit. */
export function view(name) {
  isFitted = true;
  look(name);
}

function look(name) {
  let { middle, radius } = extent();
  const direction = new THREE.Vector3();
  if (name === "fit") {
    direction.subVectors(stage.camera.position, stage.controls.target);
  } else if (name in FROM) {
    direction.fromArray(FROM[name]);
  } else {
    throw new Error(`there is no view ${name}; there are ${Object.keys(FROM).join(", ")}, fit`);
  }
  if ((name === "probe" || name === "image") && probe.frame.visible) {
    direction.applyQuaternion(probe.frame.quaternion);
    const sphere = probe.image.geometry.boundingSphere ?? null;
    if (name === "image" && probe.image.geometry.attributes.position) {
      if (!sphere) probe.image.geometry.computeBoundingSphere();
      const { center, radius: size } = probe.image.geometry.boundingSphere;
      middle = probe.frame.localToWorld(center.clone());
      radius = BESIDE * size;
      cut.set(true);
    }
  }
  turnTo(middle, direction.normalize().multiplyScalar(distanceFor(radius)).add(middle));
}

function turnTo(target, position) {
  const { camera, controls } = stage;
  const from = { target: controls.target.clone(), position: camera.position.clone() };
  const mine = ++turning;
  const begun = performance.now();
  const isCalm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const step = () => {
    if (mine !== turning) return;
    const part = isCalm ? 1 : Math.min(1, (performance.now() - begun) / TURN_MS);
    const eased = part * part * (3 - 2 * part);
    controls.target.lerpVectors(from.target, target, eased);
    // On an arc, not through the patient.
    const a = from.position.clone().sub(from.target);
    const b = position.clone().sub(target);
    const length = a.length() + (b.length() - a.length()) * eased;
    camera.position.lerpVectors(a, b, eased).setLength(length).add(controls.target);
    controls.update();
    stage.move();
    if (part < 1) requestAnimationFrame(step);
  };
  step();
}

stage.controls.addEventListener("start", () => {
  turning += 1;
  isFitted = true;
});

/** Look at everything once it has come, unless the person looks elsewhere already. */
let known = "";
stage.beforeDrawing(() => {
  const now = [skin.mesh, tissue.surface]
    .map(({ geometry }) => geometry.uuid)
    .concat(probe.frame.visible)
    .join();
  if (now === known || isFitted) return;
  known = now;
  setTimeout(() => isFitted || look("start"));
});

addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  if (isTyping(event)) return;
  const name = KEYS[event.key];
  if (!name) return;
  event.preventDefault();
  view(name);
});
