/**
 * One image held over those that come: what is seen is how far their grey values are apart.
 *
 * So another method, stiffness, gain or press is compared with the one before.
 */

import { events } from "../events.js";
import { addLayer, frameShown, painter } from "../image.js";

const canvas = Object.assign(document.createElement("canvas"), { className: "us-compared" });
canvas.hidden = true;
addLayer(canvas); // over the image, blended with it as the style says
let held = null;
const handlers = [];

const shapeOf = ({ header }) =>
  ["kind", "rows", "columns", "matrix"].map((key) => String(header[key])).join();

function show() {
  const isHidden = !compare.isWith(frameShown());
  if (canvas.hidden === isHidden) return;
  canvas.hidden = isHidden;
  for (const handle of handlers) handle();
}

export const compare = {
  /** The frame that others are compared with, or null. */
  get held() {
    return held;
  },

  /** Its pixels, on a canvas of its size. */
  canvas,

  /** Whether a frame is compared: not where its pixels are elsewhere, or of another kind. */
  isWith(frame) {
    return Boolean(held && frame) && shapeOf(held) === shapeOf(frame);
  },

  /** Have `handler()` called when something of it has changed. */
  on(handler) {
    handlers.push(handler);
  },

  /** Hold the image that is shown over those that come, or let it go. */
  async toggle() {
    const frame = held ? null : frameShown();
    const paint = frame && (await painter(frame));
    held = frame;
    if (held) {
      [canvas.width, canvas.height] = [held.header.columns, held.header.rows];
      paint(canvas.getContext("2d"));
    }
    show();
    for (const handle of handlers) handle();
  },
};

events.on("image-shown", show);
