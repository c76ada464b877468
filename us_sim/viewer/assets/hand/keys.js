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

/** By the key's code: {change, since}, ms up to which its movement was asked for. */
const held = new Map();

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
  held.set(event.code, { change: KEYS[name], since: event.timeStamp + HELD_MS });
  if (held.size === 1) requestAnimationFrame(goOn);
});
addEventListener("keyup", (event) => {
  if (held.has(event.code)) follow(held.get(event.code), event.timeStamp);
  held.delete(event.code);
});
addEventListener("blur", () => held.clear());

/** Ask for the movement of the time that a key was held, however rarely the page is drawn. */
function follow(key, now) {
  if (now <= key.since) return;
  hand.ask({ by: key.change((now - key.since) / 1000) });
  key.since = now;
}

function goOn() {
  for (const key of held.values()) follow(key, performance.now());
  if (held.size) requestAnimationFrame(goOn);
}
