/** What says how large things are, and which way: a bar in mm, and the axes of `patient`. */

import { THREE } from "nicegui-scene";
import { stage } from "./stage.js";

const LENGTHS_MM = [1, 2, 5, 10, 20, 50, 100, 200];
const WIDEST = 110; // CSS pixels
const ARM = 22;
const AXES = [
  ["x", "#e0625a", new THREE.Vector3(1, 0, 0)],
  ["y", "#67b26f", new THREE.Vector3(0, 1, 0)],
  ["z", "#5a8fe0", new THREE.Vector3(0, 0, 1)],
];
const SVG = "http://www.w3.org/2000/svg";

const bar = document.createElement("div");
bar.className = "us-scale-bar";
bar.title = "This long at the middle of the view";
const text = document.createElement("span");
const line = document.createElement("i");
bar.append(text, line);

const axes = document.createElementNS(SVG, "svg");
axes.setAttribute("class", "us-axes");
axes.setAttribute("viewBox", "-34 -34 68 68");
const tip = document.createElementNS(SVG, "title");
tip.textContent = "Axes of the patient: z goes into the body";
axes.append(tip);
const drawn = AXES.map(([name, colour]) => {
  const arm = document.createElementNS(SVG, "line");
  const letter = document.createElementNS(SVG, "text");
  arm.setAttribute("stroke", colour);
  letter.setAttribute("fill", colour);
  letter.textContent = name;
  axes.append(arm, letter);
  return { arm, letter };
});
stage.place.append(bar, axes);

const last = new THREE.Matrix4();
let lastHeight = 0;

stage.afterDrawing(() => {
  const { camera, controls, place } = stage;
  // What the page lays out anew costs more than the scene: only when the view has changed.
  if (last.equals(camera.matrixWorld) && lastHeight === place.clientHeight) return;
  last.copy(camera.matrixWorld);
  lastHeight = place.clientHeight;
  const distance = camera.position.distanceTo(controls.target);
  const height = 2 * distance * Math.tan(THREE.MathUtils.degToRad(camera.fov / 2));
  const pixels = place.clientHeight / (1000 * height); // for each mm
  const length = LENGTHS_MM.findLast((mm) => mm * pixels <= WIDEST) ?? LENGTHS_MM[0];
  text.textContent = `${length} mm`;
  line.style.width = `${(length * pixels).toFixed(1)}px`;
  const back = camera.quaternion.clone().invert();
  AXES.forEach(([, , direction], i) => {
    const { x, y, z } = direction.clone().applyQuaternion(back);
    const { arm, letter } = drawn[i];
    arm.setAttribute("x2", (ARM * x).toFixed(1));
    arm.setAttribute("y2", (-ARM * y).toFixed(1));
    arm.setAttribute("opacity", z < -0.1 ? 0.45 : 1);
    letter.setAttribute("x", ((ARM + 8) * x).toFixed(1));
    letter.setAttribute("y", (-(ARM + 8) * y).toFixed(1));
  });
});
