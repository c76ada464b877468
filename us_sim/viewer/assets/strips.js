/**
 * What runs over time below the image: M-mode and the spectrum, each watched while it is shown.
 *
 * They are frozen with the image: they end with the newest one then.
 */

import { element, events } from "./events.js";
import { stream } from "./stream.js";

const TITLES = { m_mode: "M-mode", spectrum: "Spectrum of blood flow" };
const place = await element("strips");
const strips = new Map();
let isFrozen = false;

events.on("image-frozen", (on) => (isFrozen = on));

/** The canvases of those that are shown, from the upper to the lower. */
export function stripsShown() {
  return [...place.children];
}

function strip(kind) {
  const canvas = Object.assign(document.createElement("canvas"), { className: "us-strip" });
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", TITLES[kind]);
  canvas.title = TITLES[kind];
  stream.on(kind, async (header, payload) => {
    if (isFrozen) return;
    const bitmap = await createImageBitmap(new Blob([payload], { type: "image/jpeg" }));
    if (canvas.width !== header.columns || canvas.height !== header.rows) {
      canvas.width = header.columns;
      canvas.height = header.rows;
    }
    canvas.getContext("2d").drawImage(bitmap, 0, 0);
    bitmap.close();
  });
  return canvas;
}

/** Show or hide "m_mode" or "spectrum". */
export function showStrip(kind, on) {
  if (!strips.has(kind)) strips.set(kind, strip(kind));
  const canvas = strips.get(kind);
  if (on) place.append(canvas);
  else canvas.remove();
  stream.watch(kind, on);
}
