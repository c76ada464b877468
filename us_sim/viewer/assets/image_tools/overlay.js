/**
 * Draws what is measured over the image, and lets its points be dragged.
 *
 * A measure belongs to the frame that it was made on, and is seen with that frame only. So who takes
 * a tool freezes the image: the next one would be without it.
 */

import { element, events } from "../events.js";
import { frameShown, imageBox } from "../image.js";
import { freeze } from "./freeze.js";
import { Distance, Ellipse, Note } from "./measures.js";
import { plane } from "./plane.js";

const SVG = "http://www.w3.org/2000/svg";
const COLOURS = ["#ffd166", "#6fd08c", "#ff9f68", "#8fb8ff", "#f28fd0"];
const KINDS = { distance: Distance, ellipse: Ellipse, note: Note };
/** CSS pixels by which an arrow key moves a point, and with shift. */
const NUDGE = 1;
const FAR = 10;
/** Part of the image's width from its middle to an end of what is put there by keys. */
const REACH = 0.1;

const place = await element("ultrasound");
const sheet = document.createElementNS(SVG, "svg");
sheet.classList.add("us-measures");
sheet.setAttribute("aria-label", "Measurements");
place.append(sheet);

const handlers = [];
let tool = null;
let drag = null;
/** The header of the last B-mode image; the annotated one is drawn over it. */
let plain = null;
/** Why nothing can be measured, for a person. */
let obstacle = "There is no image yet";

/** The measures of the frame that is shown. */
function measuresShown() {
  return frameShown()?.measures ?? [];
}

function draw() {
  const map = obstacle ? null : plane();
  const measures = measuresShown();
  const focused = document.activeElement?.dataset?.point;
  sheet.replaceChildren();
  if (map) for (const [number, measure] of measures.entries()) drawOne(measure, number, map);
  if (focused) sheet.querySelector(`[data-point="${focused}"]`)?.focus();
  for (const handle of handlers) handle();
}

function add(kind, attributes, parent = sheet) {
  const made = document.createElementNS(SVG, kind);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  parent.append(made);
  return made;
}

function drawOne(measure, number, map) {
  const places = measure.points.map((point) => map.toScreen(point));
  const group = add("g", { stroke: measure.colour, fill: "none", "stroke-width": 1.6 });
  const [[x, y]] = places;
  if (measure instanceof Distance) {
    add("line", { x1: x, y1: y, x2: places[1][0], y2: places[1][1], "stroke-dasharray": "5 4" }, group);
  } else if (measure instanceof Ellipse) {
    add("path", { d: outline(measure, map) }, group);
  }
  for (const [index, at] of places.entries()) drawPoint(measure, number, index, at, group);
  if (measure instanceof Note) write(measure.words, x + 8, y + 5, measure.colour, group);
  else write(`${number + 1}`, places[1][0] + 9, places[1][1] - 7, measure.colour, group);
}

function outline(ellipse, map) {
  const [x, y] = ellipse.centre;
  const [a, b] = ellipse.halves;
  const c = Math.cos(ellipse.angle);
  const s = Math.sin(ellipse.angle);
  const points = Array.from({ length: 72 }, (_, i) => {
    const u = a * Math.cos((i * Math.PI) / 36);
    const v = b * Math.sin((i * Math.PI) / 36);
    return map.toScreen([x + c * u - s * v, y + s * u + c * v]).map((n) => n.toFixed(2)).join(",");
  });
  return `M${points.join("L")}Z`;
}

function drawPoint(measure, number, index, [x, y], group) {
  add("path", { d: `M${x - 6},${y}h12M${x},${y - 6}v12` }, group);
  const handle = add("circle", { cx: x, cy: y, r: 11, class: "us-handle", tabindex: 0 }, group);
  handle.dataset.point = `${number} ${index}`;
  handle.setAttribute("role", "button");
  handle.setAttribute("aria-label", `Point ${index + 1} of measure ${number + 1}: ${measure.text}`);
  const title = document.createElementNS(SVG, "title");
  title.textContent = "Drag, or move with the arrow keys, with Shift farther; Delete removes it";
  handle.append(title);
}

function write(text, x, y, colour, group) {
  const label = { x, y, fill: colour, stroke: "#000", "stroke-width": 3, "paint-order": "stroke" };
  add("text", label, group).textContent = text;
}

function at(event) {
  const box = place.getBoundingClientRect();
  return [event.clientX - box.left, event.clientY - box.top];
}

function pointOf(target) {
  const [number, index] = target.dataset.point.split(" ").map(Number);
  return { measure: measuresShown()[number], index };
}

/** A measure of the tool in hand between points, mm, in a colour of its own; a text is asked for. */
function begin(...points) {
  const measures = measuresShown();
  const isFree = (colour) => measures.every((other) => other.colour !== colour);
  const colour = COLOURS.find(isFree) ?? COLOURS[measures.length % COLOURS.length];
  const measure = Object.assign(new KINDS[tool](...points), { colour });
  if (tool !== "note") measures.push(measure);
  else {
    askWords(measure);
    overlay.use(null);
  }
  return measure;
}

sheet.addEventListener("pointerdown", (event) => {
  const map = plane();
  if (event.button !== 0 || !map) return;
  if (tool) {
    const point = map.toImage(at(event));
    const measure = begin(point);
    if (measure instanceof Note) {
      event.preventDefault();
      event.stopPropagation();
      return;
    }
    drag = { measure, index: 1, from: point };
  } else if (event.target.dataset?.point) {
    const taken = pointOf(event.target);
    event.target.focus();
    drag = { ...taken, from: taken.measure.points[taken.index] };
  } else return;
  event.stopPropagation();
  event.preventDefault();
  const grip = map.toScreen(drag.from);
  const [x, y] = at(event);
  drag.offset = tool ? [0, 0] : [grip[0] - x, grip[1] - y];
  sheet.setPointerCapture(event.pointerId);
  draw();
});

sheet.addEventListener("pointermove", (event) => {
  if (!drag) return;
  const [x, y] = at(event);
  drag.measure.move(drag.index, plane().toImage([x + drag.offset[0], y + drag.offset[1]]));
  draw();
});

for (const name of ["pointerup", "pointercancel"]) {
  sheet.addEventListener(name, () => {
    if (!drag) return;
    if (drag.measure.isTooSmall) remove(drag.measure);
    else if (tool) overlay.use(null);
    drag = null;
    draw();
  });
}

const STEPS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
sheet.addEventListener("keydown", (event) => {
  if (!event.target.dataset?.point) return;
  const { measure, index } = pointOf(event.target);
  if (event.key === "Delete" || event.key === "Backspace") overlay.remove(measure);
  else if (event.key in STEPS) {
    const map = plane();
    const [x, y] = map.toScreen(measure.points[index]);
    const [dx, dy] = STEPS[event.key].map((way) => way * (event.shiftKey ? FAR : NUDGE));
    measure.move(index, map.toImage([x + dx, y + dy]));
  } else return;
  event.preventDefault();
  event.stopPropagation();
  draw();
});

sheet.addEventListener("dblclick", (event) => {
  const found = event.target.dataset?.point && pointOf(event.target).measure;
  if (found instanceof Note) askWords(found);
});

/** Let the person write the words of a note where it is. */
function askWords(note) {
  const { measures } = frameShown();
  const entry = document.createElement("input");
  Object.assign(entry, { className: "us-words", value: note.words, maxLength: 60 });
  entry.setAttribute("aria-label", "Text on the image; Enter ends it");
  const [x, y] = plane().toScreen(note.points[0]);
  Object.assign(entry.style, { left: `${x}px`, top: `${y - 14}px` });
  place.append(entry);
  entry.focus();
  let isOver = false;
  const end = (isKept) => {
    if (isOver) return;
    isOver = true;
    if (isKept) note.words = entry.value.trim();
    entry.remove();
    if (note.isTooSmall) remove(note, measures);
    else if (!measures.includes(note)) measures.push(note);
    draw();
  };
  entry.addEventListener("pointerdown", (event) => event.stopPropagation());
  entry.addEventListener("keydown", (event) => {
    if (event.key === "Enter") end(true);
    if (event.key === "Escape") end(false);
    event.stopPropagation();
  });
  entry.addEventListener("blur", () => end(true));
}

function remove(measure, measures = measuresShown()) {
  const index = measures.indexOf(measure);
  if (index >= 0) measures.splice(index, 1);
}

/** Remember what there is on the frame that is shown, for `undo`. */
function remember() {
  const frame = frameShown();
  if (frame?.measures.length) frame.removed = [...frame.measures];
}

export const overlay = {
  sheet,

  /** What there is on the frame that is shown, as it was made; each has `text`, `points` and `colour`. */
  get measures() {
    return measuresShown();
  },

  /** Whether something was removed from that frame that can come back. */
  get canUndo() {
    return Boolean(frameShown()?.removed);
  },

  /** "distance", "ellipse", "note", or null. */
  get tool() {
    return tool;
  },

  /** Why the image that is shown cannot be measured, for a person; "" where it can. */
  get obstacle() {
    return obstacle;
  },

  /** Have `handler()` called when something of it has changed. */
  on(handler) {
    handlers.push(handler);
  },

  /** Take a tool in hand, for one measurement, and freeze; the same again puts it away. */
  use(wanted) {
    tool = wanted === tool || obstacle ? null : wanted;
    sheet.classList.toggle("us-measuring", tool !== null);
    events.tell("image-tool", tool);
    if (tool) freeze.hold();
    draw();
  },

  /** Use the tool in hand in the middle of the image, without a pointer; arrows move its points. */
  place() {
    const map = tool && plane();
    if (!map) return;
    const { left, top, width, height } = imageBox();
    const across = (part) => map.toPlane([left + part * width, top + height / 2]);
    if (tool === "note") begin(across(0.5));
    else {
      begin(across(0.5 - REACH), across(0.5 + REACH));
      overlay.use(null);
      sheet.querySelector(`[data-point="${measuresShown().length - 1} 0"]`).focus();
    }
  },

  remove(measure) {
    remember();
    remove(measure);
    draw();
  },

  /** Remove everything from the frame that is shown. */
  clear() {
    remember();
    measuresShown().length = 0;
    draw();
  },

  /** Have what was removed last from that frame back. */
  undo() {
    const frame = frameShown();
    if (!frame?.removed) return;
    frame.measures.push(...frame.removed.filter((measure) => !frame.measures.includes(measure)));
    frame.removed = null;
    draw();
  },
};

new ResizeObserver(draw).observe(place);
freeze.on(() => {
  if (freeze.isFrozen) return;
  drag = null;
  if (tool) overlay.use(null);
});
events.on("image-shown", ({ header, measures, removed }) => {
  const { kind, columns, rows } = header;
  if (kind !== "annotated") plain = header;
  const isSame = plain && String(plain.matrix) === String(header.matrix);
  const isLikePlain = !isSame || (plain.columns === columns && plain.rows === rows);
  block(isLikePlain ? "" : "This picture has another size than the B-mode image, whose scale is known");
  if (sheet.childElementCount || measures.length || removed) draw();
});

/** Say why nothing can be measured, or that it can. */
function block(why) {
  const wanted = plane() ? why : "It is not known yet where in the patient the image's pixels are";
  if (wanted === obstacle) return;
  obstacle = wanted;
  if (obstacle) overlay.use(null);
  else draw();
}
