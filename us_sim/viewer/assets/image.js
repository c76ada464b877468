/**
 * The ultrasound image on a canvas, with its depth scale.
 *
 * Pixels of the canvas `#ultrasound canvas.us-image` are those of the image. Where they are comes
 * with `image_geometry`: a 4 × 4 matrix from (column, row, 0, 1) to metres in frame `probe`.
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
  textContent:
    "Waiting for the first image …\n" +
    "The first start after an installation takes some minutes: the program is compiled once.",
});
const badge = Object.assign(document.createElement("p"), { className: "us-stale", hidden: true });
badge.setAttribute("role", "status");
place.append(canvas, scale, waiting, badge);
canvas.setAttribute("role", "img");
canvas.setAttribute("aria-label", "Ultrasound image");
const context = canvas.getContext("2d", { alpha: false, willReadFrequently: true });

/** 16 numbers, row by row, or null before the first. */
let geometry = null;
let pixels = null;
const handlers = [];

/** The canvas that holds the image, one canvas pixel an image pixel. */
export function imageCanvas() {
  return canvas;
}

/** Whether there is an image in it. */
export function hasImage() {
  return waiting.hidden;
}

/** From (column, row), of pixels, to [lateral, axial] mm in frame `probe`; null if not known. */
export function pixelToMillimetres(column, row) {
  if (!geometry) return null;
  const at = (i) => 1000 * (geometry[i] * column + geometry[i + 1] * row + geometry[i + 3]);
  return [at(0), at(8)];
}

/** Have `handler(header, payload)` called when an image was drawn. */
export function onImage(handler) {
  handlers.push(handler);
}

/** Draw what a packet of the image holds; also one that was kept. */
export async function drawImage(header, payload) {
  const { columns, rows } = header;
  scale.hidden = header.kind === "annotated"; // that one has scales of its own
  if (canvas.width !== columns || canvas.height !== rows) {
    canvas.width = columns;
    canvas.height = rows;
    pixels = null;
    drawScale();
  }
  if (header.encoding === "mono8") {
    pixels ??= context.createImageData(columns, rows);
    const words = new Uint32Array(pixels.data.buffer);
    for (let i = 0; i < words.length; i++) words[i] = 0xff000000 | (payload[i] * 0x010101);
    context.putImageData(pixels, 0, 0);
  } else {
    const bitmap = await createImageBitmap(new Blob([payload], { type: "image/jpeg" }));
    context.drawImage(bitmap, 0, 0);
    bitmap.close();
  }
  if (!hasImage()) {
    waiting.hidden = true;
    drawScale();
  }
}

let live = true;
let shown = KIND;
let label = "B-mode"; // of the mode that is chosen
let held = ""; // and of the one that was chosen as the image was frozen
let arrived = 0;

/** Images of a probe at rest come five times a second; without any the last one is marked. */
const STALE_MS = 1000;

/** What is to be known of the image, or nothing. */
function remark() {
  if (!live) return label === held ? "" : `The image is frozen: Go on shows ${label}`;
  const age = arrived ? performance.now() - arrived : 0;
  return document.hidden || age < STALE_MS ? "" : `No new image for ${Math.floor(age / 1000)} s`;
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
  await drawImage(header, payload);
  for (const handle of handlers) handle(header, payload);
  events.tell("image-drawn", header);
}

stream.on(KIND, take);
stream.on("annotated", take);
stream.on("image_geometry", (header) => {
  geometry = header.matrix;
  drawScale();
  events.tell("image-geometry", geometry);
});
stream.watch(KIND);
stream.watch("image_geometry");

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
  Object.assign(canvas.style, {
    left: `${box.left}px`,
    top: `${box.top}px`,
    width: `${box.width}px`,
    height: `${box.height}px`,
  });
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
