/** Moves the probe by keys: a touch is a small step, holding goes on. */

import { hand } from "./hand.js";
import { isTyping } from "./typing.js";

const degrees = (angle) => (angle * Math.PI) / 180;
/** ms that a key is held until it goes on by itself. */
const HELD_MS = 220;

/** Speed (m/s, rad/s) while held; the first step is the way of STEP_S. */
const SLIDE = 0.03;
const PRESS = 0.012;
const TURN = degrees(40);
const STEP_S = 1 / 40;

const along = (x, y) => (amount) => ({ slide: [x * amount * SLIDE, y * amount * SLIDE] });
const change = (name, speed) => (amount) => ({ [name]: amount * speed });

/** By key: the change of so many seconds. Arrows with shift tilt. */
const KEYS = {
  ArrowLeft: along(-1, 0),
  ArrowRight: along(1, 0),
  ArrowUp: along(0, -1),
  ArrowDown: along(0, 1),
  "shift ArrowLeft": change("rock", -TURN),
  "shift ArrowRight": change("rock", TURN),
  "shift ArrowUp": change("fan", TURN),
  "shift ArrowDown": change("fan", -TURN),
  s: change("press", PRESS),
  w: change("press", -PRESS),
  PageDown: change("press", PRESS),
  PageUp: change("press", -PRESS),
  q: change("rotation", -TURN),
  e: change("rotation", TURN),
};
const PLACES = { h: "home", l: "lift", u: "upright" };

const held = new Map();
let last = 0;

function nameOf(event) {
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
  return event.shiftKey && key.startsWith("Arrow") ? `shift ${key}` : key;
}

addEventListener("keydown", (event) => {
  if (isTyping(event)) return;
  const name = nameOf(event);
  if (name in PLACES && !event.repeat) hand.ask({ go: PLACES[name] }, event.timeStamp);
  if (!(name in KEYS)) return;
  event.preventDefault(); // a page that scrolls would move the scene away
  if (event.repeat || held.has(event.code)) return;
  hand.ask({ by: KEYS[name](STEP_S) }, event.timeStamp);
  held.set(event.code, { change: KEYS[name], from: performance.now() + HELD_MS });
  if (held.size === 1) {
    last = performance.now();
    requestAnimationFrame(goOn);
  }
});
addEventListener("keyup", (event) => held.delete(event.code));
addEventListener("blur", () => held.clear());

function goOn() {
  const now = performance.now();
  const seconds = Math.min(now - last, 50) / 1000;
  last = now;
  for (const { change: by, from } of held.values()) {
    if (now > from) hand.ask({ by: by(seconds) });
  }
  if (held.size) requestAnimationFrame(goOn);
}
