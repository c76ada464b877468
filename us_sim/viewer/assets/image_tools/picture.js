/** A frame as a picture to keep: with its scale and measures, and what is known of it. */

import { events } from "../events.js";
import { frameShown, painter, pixelToMillimetres } from "../image.js";
import { stripsShown } from "../strips.js";
import { compare } from "./compare.js";
import { Ellipse, Note } from "./measures.js";

/** Pixels: the least height of the image, and what is around it. */
const LEAST = 768;
const LEFT = 56;
const TOP = 96;
const EDGE = 20;
const LINE = 24;

/** Time of a frame, s since 1970 in its stamp's ns, as it is here. */
function timeOf({ header }) {
  const milliseconds = Number(BigInt(header.stamp) / 1_000_000n);
  const fraction = String(milliseconds % 1000).padStart(3, "0");
  return `${new Date(milliseconds).toLocaleString("sv-SE")}.${fraction}`;
}

/** What a frame is compared with, in words; nothing where it is not. */
export function comparedWith(frame) {
  return compare.isWith(frame) ? [`difference from ${factsOf(compare.held).join(" · ")}`] : [];
}

/** How the probe pressed and was pressed at a frame, in words, as far as it is known. */
export function pressOf({ header: { press, force } }) {
  const of = (name, value, unit) =>
    value === undefined ? [] : [`${name} ${value.toFixed(1).replace(/^-(0\.0)$/, "$1")} ${unit}`];
  return [...of("press", press && 1000 * press, "mm"), ...of("force", force, "N")];
}

/** What else is known of a frame, in words. */
export function othersOf(frame) {
  const { matrix, rows, settings = {} } = frame.header;
  return [
    timeOf(frame),
    ...(matrix ? [`depth ${pixelToMillimetres(0, rows - 0.5, matrix)[1].toFixed(1)} mm`] : []),
    ...Object.entries(settings).map(([name, value]) => `${name} ${value}`),
  ];
}

const factsOf = (frame) => [...othersOf(frame), ...pressOf(frame)];

/**
 * The picture of a frame on a canvas, with other canvases below it; null where it is not known where
 * the frame's pixels are.
 */
export async function picture(frame = frameShown(), below = []) {
  const { columns, rows, matrix } = frame?.header ?? {};
  if (!matrix) return null;
  const first = pixelToMillimetres(-0.5, -0.5, matrix);
  const last = pixelToMillimetres(columns - 0.5, rows - 0.5, matrix);
  const scale = Math.max(LEAST, rows) / (last[1] - first[1]); // pixels a mm
  const side = Math.sign(last[0] - first[0]); // of the probe's x; -1 where the image is flipped
  const width = Math.round(Math.abs(last[0] - first[0]) * scale);
  const height = Math.round((last[1] - first[1]) * scale);
  const { measures } = frame;
  const lines = measures.filter((measure) => !(measure instanceof Note));
  const image = Object.assign(document.createElement("canvas"), { width: columns, height: rows });
  const pixels = image.getContext("2d");
  (await painter(frame))(pixels);
  if (compare.isWith(frame)) {
    pixels.globalCompositeOperation = "difference";
    pixels.drawImage(compare.canvas, 0, 0);
  }
  const canvas = document.createElement("canvas");
  canvas.width = LEFT + width + EDGE;
  const end = TOP + height + EDGE + LINE * lines.length;
  const strips = below.map((strip) => [strip, Math.round((strip.height * width) / strip.width)]);
  canvas.height = strips.reduce((sum, [, its]) => sum + its + EDGE, end);
  const draw = canvas.getContext("2d");
  draw.fillStyle = "#000";
  draw.fillRect(0, 0, canvas.width, canvas.height);
  draw.drawImage(image, LEFT, TOP, width, height);
  draw.font = "16px Roboto, sans-serif";
  draw.fillStyle = draw.strokeStyle = "#b9c2c9";
  draw.textBaseline = "middle";
  const [when, ...facts] = factsOf(frame);
  const what = [frame.header.scene || "us_sim", frame.mode, when, "simulated"];
  const words = [what.join("   "), facts.join("   "), ...comparedWith(frame)];
  for (const [row, text] of words.entries()) {
    draw.fillText(text, LEFT, EDGE + LINE * row, width);
  }
  draw.beginPath(); // the probe's mark is at its -x
  draw.arc(LEFT + (side > 0 ? 7 : width - 7), TOP - 9, 6, 0, 2 * Math.PI);
  draw.fill();
  drawDepths(draw, first[1], last[1], scale);
  const to = ([x, y]) => [LEFT + side * (x - first[0]) * scale, TOP + (y - first[1]) * scale];
  for (const [number, measure] of measures.entries()) {
    drawMeasure(draw, measure, number, to, scale, side);
  }
  for (const [row, measure] of lines.entries()) {
    draw.fillStyle = measure.colour;
    const label = `${measures.indexOf(measure) + 1}   ${measure.text}`;
    draw.fillText(label, LEFT, TOP + height + EDGE / 2 + LINE * (row + 0.5));
  }
  let top = end;
  for (const [strip, its] of strips) {
    draw.drawImage(strip, LEFT, top, width, its);
    top += its + EDGE;
  }
  return canvas;
}

function drawDepths(draw, first, last, scale) {
  draw.textAlign = "right";
  draw.fillText("mm", LEFT - 14, TOP - 16);
  for (let depth = Math.ceil(first / 5) * 5; depth <= last; depth += 5) {
    const y = TOP + (depth - first) * scale;
    const isNumbered = depth % 10 === 0;
    draw.fillRect(LEFT - (isNumbered ? 10 : 6), y - 0.5, isNumbered ? 9 : 5, 1);
    if (isNumbered) draw.fillText(`${depth}`, LEFT - 14, y);
  }
  draw.textAlign = "left";
}

function drawMeasure(draw, measure, number, to, scale, side) {
  const points = measure.points.map(to);
  draw.strokeStyle = draw.fillStyle = measure.colour;
  draw.lineWidth = 2;
  draw.beginPath();
  if (measure instanceof Ellipse) {
    const [a, b] = measure.halves;
    draw.ellipse(...to(measure.centre), a * scale, b * scale, side * measure.angle, 0, 2 * Math.PI);
  } else if (points.length === 2) {
    draw.setLineDash([6, 5]);
    draw.moveTo(...points[0]);
    draw.lineTo(...points[1]);
  }
  draw.stroke();
  draw.setLineDash([]);
  for (const [x, y] of points) {
    draw.fillRect(x - 7, y - 1, 14, 2);
    draw.fillRect(x - 1, y - 7, 2, 14);
  }
  const [x, y] = points[1] ?? points[0];
  draw.fillText(measure instanceof Note ? measure.words : `${number + 1}`, x + 11, y - 10);
}

/** Labels of what can be saved, by the ending of the file's name. */
export const KINDS = { png: "PNG", mp4: "10 s, MP4" };

/** Have the browser keep `frame` as a PNG, or `frames` as an MP4 that the viewer makes of pictures. */
export async function save(kind, frame = frameShown(), frames = [frame]) {
  if (kind === "png") {
    const blob = await blobOf(frame, "image/png", stripsShown());
    if (blob) keep(blob, frame, kind);
    return;
  }
  const sent = [];
  for (const each of frames) {
    const bytes = await (await blobOf(each, "image/jpeg"))?.arrayBuffer();
    if (bytes) sent.push([{ time: each.time / 1000, bytes: bytes.byteLength }, bytes]);
  }
  const text = JSON.stringify({ kind, sequence: 0, frames: sent.map(([header]) => header) });
  const head = new TextEncoder().encode(text);
  const length = new Uint32Array([head.length]); // little endian where browsers run
  const body = new Blob([length, head, ...sent.map(([, bytes]) => bytes)]);
  const answer = await fetch("/us_sim/export", { method: "POST", body });
  if (answer.ok) keep(await answer.blob(), frame, kind);
  else events.tell("problem", await answer.text());
}

/** The picture of a frame as a file; null where there is none. */
async function blobOf(frame, type, below = []) {
  const canvas = await picture(frame, below);
  return canvas && new Promise((done) => canvas.toBlob(done, type, 0.92));
}

/** Have the browser keep what was made of a frame. */
function keep(blob, frame, ending) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = `us_sim-${timeOf(frame).replace(/[^0-9]+/g, "-")}.${ending}`;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}
