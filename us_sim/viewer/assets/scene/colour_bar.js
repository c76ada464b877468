/** Colours of numbers, and the bar that says which is which. */

import { stage } from "./stage.js";

/** From dark blue over teal to yellow: evenly brighter, also for eyes that see no red. */
const STOPS = [
  [0.27, 0.25, 0.53],
  [0.19, 0.41, 0.56],
  [0.13, 0.57, 0.55],
  [0.37, 0.79, 0.38],
  [0.99, 0.91, 0.15],
];
const QUANTITIES = {
  displacement: { title: "Displacement", unit: "mm" },
  strain: { title: "Equivalent strain", unit: "%" },
};

const box = document.createElement("div");
box.className = "us-colour-bar";
box.hidden = true;
const title = document.createElement("span");
const bar = document.createElement("div");
bar.style.background = `linear-gradient(to right, ${STOPS.map(
  ([r, g, b]) => `rgb(${255 * r}, ${255 * g}, ${255 * b})`,
).join(", ")})`;
const numbers = document.createElement("div");
numbers.className = "us-colour-numbers";
box.append(title, bar, numbers);
stage.place.append(box);
let shown = "";

/** Fill `colours` (3 for each value) with those of values from 0 to `end`. */
export function colourMap(values, end, colours) {
  const last = STOPS.length - 1;
  for (let n = 0; n < values.length; n++) {
    const place = Math.min(last, Math.max(0, (values[n] / end) * last)) || 0;
    const first = Math.min(last - 1, Math.floor(place));
    const part = place - first;
    for (let c = 0; c < 3; c++) {
      const value = STOPS[first][c] * (1 - part) + STOPS[first + 1][c] * part;
      colours[3 * n + c] = value * value; // lines are drawn in linear light, about its square
    }
  }
}

export const colourBar = {
  /** Of a quantity, from 0 to `end` in its unit. */
  show(quantity, end) {
    const text = `${quantity} ${end}`;
    box.hidden = false;
    if (text === shown) return;
    shown = text;
    const { title: name, unit } = QUANTITIES[quantity];
    title.textContent = `${name} (${unit})`;
    numbers.replaceChildren(
      ...[0, 0.25, 0.5, 0.75, 1].map((part) => {
        const number = document.createElement("span");
        number.textContent = String(+(part * end).toPrecision(3));
        return number;
      }),
    );
  },

  hide() {
    box.hidden = true;
  },
};
