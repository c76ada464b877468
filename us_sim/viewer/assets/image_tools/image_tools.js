/** The bar below the ultrasound image: freeze, cine loop, measurements, picture. */

import { element, events } from "../events.js";
import { frameShown, hasImage } from "../image.js";
import { isTyping } from "../hand/typing.js";
import { compare } from "./compare.js";
import { freeze } from "./freeze.js";
import { overlay } from "./overlay.js";
import { KINDS, comparedWith, othersOf, pressOf, save } from "./picture.js";

const style = document.createElement("link");
style.rel = "stylesheet";
style.href = new URL("./image_tools.css", import.meta.url).href;
document.head.append(style);

const place = await element("image-tools");
const bar = document.createElement("div");
bar.className = "us-image-bar";
const list = document.createElement("ol");
list.className = "us-values";
list.setAttribute("aria-label", "Measured values");
place.append(bar);
const facts = Object.assign(document.createElement("p"), { className: "us-facts" });
facts.title = "Of the image that is shown: how deep the probe is pressed, and the force on it";
const pressed = document.createElement("b");
const others = document.createElement("span");
facts.append(pressed, others);
(await element("ultrasound")).append(list, facts);

function button(text, title, onclick) {
  const made = Object.assign(document.createElement("button"), { type: "button", title, onclick });
  made.textContent = text;
  made.dataset.title = title;
  bar.append(made);
  return made;
}

const freezing = button("Freeze", "Hold the image; the last 10 s can be looked through (Space)", () => freeze.toggle());
const playing = button("Play", "Play the last 10 s again and again (key C)", () => freeze.play());
const scrubber = Object.assign(document.createElement("input"), {
  type: "range",
  className: "us-scrubber",
  min: 0,
  step: 1,
  title: "Look through the last 10 s (keys , and .)",
});
scrubber.setAttribute("aria-label", "Image of the last 10 s");
const moment = Object.assign(document.createElement("span"), { className: "us-moment" });
moment.title = "Time before the image was frozen";
bar.append(scrubber, moment);
const tools = {
  distance: button("Distance", "Drag from point to point: mm (key D)", take("distance")),
  ellipse: button("Ellipse", "Drag an axis, then its other end: mm² (key O)", take("ellipse")),
  note: button("Text", "Click where it shall be, and write (key T)", take("note")),
};

/** Takes a tool in hand; pressed without a pointer, which has no detail, it is also used at once. */
function take(tool) {
  return (event) => {
    overlay.use(tool);
    if (!event.detail) overlay.place();
  };
}

const clearing = button("Clear", "", clearOrUndo);
const comparing = button(
  "Compare",
  "Hold this image over those that come, and see how far they are apart (key V)",
  () => compare.toggle(),
);
const saving = button("Save", "Keep this as a file (key P)", saveChosen);
const kinds = document.createElement("select");
kinds.className = "us-kinds";
kinds.title = "What Save keeps: this image, or the last 10 s; with scale and measurements";
kinds.setAttribute("aria-label", "What is saved");
for (const [kind, label] of Object.entries(KINDS)) kinds.append(new Option(label, kind));
const saved = Object.assign(document.createElement("span"), { className: "us-saved" });
saved.append(saving, kinds);
bar.append(saved);

async function saveChosen() {
  if (saving.disabled || !hasImage()) return;
  saving.disabled = true;
  saving.textContent = "Saving …";
  try {
    await save(kinds.value, frameShown(), [...freeze.cine.frames]);
  } catch {
    events.tell("problem", "The viewer does not answer, so nothing was saved");
  }
  saving.textContent = "Save";
  saving.disabled = false;
}

/** Remove what is on the image, or have it back. */
function clearOrUndo() {
  if (overlay.measures.length) overlay.clear();
  else overlay.undo();
}

scrubber.addEventListener("input", () => {
  if (freeze.isPlaying) freeze.play(false);
  freeze.show(scrubber.valueAsNumber);
});

function press(pressed, on) {
  pressed.classList.toggle("us-on", on);
  pressed.setAttribute("aria-pressed", String(on));
}

/** What needs an image waits for the first. */
function showWhetherUsable() {
  for (const made of [freezing, playing, comparing, saving]) {
    made.disabled = !hasImage();
    made.title = made.disabled ? "There is no image yet" : made.dataset.title;
  }
}

function showFreeze() {
  const { frames } = freeze.cine;
  press(freezing, freeze.isFrozen);
  freezing.textContent = freeze.isFrozen ? "Go on" : "Freeze";
  press(playing, freeze.isPlaying);
  playing.textContent = freeze.isPlaying ? "Stop" : "Play";
  scrubber.hidden = moment.hidden = !freeze.isFrozen;
  showFacts();
  if (!freeze.isFrozen || !frames.length) return;
  scrubber.max = frames.length - 1;
  scrubber.value = freeze.number;
  const before = (frames[freeze.number].time - frames.at(-1).time) / 1000;
  moment.textContent = `${before.toFixed(1)} s`;
}

/** How the image was pressed; what else is known of a frozen one, and what it is compared with. */
function showFacts() {
  press(comparing, Boolean(compare.held));
  const frame = frameShown();
  const said = frame && freeze.isFrozen ? othersOf(frame) : [];
  put(pressed, frame ? pressOf(frame).join(" · ") : "");
  put(others, [...said, ...comparedWith(frame)].join(" · "));
}

/** Have an element say these words, unless it does. */
function put(part, words) {
  if (part.textContent !== words) part.textContent = words;
}

function showMeasures() {
  for (const [name, made] of Object.entries(tools)) {
    press(made, overlay.tool === name);
    made.disabled = Boolean(overlay.obstacle);
    made.title = overlay.obstacle || made.dataset.title;
  }
  const isUndo = !overlay.measures.length && overlay.canUndo;
  clearing.textContent = isUndo ? "Undo" : "Clear";
  clearing.title = isUndo
    ? "Have the measurements and texts back (key X)"
    : "Remove the measurements and texts of this image (key X)";
  clearing.disabled = !overlay.measures.length && !isUndo;
  list.replaceChildren(
    ...overlay.measures.map((measure) => {
      const item = document.createElement("li");
      item.style.color = measure.colour;
      const removing = Object.assign(document.createElement("button"), {
        type: "button",
        textContent: "×",
        title: "Remove it",
        onclick: () => overlay.remove(measure),
      });
      removing.setAttribute("aria-label", `Remove ${measure.text}`);
      item.append(measure.text, removing);
      return item;
    }),
  );
}

const KEYS = {
  c: () => freeze.play(),
  ",": () => freeze.show(freeze.number - 1),
  ".": () => freeze.show(freeze.number + 1),
  d: () => overlay.use("distance"),
  o: () => overlay.use("ellipse"),
  t: () => overlay.use("note"),
  x: clearOrUndo,
  v: () => hasImage() && compare.toggle(),
  p: saveChosen,
};
addEventListener("keydown", (event) => {
  if (event.key === "Escape" && overlay.tool) overlay.use(null);
  const isUndo = (event.ctrlKey || event.metaKey) && event.key.toLowerCase() === "z";
  if (isUndo && !event.target.closest?.("input, textarea") && overlay.canUndo) {
    event.preventDefault();
    overlay.undo();
  }
  if (isTyping(event)) return;
  if (event.key === "Enter" && overlay.tool) overlay.place();
  const act = event.key === " " ? () => freeze.toggle() : KEYS[event.key.toLowerCase()] ?? KEYS[event.key];
  if (!act || event.repeat) return;
  event.preventDefault();
  act();
});

freeze.on(showFreeze);
overlay.on(showMeasures);
compare.on(showFacts);
events.on("connection", showFreeze);
events.on("image-shown", showFacts);
events.on("image-drawn", () => freezing.disabled && showWhetherUsable());
showFreeze();
showWhetherUsable();
showMeasures();
