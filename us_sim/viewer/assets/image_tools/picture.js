/** The image as a picture to keep: with its scale, measurements, the scene's name and the time. */

import { hasImage, imageCanvas, pixelToMillimetres } from "../image.js";
import { overlay } from "./overlay.js";
import { Ellipse, Note } from "./measures.js";

/** Pixels: the least height of the image, and what is around it. */
const LEAST = 768;
const LEFT = 56;
const TOP = 40;
const EDGE = 20;
const LINE = 24;

/** The picture on a canvas; null before the first image. */
export function picture() {
  const image = imageCanvas();
  const first = pixelToMillimetres(-0.5, -0.5);
  const last = pixelToMillimetres(image.width - 0.5, image.height - 0.5);
  if (!first || !hasImage()) return null;
  const scale = Math.max(LEAST, image.height) / (last[1] - first[1]); // pixels a mm
  const width = Math.round((last[0] - first[0]) * scale);
  const height = Math.round((last[1] - first[1]) * scale);
  const measures = overlay.obstacle ? [] : overlay.measures;
  const lines = measures.filter((measure) => !(measure instanceof Note));
  const canvas = document.createElement("canvas");
  canvas.width = LEFT + width + EDGE;
  canvas.height = TOP + height + EDGE + LINE * lines.length;
  const draw = canvas.getContext("2d");
  draw.fillStyle = "#000";
  draw.fillRect(0, 0, canvas.width, canvas.height);
  draw.drawImage(image, LEFT, TOP, width, height);
  draw.font = "16px Roboto, sans-serif";
  draw.fillStyle = draw.strokeStyle = "#b9c2c9";
  draw.textBaseline = "middle";
  const when = new Date().toLocaleString("sv-SE");
  draw.fillText([window.usSim?.scene?.() ?? "us_sim", when].join("   "), LEFT, TOP / 2);
  drawDepths(draw, first[1], last[1], scale);
  const to = ([x, y]) => [LEFT + (x - first[0]) * scale, TOP + (y - first[1]) * scale];
  for (const [number, measure] of measures.entries()) drawMeasure(draw, measure, number, to, scale);
  for (const [row, measure] of lines.entries()) {
    draw.fillStyle = measure.colour;
    const label = `${measures.indexOf(measure) + 1}   ${measure.text}`;
    draw.fillText(label, LEFT, TOP + height + EDGE / 2 + LINE * (row + 0.5));
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

function drawMeasure(draw, measure, number, to, scale) {
  const points = measure.points.map(to);
  draw.strokeStyle = draw.fillStyle = measure.colour;
  draw.lineWidth = 2;
  draw.beginPath();
  if (measure instanceof Ellipse) {
    const [a, b] = measure.halves;
    draw.ellipse(...to(measure.centre), a * scale, b * scale, measure.angle, 0, 2 * Math.PI);
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

/** Have the browser keep it as a file. */
export function save() {
  picture()?.toBlob((blob) => {
    const link = document.createElement("a");
    link.href = URL.createObjectURL(blob);
    const when = new Date().toLocaleString("sv-SE").replace(/[^0-9]+/g, "-");
    link.download = `us_sim-${when}.png`;
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
  }, "image/png");
}
