/** The header: whether the viewer answers, and how many images come. */

import { element, events } from "./events.js";
import { stream } from "./stream.js";

const WINDOW_MS = 2000;
/** ms without an image after which the image is not said to be still: five a second come then. */
const SILENT_MS = 500;
const times = [];

const readout = await element("readout");
readout.setAttribute("role", "status");
readout.title = "Ultrasound images drawn in this page; of a probe that stays where it is a few a second";

let connected = false;
let frozen = false;
let resting = false; // fewer images are sent on purpose
let last = performance.now(); // when an image came, or the page was shown
let forceAge = 0; // s, of the newest force when the newest pose came

function show() {
  const now = performance.now();
  while (times.length && now - times[0] > WINDOW_MS) times.shift();
  const rate = (1000 * times.length) / WINDOW_MS;
  const silent = forceAge > SILENT_MS / 1000 ? "the tissue does not answer" : "no images come";
  const still = now - last > SILENT_MS ? silent : "still image";
  const live = resting ? still : `${rate.toFixed(0)} images/s`;
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
stream.on("probe", ({ force_age: age = 0 }) => {
  forceAge = age;
});
document.addEventListener("visibilitychange", () => {
  last = performance.now(); // nothing was sent meanwhile
});
let drawn = 0;
events.on("image-drawn", () => {
  drawn += 1;
  last = performance.now();
  times.push(last);
});
/** For who measures or tests a page: how many images it has drawn, and of which scene. */
window.usSim = Object.assign(window.usSim ?? {}, {
  images: () => drawn,
  scene: () => document.getElementById("us-scene")?.textContent,
});
setInterval(show, 100);
