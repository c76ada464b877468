/**
 * The ultrasound image on a canvas, with its depth scale.
 *
 * Pixels of the canvas `#ultrasound canvas.us-image` are those of the image. Where they are says the
 * image's `matrix`, 4 × 4, from (column, row, 0, 1) to metres in frame `probe`.
 *
 * A frame is an image with all that belongs to it, live or kept: {header, payload} as they came,
 * `time` (ms of `performance.now()`) when, `mode`, its name on the page, and `measures` on it.
 */

import { element, events } from "./events.js";
import { stream } from "./stream.js";

const isHere = ["localhost", "127.0.0.1", "[::1]"].includes(location.hostname);
/** Pixels as they are to this computer, JPEG to others. */
const KIND = isHere ? "image" : "image_jpeg";

const place = await element("ultrasound");
const canvas = Object.assign(document.createElement("canvas"), { className: "us-image" });
const scale = Object.assign(document.createElement("canvas"), { className: "us-scale" });
const waiting = Object.assign(document.createElement("p"), {
  className: "us-waiting",
  textContent: "Waiting for the first image …",
});
setTimeout(() => {
  waiting.textContent +=
    "\nThe first start after an installation takes some minutes: the program is compiled once.";
}, 15000); // a start whose kernels are all kept is over by then
const badge = Object.assign(document.createElement("p"), { className: "us-stale", hidden: true });
badge.setAttribute("role", "status");
/** On the side where the mark of the probe is: its -x. */
const mark = Object.assign(document.createElement("span"), { className: "us-mark", hidden: true });
mark.setAttribute("role", "img");
place.append(canvas, scale, mark, waiting, badge);
canvas.setAttribute("role", "img");
canvas.setAttribute("aria-label", "Ultrasound image");
const context = canvas.getContext("2d", { alpha: false, willReadFrequently: true });

const layers = [canvas];
let shownFrame = null;
/** The shown frame's matrix: 16 numbers, row by row, or null while they are not known. */
let geometry = null;
let grey = null; // ImageData that every grey image is put through
const handlers = [];

/** The canvas that holds the image, one canvas pixel an image pixel. */
export function imageCanvas() {
  return canvas;
}

/** Lay a canvas over the image, as large as that. */
export function addLayer(layer) {
  layers.at(-1).after(layer);
  layers.push(layer);
  drawScale();
}

/** Whether there is an image in it. */
export function hasImage() {
  return waiting.hidden;
}

/** The frame that is seen; null before the first. */
export function frameShown() {
  return shownFrame;
}

/** From (column, row), of a frame's pixels, to [lateral, axial] mm in frame `probe`; null if not known. */
export function pixelToMillimetres(column, row, matrix = geometry) {
  if (!matrix) return null;
  const at = (i) => 1000 * (matrix[i] * column + matrix[i + 1] * row + matrix[i + 3]);
  return [at(0), at(8)];
}

let scene = ""; // that runs; nothing where it is not known
const headline = await element("us-scene");

function lookAtScene() {
  scene = headline.dataset.scene ?? "";
  events.tell("scene", scene);
}
new MutationObserver(lookAtScene).observe(headline, { attributeFilter: ["data-scene"] });
lookAtScene();

/** Whether the frame that is seen, or what is of a scene, is of another one than runs. */
export function isOfOtherScene(of = shownFrame?.header.scene) {
  return Boolean(of && scene && of !== scene);
}

/** Have `handler(frame)` called when an image has come and was drawn. */
export function onImage(handler) {
  handlers.push(handler);
}

/** From a frame to what puts its pixels on a context of a canvas of its size, once. */
export async function painter({ header, payload }) {
  if (header.encoding !== "mono8") {
    const bitmap = await createImageBitmap(new Blob([payload], { type: "image/jpeg" }));
    return (to) => {
      to.drawImage(bitmap, 0, 0);
      bitmap.close();
    };
  }
  return (to) => {
    const { columns, rows } = header;
    if (grey?.width !== columns || grey.height !== rows) grey = new ImageData(columns, rows);
    const words = new Uint32Array(grey.data.buffer);
    for (let i = 0; i < words.length; i++) words[i] = 0xff000000 | (payload[i] * 0x010101);
    to.putImageData(grey, 0, 0);
  };
}

/** Counts what makes an image that is still being decoded one that is not wanted any more. */
let turn = 0;

/** Draw a frame that was kept, unless another is wanted before it is ready. */
export async function drawKept(frame) {
  turn += 1;
  await draw(frame);
}

/** Whether it was drawn. */
async function draw(frame) {
  const mine = turn;
  const paint = await painter(frame);
  if (mine !== turn) return false;
  const { columns, rows, kind, matrix = null } = frame.header;
  const isOther = String(matrix) !== String(geometry);
  const isNew = canvas.width !== columns || canvas.height !== rows || isOther || !hasImage();
  scale.hidden = kind === "annotated"; // that one has scales of its own
  if (canvas.width !== columns || canvas.height !== rows) {
    canvas.width = columns;
    canvas.height = rows;
  }
  paint(context);
  shownFrame = frame;
  geometry = matrix;
  waiting.hidden = true;
  if (isNew) drawScale();
  if (isOther) events.tell("image-geometry", geometry);
  events.tell("image-shown", frame);
  return true;
}

let live = true;
let shown = KIND;
let label = "B-mode"; // of the mode that is chosen
let held = ""; // and of the one that was chosen as the image was frozen
let arrived = 0;

/** Images of a probe at rest come five times a second; without any the last one is marked. */
const STALE_MS = 1000;

/** ms for which it is said what a frozen image does not do. */
const REMINDED_MS = 4000;
let reminded = -REMINDED_MS;

/** Say for a while that the image is frozen, to who drags on it. */
export function remindFrozen() {
  reminded = performance.now();
  showRemark();
}

let remarks = []; // on the images as they come

/** What is to be known of the image, or nothing. */
function remark() {
  if (!live && performance.now() - reminded < REMINDED_MS) {
    return "The image is frozen and the probe stays where it is: press Go on to move it here";
  }
  if (!live) return label === held ? "" : `The image is frozen: Go on shows ${label}`;
  const age = arrived ? performance.now() - arrived : 0;
  if (document.hidden) return "";
  if (age >= STALE_MS) return `No new image for ${Math.floor(age / 1000)} s`;
  return remarks.join("\n");
}

/** Say these of the images as they come, in place of those said before. */
export function setRemarks(said) {
  remarks = said;
  showRemark();
}

function showRemark() {
  const words = remark();
  badge.hidden = !words;
  if (words && badge.textContent !== words) badge.textContent = words;
}
setInterval(showRemark, 250);

/** Whether images come and are drawn: not while one is frozen. */
export function setLive(on) {
  live = on;
  held = label;
  arrived = 0;
  turn += 1;
  stream.watch(shown, on);
}

/**
 * Show the plain image ("b-mode"), or the one with outlines and colours ("annotated").
 *
 * `name` is what the mode is called on the page. While an image is frozen it stays as it is.
 */
export function setMode(mode, name) {
  label = name;
  showRemark();
  const wanted = mode === "annotated" ? "annotated" : KIND;
  if (wanted === shown) return;
  stream.watch(shown, false);
  shown = wanted;
  stream.watch(shown, live);
}

async function take(header, payload) {
  if (header.kind !== shown || !live) return; // what was under way as it was frozen
  arrived = performance.now();
  const frame = { header, payload, time: arrived, mode: label, measures: [] };
  if (!(await draw(frame))) return;
  for (const handle of handlers) handle(frame);
  events.tell("image-drawn", header);
}

stream.on(KIND, take);
stream.on("annotated", take);
stream.watch(KIND);

/** The rectangle of the image within the canvas' box, CSS pixels: it keeps its shape in mm. */
export function imageBox() {
  const { width, height } = place.getBoundingClientRect();
  const [across, down] = sizeInMillimetres();
  const factor = Math.min((width - 44) / across, (height - 44) / down);
  const w = across * factor;
  const h = down * factor;
  return { left: (width - w - 36) / 2 + 36, top: (height - h) / 2, width: w, height: h };
}

function sizeInMillimetres() {
  if (!geometry || !canvas.width) return [canvas.width || 1, canvas.height || 1];
  return [
    1000 * Math.abs(geometry[0]) * canvas.width,
    1000 * Math.abs(geometry[9]) * canvas.height,
  ];
}

/** Lay out the image, and draw ticks every 5 mm with numbers every 10 mm of depth. */
function drawScale() {
  const box = imageBox();
  for (const layer of layers) {
    Object.assign(layer.style, {
      left: `${box.left}px`,
      top: `${box.top}px`,
      width: `${box.width}px`,
      height: `${box.height}px`,
    });
  }
  mark.hidden = !geometry || !hasImage();
  if (geometry) {
    const isLeft = geometry[0] > 0;
    const side = isLeft ? "left" : "right";
    mark.title = `The probe's mark, the notch on its housing, is at the image's ${side}`;
    mark.setAttribute("aria-label", mark.title);
    const x = isLeft ? box.left : box.left + box.width - 12;
    Object.assign(mark.style, { left: `${x}px`, top: `${box.top - 16}px` });
  }
  const { width, height } = place.getBoundingClientRect();
  const ratio = devicePixelRatio;
  scale.width = Math.round(width * ratio);
  scale.height = Math.round(height * ratio);
  if (!geometry || !hasImage()) return;
  const draw = scale.getContext("2d");
  draw.scale(ratio, ratio);
  draw.strokeStyle = draw.fillStyle = "#8f9aa3";
  draw.font = "12px Roboto, sans-serif";
  draw.textAlign = "right";
  draw.textBaseline = "middle";
  const first = pixelToMillimetres(0, -0.5)[1];
  const last = pixelToMillimetres(0, canvas.height - 0.5)[1];
  const step = last - first > 120 ? 10 : 5;
  for (let depth = Math.ceil(first / step) * step; depth <= last + 1e-6; depth += step) {
    const y = box.top + ((depth - first) / (last - first)) * box.height;
    const isNumbered = Math.round(depth / step) % 2 === 0;
    draw.beginPath();
    draw.moveTo(box.left - (isNumbered ? 9 : 5), y);
    draw.lineTo(box.left - 1, y);
    draw.stroke();
    if (isNumbered) draw.fillText(`${depth}`, box.left - 12, y);
  }
  draw.fillText("mm", box.left - 6, box.top - 14);
}

new ResizeObserver(drawScale).observe(place);
