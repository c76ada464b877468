/**
 * The transducer where the tracker has it, with the image on its plane and the force it feels.
 *
 * Its shape and the outline of its image come with `probe_mesh`, in frame `probe`.
 */

import { THREE } from "nicegui-scene";
import { events } from "../events.js";
import { imageCanvas, isOfOtherScene, onImage } from "../image.js";
import { stream } from "../stream.js";
import { cut } from "./cut.js";
import { softMaterial, styleOf } from "./shading.js";
import { PacketReader, geometryOf, sumNormals } from "./surface_geometry.js";
import { stage } from "./stage.js";

/** m or rad that a probe has to move to be seen to. */
const VISIBLE = 2e-5;
/** m of arrow for each newton, and the longest. */
const METRES_PER_NEWTON = 0.003;
const LONGEST = 0.06;
const LEAST_NEWTON = 0.05;
const FORCE_COLOUR = "#f2b14c";
const TICK_MM = 10;

const frame = new THREE.Group();
frame.name = "probe";
frame.visible = false;
stage.scene.add(frame);
cut.follow(frame);
const body = new THREE.Group();
frame.add(body);

// The image on its plane.
const texture = new THREE.CanvasTexture(imageCanvas());
texture.generateMipmaps = false;
texture.minFilter = texture.magFilter = THREE.LinearFilter;
texture.colorSpace = THREE.NoColorSpace;
const imageMaterial = new THREE.ShaderMaterial({
  vertexShader: `varying vec2 at;
    void main() { at = uv; gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0); }`,
  fragmentShader: `uniform sampler2D image; uniform float opacity; varying vec2 at;
    void main() { gl_FragColor = vec4(texture2D(image, at).rgb * 1.08 + 0.02, opacity); }`,
  uniforms: { image: { value: texture }, opacity: { value: 1 } },
  side: THREE.DoubleSide,
});
const image = new THREE.Mesh(new THREE.BufferGeometry(), imageMaterial);
image.name = "image";
image.renderOrder = 2;
const border = new THREE.LineSegments(
  new THREE.BufferGeometry(),
  new THREE.LineBasicMaterial({ color: "#4fb3bf" }),
);
border.renderOrder = 3;
frame.add(image, border);

// The force, drawn over the housing in which it would be hidden.
const force = new THREE.Group();
const overAll = new THREE.MeshBasicMaterial({ color: FORCE_COLOUR, depthTest: false });
const shaft = new THREE.Mesh(new THREE.CylinderGeometry(0.0009, 0.0009, 1, 10), overAll);
const head = new THREE.Mesh(new THREE.ConeGeometry(0.0027, 0.008, 14), overAll);
force.add(shaft, head);
force.renderOrder = shaft.renderOrder = head.renderOrder = 9;
force.visible = false;
frame.add(force);
const label = document.createElement("div");
label.className = "us-force";
label.title = "Force of the tissue on the probe";
label.hidden = true;
stage.place.append(label);

let outline = null; // Float32Array of points: along the face, then back at the image's end
let geometry = null; // 16 numbers, row by row: column, row, 0, 1 to m
let size = [0, 0]; // columns and rows of the image
let last = null; // the newest packet's header
let told = ""; // the force in words
let onPlane = []; // bytes of the image on the plane
const shown = { probe: true, image: true, force: true };
const up = new THREE.Vector3(0, 1, 0);
const before = new THREE.Matrix4();

stream.on("probe_mesh", (header, payload) => {
  const reader = new PacketReader(payload);
  for (const part of body.children) part.geometry.dispose();
  body.clear();
  for (const { name, colour, vertices, triangles } of header.parts) {
    const made = geometryOf(reader.floats(3 * vertices), reader.indices(3 * triangles));
    const { position, normal } = made.attributes;
    sumNormals(position.array, made.index.array, normal.array);
    const part = new THREE.Mesh(made, softMaterial(styleOf(colour), { gloss: 0.25 }));
    part.name = name;
    body.add(part);
  }
  outline = header.outline ? reader.floats(3 * header.outline) : null;
  layOut();
});

/** The image's plane: what beams reach, to the depth that the image has now. */
function layOut() {
  const { width, height } = imageCanvas();
  size = [width, height];
  if (!geometry || !outline) return;
  const toPixel = new THREE.Matrix4().fromArray(geometry).transpose().invert();
  const end = geometry[9] * (height - 0.5) + geometry[11]; // m, of the last row's lower edge
  const count = outline.length / 6;
  const middle = new THREE.Vector3();
  const far = (k) => middle.fromArray(outline, 3 * (2 * count - 1 - k));
  let depth = 0; // of the outline as it came
  for (let k = 0; k < count; k++) depth = Math.max(depth, far(k).z);
  const near = new THREE.Vector3().fromArray(outline, 3 * Math.floor(count / 2));
  const stretch = (end - near.z) / (depth - near.z);
  const points = [];
  for (let k = 0; k < count; k++) {
    const start = new THREE.Vector3().fromArray(outline, 3 * k);
    points.push(start, start.clone().lerp(far(k), stretch));
  }
  const positions = points.flatMap((point) => point.toArray());
  const uvs = points.flatMap((point) => {
    const { x, y } = point.clone().applyMatrix4(toPixel);
    return [(x + 0.5) / width, 1 - (y + 0.5) / height];
  });
  const index = [];
  for (let k = 0; k < count - 1; k++) {
    index.push(2 * k, 2 * k + 1, 2 * k + 2, 2 * k + 2, 2 * k + 1, 2 * k + 3);
  }
  image.geometry.dispose();
  image.geometry = new THREE.BufferGeometry()
    .setAttribute("position", new THREE.Float32BufferAttribute(positions, 3))
    .setAttribute("uv", new THREE.Float32BufferAttribute(uvs, 2))
    .setIndex(index);
  border.geometry.dispose();
  border.geometry = new THREE.BufferGeometry().setFromPoints(lined(points, count));
  texture.dispose(); // its size may be another
  texture.needsUpdate = true;
  stage.move();
}

/** The outline as pairs of points, with ticks of depth on its right. */
function lined(points, count) {
  const pairs = [points[0], points[1], points[2 * count - 2], points[2 * count - 1]];
  for (let k = 0; k < count - 1; k++) {
    pairs.push(points[2 * k], points[2 * k + 2], points[2 * k + 1], points[2 * k + 3]);
  }
  const [start, end] = points.slice(-2);
  const long = start.distanceTo(end);
  const tick = new THREE.Vector3(0.002, 0, 0);
  for (let at = TICK_MM / 1000; at < long - 1e-6; at += TICK_MM / 1000) {
    const point = start.clone().lerp(end, at / long);
    pairs.push(point, point.clone().add(tick));
  }
  return pairs;
}

stream.on("probe", (header) => {
  last = header;
  frame.position.fromArray(header.position);
  frame.quaternion.fromArray(header.quaternion);
  frame.updateMatrix();
  const is = frame.matrix.elements;
  const moved = is.some((value, i) => Math.abs(value - before.elements[i]) > VISIBLE);
  const wasVisible = frame.visible;
  frame.visible = true;
  events.tell("probe-pose", header);
  const pushed = push(header.force);
  if (!moved && wasVisible && !pushed) return undefined;
  before.copy(frame.matrix);
  return stage.move();
});

/** The arrow of a force [x, y, z] N in frame `probe`, or of none; whether it looks otherwise. */
function push(newton) {
  const size = newton ? Math.hypot(...newton) : 0;
  const text = `${size.toFixed(1)} N`;
  force.visible = shown.force && size > LEAST_NEWTON;
  if (told === text) return false;
  told = text;
  if (size <= LEAST_NEWTON) return true;
  const direction = new THREE.Vector3(...newton).divideScalar(size);
  const length = Math.min(LONGEST, 0.012 + METRES_PER_NEWTON * size);
  force.quaternion.setFromUnitVectors(up, direction);
  shaft.scale.y = length - 0.008;
  shaft.position.y = (length - 0.008) / 2;
  head.position.y = length - 0.004;
  return true;
}

stage.afterDrawing(() => {
  label.hidden = !(force.visible && frame.visible);
  if (label.hidden) return;
  if (label.textContent !== told) label.textContent = told;
  const tip = head.getWorldPosition(new THREE.Vector3());
  const { x, y } = stage.project(tip);
  label.style.transform = `translate(${x.toFixed(0)}px, ${y.toFixed(0)}px)`;
});

events.on("image-geometry", (matrix) => {
  geometry = matrix;
  layOut();
});
/** Whether the image is seen on its plane: never one of another scene than the patient's. */
function showPlane() {
  const on = shown.image && !isOfOtherScene();
  if (image.visible === on) return;
  image.visible = border.visible = on;
  texture.needsUpdate = true;
  stage.move();
}
for (const name of ["scene", "image-shown"]) events.on(name, showPlane);
onImage(({ payload }) => {
  const { width, height } = imageCanvas();
  if (width !== size[0] || height !== size[1]) layOut();
  // A probe at rest sends the same image again and again.
  if (!image.visible || !frame.visible || isSame(payload, onPlane)) return;
  onPlane = payload;
  texture.needsUpdate = true;
  stage.refresh();
});

function isSame(bytes, others) {
  return bytes.length === others.length && bytes.every((byte, i) => byte === others[i]);
}

for (const kind of ["probe_mesh", "probe"]) stream.watch(kind);

export const probe = {
  frame,
  body,
  image,

  /** The newest {position, quaternion, stamp, force, torque, force_stamp, force_age}, or null; s. */
  get pose() {
    return last;
  },

  /** Whether the force is shown where there is one. */
  get isForceShown() {
    return shown.force;
  },

  /** Mark the force as older than the image, or no longer. */
  markForce(on) {
    label.classList.toggle("us-old", on);
  },

  /** Show or hide "probe", "image" or "force". */
  setVisible(name, on) {
    shown[name] = on;
    if (name === "probe") body.visible = on;
    if (name === "image") showPlane();
    if (name === "force") force.visible = on && Boolean(last?.force);
    stage.move();
  },

  /** Of the image on its plane, 0 to 1. */
  setImageOpacity(value) {
    imageMaterial.uniforms.opacity.value = value;
    imageMaterial.transparent = value < 0.995;
    imageMaterial.needsUpdate = true;
    stage.move();
  },
};
