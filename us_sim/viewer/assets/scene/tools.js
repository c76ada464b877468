/** The bar above the scene, and its layers: what is shown, how transparent, and from where. */

import { events } from "../events.js";
import { cut } from "./cut.js";
import { probe } from "./probe.js";
import { skin } from "./skin.js";
import { stage } from "./stage.js";
import { structures } from "./structures.js";
import { targets } from "./targets.js";
import { tissue } from "./tissue.js";
import { VIEWS, view } from "./views.js";

const SKIN = 0.34;
/** Opacity of the skin while one looks under it. */
const UNDER = 0.08;
const TISSUE = [
  ["off", "Off", "No wireframe of the tissue"],
  ["mesh", "Mesh", "Wireframe of the tissue's outer faces"],
  ["displacement", "Displacement", "Wireframe coloured by how far the tissue has moved, mm"],
  ["strain", "Strain", "Wireframe coloured by equivalent strain, %"],
];

/** An element with properties and children; `title` is its tooltip. */
function make(tag, { dataset = {}, ...properties } = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  Object.assign(element.dataset, dataset);
  element.append(...children);
  return element;
}

function button(text, title, onclick, extra = {}) {
  return make("button", { type: "button", textContent: text, title, onclick, ...extra });
}

/** A row with a check box, a name, and a slider of opacity where `onOpacity` is there. */
function row(name, title, { isOn = true, onToggle, opacity, onOpacity, colour }) {
  const box = make("input", { type: "checkbox", checked: isOn });
  box.addEventListener("change", () => onToggle(box.checked));
  const swatch = make("i", { className: "us-swatch" });
  if (colour) swatch.style.background = colour;
  const label = make("label", { title }, box, ...(colour ? [swatch] : []), name);
  const line = make("div", { className: "us-row", dataset: { layer: name.toLowerCase() } }, label);
  if (!onOpacity) return { line, box };
  const slider = make("input", { type: "range", min: 5, max: 100, step: 1, value: 100 * opacity });
  slider.setAttribute("aria-label", `Opacity of ${name.toLowerCase()}, percent`);
  const value = make("span", { className: "us-value", textContent: `${slider.value} %` });
  slider.title = `Opacity of ${name.toLowerCase()}`;
  slider.addEventListener("input", () => {
    value.textContent = `${slider.value} %`;
    onOpacity(slider.value / 100);
  });
  line.append(slider, value);
  return { line, box, slider, value };
}

const skinRow = row("Skin", "Show the skin", {
  onToggle: (on) => skin.setVisible(on),
  opacity: SKIN,
  onOpacity: (value) => setSkin(value),
});
const imageRow = row("Image", "Show the image on its plane", {
  onToggle: (on) => probe.setVisible("image", on),
  opacity: 1,
  onOpacity: (value) => probe.setImageOpacity(value),
});
const structuresRow = row("Structures", "Show vessels, nerves and bones", {
  onToggle: (on) => {
    structures.group.visible = on;
    stage.move();
  },
  opacity: 1,
  onOpacity: (value) => structures.setOpacity(value),
});
const parts = make("div", { className: "us-parts" });
const tissueButtons = TISSUE.map(([mode, name, title]) =>
  button(name, title, () => showTissue(mode), { dataset: { tissue: mode } }),
);
const panel = make(
  "div",
  { className: "us-layers", hidden: true, id: "us-layers" },
  skinRow.line,
  structuresRow.line,
  parts,
  imageRow.line,
  row("Probe", "Show the transducer", { onToggle: (on) => probe.setVisible("probe", on) }).line,
  row("Force", "Show the tissue's force on the probe, in N", {
    onToggle: (on) => probe.setVisible("force", on),
  }).line,
  row("Targets", "Show where the exercise is to be done: next in blue, done in green", {
    onToggle: (on) => targets.setVisible(on),
  }).line,
  make("div", { className: "us-caption", textContent: "Tissue" }),
  make("div", { className: "us-choice", role: "group" }, ...tissueButtons),
);

const layers = button("Layers", "What is shown, and how transparent", () => open(panel.hidden));
layers.setAttribute("aria-expanded", "false");
layers.setAttribute("aria-controls", "us-layers");
const under = button("Look under the skin", "Fade the skin, to see the structures below it", () =>
  setUnder(!under.classList.contains("us-on")),
);
under.dataset.tool = "under";

const cutting = button("Cut", "Cut away what lies before the image's plane", () =>
  cut.set(!cut.isOn),
);
cutting.dataset.tool = "cut";
events.on("scene-cut", (on) => {
  cutting.classList.toggle("us-on", on);
  cutting.setAttribute("aria-pressed", String(on));
});

const views = VIEWS.map(([name, text, title]) =>
  button(text, title, () => view(name), { dataset: { view: name } }),
);
views.push(button("Fit", "Everything, from here (key 6)", () => view("fit"), { dataset: { view: "fit" } }));

const bar = make(
  "div",
  { className: "us-tools" },
  layers,
  under,
  cutting,
  make("div", { className: "us-tools-views", role: "group", ariaLabel: "Views" }, ...views),
);
bar.setAttribute("role", "toolbar");
bar.setAttribute("aria-label", "3D view");
stage.place.before(bar);
stage.place.prepend(panel);

function open(on) {
  panel.hidden = !on;
  layers.setAttribute("aria-expanded", String(on));
  layers.classList.toggle("us-on", on);
}

addEventListener("keydown", (event) => {
  if (event.key !== "Escape" || panel.hidden || event.target.closest?.("dialog, .q-dialog")) return;
  if (panel.contains(document.activeElement)) layers.focus();
  open(false);
});

let chosen = SKIN;

function setSkin(value) {
  chosen = value;
  setUnder(false);
}

function setUnder(on) {
  under.classList.toggle("us-on", on);
  under.setAttribute("aria-pressed", String(on));
  skin.setOpacity(on ? UNDER : chosen);
}

function showTissue(mode) {
  tissue.show(mode);
}

events.on("tissue-shown", (mode) => {
  for (const one of tissueButtons) {
    one.classList.toggle("us-on", one.dataset.tissue === mode);
    one.setAttribute("aria-pressed", String(one.dataset.tissue === mode));
  }
});

events.on("structures", (found) => {
  parts.replaceChildren(
    ...found.map(({ name, colour, isShown }) => {
      const onToggle = (on) => structures.setVisible(name, on);
      return row(name, `Show the ${name}`, { colour, isOn: isShown, onToggle }).line;
    }),
  );
});

tissue.show("off");
setUnder(false);
cut.set(false);

/**
 * Show or hide "skin", "structures", "tissue", "probe", "image", "force" or "targets"; or one
 * structure.
 */
export function setVisible(name, on) {
  if (name === "tissue") return tissue.show(on ? "mesh" : "off");
  const line = panel.querySelector(`[data-layer="${CSS.escape(name)}"] input[type=checkbox]`);
  if (!line) throw new Error(`there is nothing in the scene named ${name}`);
  line.checked = on;
  line.dispatchEvent(new Event("change"));
  return undefined;
}

/** Of "skin", "structures" or "image": 0 to 1. */
export function setOpacity(name, value) {
  const line = panel.querySelector(`[data-layer="${CSS.escape(name)}"] input[type=range]`);
  if (!line) throw new Error(`nothing in the scene named ${name} has an opacity`);
  line.value = String(Math.round(100 * value));
  line.dispatchEvent(new Event("input"));
}
