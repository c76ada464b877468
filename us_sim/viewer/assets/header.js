/** The header: whether the viewer answers, and how many images come. */

import { element, events } from "./events.js";
import { stream } from "./stream.js";

const WINDOW_MS = 2000;
const times = [];

const readout = await element("readout");
readout.setAttribute("role", "status");
readout.title = "Ultrasound images drawn in this page; at rest, while nothing moves, a few a second";

let connected = false;
let frozen = false;
let resting = false; // fewer images are sent on purpose

function show() {
  const now = performance.now();
  while (times.length && now - times[0] > WINDOW_MS) times.shift();
  const rate = (1000 * times.length) / WINDOW_MS;
  const live = resting && times.length ? "at rest" : `${rate.toFixed(0)} images/s`;
  const rated = frozen ? "frozen" : live;
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
stream.on("hand", ({ is_resting: is }) => {
  resting = is;
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
