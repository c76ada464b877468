/** What runs over time below the image: M-mode and the spectrum, each watched while it is shown. */

import { element } from "./events.js";
import { stream } from "./stream.js";

const TITLES = { m_mode: "M-mode", spectrum: "Spectrum of blood flow" };
const place = await element("strips");
const strips = new Map();

function strip(kind) {
  const canvas = Object.assign(document.createElement("canvas"), { className: "us-strip" });
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", TITLES[kind]);
  canvas.title = TITLES[kind];
  stream.on(kind, async (header, payload) => {
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
