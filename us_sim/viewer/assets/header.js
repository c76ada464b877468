/** The header: whether the viewer answers, and how many images come. */

import { element, events } from "./events.js";

const WINDOW_MS = 2000;
const times = [];

const readout = await element("readout");
readout.setAttribute("role", "status");
readout.title = "Ultrasound images drawn in this page: only a few a second while nothing moves";

let connected = false;
let frozen = false;

function show() {
  const now = performance.now();
  while (times.length && now - times[0] > WINDOW_MS) times.shift();
  const rate = (1000 * times.length) / WINDOW_MS;
  const rated = frozen ? "frozen" : `${rate.toFixed(0)} images/s`;
  const words = connected ? rated : "the viewer does not answer";
  if (readout.textContent !== words) readout.textContent = words;
  readout.classList.toggle("us-wrong", !connected);
}

events.on("connection", (open) => {
  connected = open;
  show();
});
events.on("image-frozen", (on) => {
  frozen = on;
  show();
});
let drawn = 0;
events.on("image-drawn", () => {
  drawn += 1;
  times.push(performance.now());
});
/** For who measures or tests a page: how many images it has drawn, and of which scene. */
window.usSim = Object.assign(window.usSim ?? {}, {
  images: () => drawn,
  scene: () => document.getElementById("us-scene")?.textContent,
});
setInterval(show, 500);
