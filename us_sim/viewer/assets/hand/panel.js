/** Sliders with numbers, buttons, and the line that says who holds the probe. */

import { element, events } from "../events.js";
import { hand } from "./hand.js";
import { help } from "./help.js";
import { latency } from "./latency.js";

/** `notch`: by how much an arrow key moves a slider. */
const MILLIMETRES = { unit: "mm", factor: 1000, digits: 1, step: 0.1, notch: 0.5 };
const DEGREES = { unit: "°", factor: 180 / Math.PI, digits: 0, step: 1, notch: 1 };
/** The way through the air takes so much less of the slider than as long a press. */
const PRESS = { ...MILLIMETRES, air: 10 };
const HALF = [-Math.PI, Math.PI];

/** Name of the quantity, label, title, unit, and its range's name in the state, or the range. */
const QUANTITIES = [
  ["press", "Press", "How deep the probe is pressed into the skin at rest; at the mark it touches, before it it is lifted (keys S, W; Page ↓ ↑)", PRESS, "press"],
  ["fan", "Fan", "Tilt about the array: the image plane swings through the tissue (Shift ↑ ↓)", DEGREES, "tilt"],
  ["rock", "Rock", "Tilt within the image plane (Shift ← →)", DEGREES, "tilt"],
  ["rotation", "Rotate", "Turn about the skin's normal (keys Q, E)", DEGREES, HALF],
  ["x", "Across", "Where the probe stands along the patient's x (keys ← →)", MILLIMETRES, "x"],
  ["y", "Along", "Where the probe stands along the patient's y (keys ↑ ↓)", MILLIMETRES, "y"],
];
const BUTTONS = [
  ["Centre", "Back to the middle of the patient, touching the skin (key H)", () => hand.ask({ go: "home" })],
  ["Lift", "10 mm off the skin (key L)", () => hand.ask({ go: "lift" })],
  ["Upright", "Without fan, rock and rotation (key U)", () => hand.ask({ go: "upright" })],
];
const OF_REPLAY = "End the replay; the probe stays where it is, and you hold it";
const OF_PAGE = "The probe stays where it is; you hold it, and the other page no longer does";
const SAID_MS = 5000;
const PACE_MS = 500;

const style = document.createElement("link");
style.rel = "stylesheet";
style.href = new URL("./hand.css", import.meta.url).href;
document.head.append(style);

const place = await element("hand");
const rows = QUANTITIES.map(makeRow);
const said = make("p", { className: "us-said" });
said.setAttribute("role", "status");
const take = make("button", { type: "button", className: "us-on", hidden: true });
take.onclick = () => hand.take();
const moves = []; // buttons that need the probe
const pace = make("span", { className: "us-pace" });
pace.title = "From the pointer to the changed image: median of the last movements";
place.append(make("div", { className: "us-quantities" }, ...rows.map((row) => row.all)), makeBar());

function make(kind, properties = {}, ...children) {
  const made = Object.assign(document.createElement(kind), properties);
  made.append(...children);
  return made;
}

/** Set a property that is another; to set it to what it is would lay out the panel, too. */
function put(part, property, value) {
  if (part[property] !== value) part[property] = value;
}

function makeRow([name, label, title, { unit, factor, digits, step, notch, air = 1 }, range]) {
  const onSlider = (value) => (value < 0 ? value / air : value);
  const ofSlider = (place) => (place < 0 ? place * air : place);
  const slider = make("input", { type: "range", step: step / 10, title });
  const number = make("input", { type: "number", step, title });
  slider.setAttribute("aria-label", `${label}, ${unit}`);
  number.setAttribute("aria-label", `${label}, ${unit}`);
  const all = make(
    "label",
    { className: "us-quantity", title },
    make("span", { textContent: label }),
    slider,
    number,
    make("i", { textContent: unit }),
  );
  let isHeld = false;
  const ask = (value, event) => {
    if (Number.isFinite(value)) hand.ask({ to: { [name]: value / factor } }, event.timeStamp);
  };
  const slide = (value, event) => {
    slider.value = onSlider(value);
    number.value = ofSlider(slider.valueAsNumber).toFixed(digits);
    if (problem) tell("");
    ask(ofSlider(slider.valueAsNumber), event);
  };
  slider.addEventListener("input", (event) => slide(ofSlider(slider.valueAsNumber), event));
  slider.addEventListener("keydown", (event) => {
    const sign = { ArrowRight: 1, ArrowUp: 1, ArrowLeft: -1, ArrowDown: -1 }[event.key];
    if (!sign) return;
    event.preventDefault();
    slide(ofSlider(slider.valueAsNumber) + sign * notch, event);
  });
  number.addEventListener("change", (event) => {
    const { value, min, max } = number;
    if (min && number.valueAsNumber < min) number.value = min;
    if (max && number.valueAsNumber > max) number.value = max;
    const isWithin = number.value === value;
    tell(isWithin ? "" : `${label}: ${min} to ${max}${unit === "°" ? "" : " "}${unit}`);
    ask(number.valueAsNumber, event);
  });
  slider.addEventListener("pointerdown", () => (isHeld = true));
  for (const end of ["pointerup", "pointercancel", "blur"]) {
    slider.addEventListener(end, () => (isHeld = false));
  }
  return {
    all,
    show({ goal, range: ranges }, canMove) {
      const limits = Array.isArray(range) ? range : ranges?.[range];
      for (const [entry, at] of [[slider, onSlider], [number, (value) => value]]) {
        put(entry, "disabled", !canMove);
        if (!limits) continue;
        put(entry, "min", at(limits[0] * factor).toFixed(digits));
        put(entry, "max", at(limits[1] * factor).toFixed(digits));
      }
      if (limits && air !== 1) {
        const contact = slider.min / (slider.min - slider.max);
        all.style.setProperty("--contact", contact);
      }
      if (!goal) return;
      const text = (goal[name] * factor).toFixed(digits).replace(/^-(0\.?0*)$/, "$1");
      if (!isHeld) slider.value = onSlider(goal[name] * factor);
      put(slider, "ariaValueText", `${text} ${unit}`);
      if (document.activeElement !== number && !isHeld) put(number, "value", text);
    },
  };
}

function makeBar() {
  const bar = make("div", { className: "us-hand-bar" });
  for (const [textContent, title, onclick] of BUTTONS) {
    moves.push(make("button", { type: "button", textContent, title, onclick }));
  }
  const gizmo = make("button", { type: "button", textContent: "Gizmo" });
  gizmo.title = "Arrows and rings at the probe, to move and turn it along its own axes";
  gizmo.setAttribute("aria-pressed", "false");
  gizmo.onclick = () => {
    const isOn = gizmo.classList.toggle("us-on");
    gizmo.setAttribute("aria-pressed", String(isOn));
    events.tell("gizmo", isOn);
  };
  const keys = make("button", { type: "button", textContent: "?", title: "Keys and gestures (key ?)" });
  keys.onclick = () => help.toggle();
  moves.push(gizmo);
  bar.append(take, ...moves, keys, make("div", { className: "us-told" }, said, pace));
  return bar;
}

let problem = "";
let problemEnds = 0;
let led = false;

function show() {
  const state = hand.state;
  if (!state) return;
  for (const row of rows) row.show(state, hand.leads);
  for (const button of moves) button.disabled = !hand.leads;
  take.hidden = hand.isWatching || !(hand.isAnswered && (state.can_take || hand.isHeldElsewhere));
  put(take, "textContent", state.can_take ? "Take the probe" : "Take over");
  put(take, "title", state.can_take ? OF_REPLAY : OF_PAGE);
  if (hand.leads && !led) problemEnds = 0; // what was in the way is not any more
  led = hand.leads;
  const isProblem = performance.now() < problemEnds;
  const silent = hand.isAnswered ? "" : "The viewer does not answer: nobody holds the probe";
  said.classList.toggle("us-wrong", isProblem || hand.isTaken || Boolean(silent || state.warning));
  const words = isProblem ? problem : silent || state.warning || state.obstacle || holder();
  put(said, "textContent", words);
  put(said, "title", words);
}

/** Which page holds the probe, for a person. */
function holder() {
  const other = hand.isTaken ? "Another page has taken the probe" : "Another page holds the probe";
  if (hand.isWatching) return "This page only watches";
  if (hand.isHeldElsewhere) return other;
  return hand.isFree ? "Nobody holds the probe: move it to take it" : "You hold the probe";
}

setInterval(() => {
  const { count, median } = latency.get();
  put(pace, "textContent", count ? `${median.toFixed(0)} ms` : "");
}, PACE_MS);

hand.on(show);
events.on("problem", tell);

/** Say for a while what is wrong; nothing is, if the sentence is empty. */
function tell(sentence) {
  problem = sentence;
  problemEnds = sentence ? performance.now() + SAID_MS : 0;
  if (sentence) setTimeout(show, SAID_MS + 50);
  show();
}
