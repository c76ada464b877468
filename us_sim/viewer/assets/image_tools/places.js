/**
 * Where Doppler and M-mode look, over the image: the colour box, the gate and the line are dragged
 * by their borders, or moved with the arrow keys.
 *
 * A place is a fraction across the face, from -0.5 to 0.5, and a depth along the beam, m, as the
 * node's parameters say it. Beams are those of the outline that comes with `probe_mesh`.
 */

import { element, events } from "../events.js";
import { stream } from "../stream.js";
import { plane } from "./plane.js";

const SVG = "http://www.w3.org/2000/svg";
const NAMES = { colour: "Colour box", spectrum: "Gate of the spectrum", m_mode: "Line of M-mode" };
/** ms between two wishes while it is dragged, and after which what was not granted is forgotten. */
const EVERY_MS = 150;
const FORGOTTEN_MS = 1500;
/** m and part of the face that an arrow key moves by. */
const DOWN = 0.0005;
const ACROSS = 0.01;
/** m, half the width of the gate's ends; points along a side of the box. */
const GATE = 0.0015;
const SIDE = 12;

const place = await element("ultrasound");
const sheet = document.createElementNS(SVG, "svg");
sheet.classList.add("us-places");
sheet.setAttribute("aria-label", "Where Doppler and M-mode look");
place.append(sheet);

let told = []; // {kind, lateral, depth, steering, width, height, size}, of what is shown
let wished = null; // {kind, lateral, depth, time}
let drag = null;
let sent = 0;
let isMeasuring = false;

/** {starts, directions} of the beams from one end of the face to the other, m; null if not known. */
function beams() {
  const { header, payload } = stream.latest("probe_mesh") ?? {};
  const count = (header?.outline ?? 0) / 2;
  if (!count) return null;
  const floats = new Float32Array(payload.slice(-24 * count).buffer);
  const at = (k) => [floats[3 * k], floats[3 * k + 2]];
  const starts = Array.from({ length: count }, (_, k) => at(k));
  const directions = starts.map(([x, z], k) => {
    const [endX, endZ] = at(2 * count - 1 - k);
    const length = Math.hypot(endX - x, endZ - z);
    return [(endX - x) / length, (endZ - z) / length];
  });
  return { starts, directions };
}

/** What is known of each beam, at a fraction across the face. */
function between(list, fraction) {
  const at = (fraction + 0.5) * (list.length - 1);
  const low = Math.min(Math.max(Math.floor(at), 0), list.length - 2);
  return [0, 1].map((i) => list[low][i] + (at - low) * (list[low + 1][i] - list[low][i]));
}

const turned = ([x, z], angle) => [
  x * Math.cos(angle) + z * Math.sin(angle),
  z * Math.cos(angle) - x * Math.sin(angle),
];

/** [x, z] mm in frame `probe` of a place along beams that are steered from the face on. */
function toPlane({ starts, directions }, lateral, depth, steering = 0) {
  const [x, z] = between(starts, lateral);
  const [dx, dz] = turned(between(directions, lateral), steering);
  return [1000 * (x + depth * dx), 1000 * (z + depth * dz)];
}

/** The place {lateral, depth} at [x, z] mm: where it passes from one side of a beam to the other. */
function toPlace({ starts, directions }, [x, z], steering = 0) {
  const seen = starts.map(([sx, sz], k) => {
    const [dx, dz] = turned(directions[k], steering);
    const [px, pz] = [x / 1000 - sx, z / 1000 - sz];
    return { beside: px * dz - pz * dx, along: px * dx + pz * dz };
  });
  let k = seen.findIndex(({ beside }, i) => i > 0 && beside < 0);
  if (k < 0) k = seen.length - 1;
  const [a, b] = [seen[k - 1], seen[k]];
  const part = a.beside / (a.beside - b.beside);
  const lateral = (k - 1 + part) / (seen.length - 1) - 0.5;
  return { lateral, depth: a.along + part * (b.along - a.along) };
}

/** Lines, each of points in mm, that show a place. */
function linesOf(known, map) {
  const { kind, lateral, depth, steering } = known;
  if (kind === "m_mode") return [[toPlane(map, lateral, 0), toPlane(map, lateral, known.deepest)]];
  if (kind === "spectrum") {
    const [x, z] = toPlane(map, lateral, depth, steering);
    const [dx, dz] = turned(between(map.directions, lateral), steering);
    return [-0.5, 0.5].map((end) =>
      [-GATE, GATE].map((wide) => [
        x + 1000 * (end * known.size * dx + wide * dz),
        z + 1000 * (end * known.size * dz - wide * dx),
      ]),
    );
  }
  const [left, right] = [-0.5, 0.5].map((end) => clamped(lateral + end * known.width, -0.5, 0.5));
  const [top, bottom] = [-0.5, 0.5].map((end) => clamped(depth + end * known.height, 0, known.deepest));
  const parts = Array.from({ length: SIDE + 1 }, (_, i) => i / SIDE);
  const corner = (across, down) => {
    const [x, z] = toPlane(map, left + across * (right - left), top + down * (bottom - top));
    return [x + 1000 * (top + down * (bottom - top) - depth) * Math.tan(steering), z];
  };
  return [
    [
      ...parts.map((part) => corner(part, 0)),
      ...parts.map((part) => corner(1, part)),
      ...parts.map((part) => corner(1 - part, 1)),
      ...parts.map((part) => corner(0, 1 - part)),
    ],
  ];
}

const clamped = (value, low, high) => Math.min(Math.max(value, low), high);

/** As the node has it, or as it is wished for. */
function current(known) {
  return wished?.kind === known.kind ? { ...known, ...wished } : known;
}

function draw() {
  const [screen, map] = [plane(), beams()];
  const focused = document.activeElement?.dataset?.place;
  sheet.replaceChildren();
  if (!screen || !map || isMeasuring) return;
  for (const known of told) {
    const d = linesOf(current(known), map)
      .map((line) => `M${line.map((point) => screen.toScreen(point).map((n) => n.toFixed(1)).join(",")).join("L")}`)
      .join("");
    for (const name of stream.isWatching ? ["us-place"] : ["us-place", "us-grip"]) {
      const path = document.createElementNS(SVG, "path");
      path.setAttribute("d", d);
      path.classList.add(name);
      if (drag?.kind === known.kind) path.classList.add("us-moved");
      sheet.append(path);
      if (name === "us-place") continue;
      path.dataset.place = known.kind;
      path.tabIndex = 0;
      path.setAttribute("role", "button");
      path.setAttribute("aria-label", `${NAMES[known.kind]}: drag it, or move it with the arrow keys`);
      const title = document.createElementNS(SVG, "title");
      title.textContent = `${NAMES[known.kind]}: drag it`;
      path.append(title);
    }
  }
  if (focused) sheet.querySelector(`[data-place="${focused}"]`)?.focus();
}

/** Wish a place, and tell the node: at once if it is the last one. */
function wish(kind, lateral, depth, isLast) {
  const { deepest } = told.find((known) => known.kind === kind);
  const now = performance.now();
  wished = {
    kind,
    lateral: clamped(lateral, -0.5, 0.5),
    depth: clamped(depth, 0.001, 0.99 * deepest),
    time: now,
  };
  draw();
  if (!isLast && now - sent < EVERY_MS) return;
  sent = now;
  const { time, ...detail } = wished;
  document.querySelector(".us-modes").dispatchEvent(new CustomEvent("us-place", { detail }));
}

function at(event) {
  const box = place.getBoundingClientRect();
  return plane().toPlane([event.clientX - box.left, event.clientY - box.top]);
}

/** The beams of a box are steered about its middle, those of a gate from the face on. */
const steeringOf = ({ kind, steering }) => (kind === "spectrum" ? steering : 0);

sheet.addEventListener("pointerdown", (event) => {
  const kind = event.target.dataset?.place;
  if (!kind || event.button !== 0) return;
  const known = current(told.find((each) => each.kind === kind));
  const [x, z] = at(event);
  const [toX, toZ] = toPlane(beams(), known.lateral, known.depth, steeringOf(known));
  drag = { kind, steering: steeringOf(known), offset: [toX - x, toZ - z] };
  sheet.setPointerCapture(event.pointerId);
  event.stopPropagation();
  event.preventDefault();
  draw();
});

sheet.addEventListener("pointermove", (event) => drag && move(event, false));

for (const name of ["pointerup", "pointercancel"]) {
  sheet.addEventListener(name, (event) => {
    if (!drag) return;
    move(event, true);
    drag = null;
    draw();
  });
}

function move(event, isLast) {
  const [x, z] = at(event);
  const { lateral, depth } = toPlace(beams(), [x + drag.offset[0], z + drag.offset[1]], drag.steering);
  wish(drag.kind, lateral, depth, isLast);
}

const STEPS = {
  ArrowLeft: [-ACROSS, 0],
  ArrowRight: [ACROSS, 0],
  ArrowUp: [0, -DOWN],
  ArrowDown: [0, DOWN],
};
sheet.addEventListener("keydown", (event) => {
  const kind = event.target.dataset?.place;
  if (!kind || !(event.key in STEPS)) return;
  const known = current(told.find((each) => each.kind === kind));
  const [across, down] = STEPS[event.key];
  const [left, right] = [-0.5, 0.5].map((end) => plane().toScreen(toPlane(beams(), end, 0.01))[0]);
  wish(kind, known.lateral + (left < right ? across : -across), known.depth + down, true);
  event.preventDefault();
  event.stopPropagation();
});

/** What is shown, as the node's parameters have it. */
export function setPlaces(shown) {
  told = shown;
  if (!drag) wished = null;
  draw();
}

setInterval(() => {
  if (!wished || drag || performance.now() - wished.time < FORGOTTEN_MS) return;
  wished = null;
  draw();
}, FORGOTTEN_MS / 3);
new ResizeObserver(draw).observe(place);
stream.on("probe_mesh", draw);
events.on("image-geometry", draw);
events.on("image-tool", (tool) => {
  isMeasuring = tool !== null;
  draw();
});
