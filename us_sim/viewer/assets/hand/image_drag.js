/**
 * Dragging over the ultrasound image moves the probe: down presses, sideways slides; with two
 * fingers turning rotates. The wheel presses. Lengths are those of the image. A frozen image would
 * not show that, so there the probe stays.
 */

import { element, events } from "../events.js";
import { imageBox, imageCanvas, pixelToMillimetres, remindFrozen } from "../image.js";
import { Fingers } from "./fingers.js";
import { hand } from "./hand.js";

/** CSS pixels after which a drag is either a press or a slide, for as long as it lasts. */
const DECIDED = 5;
/** m a notch of the wheel. */
const NOTCH = 0.0005;
/** m a pixel, until the image says it. */
const UNKNOWN = 1e-4;

const place = await element("ultrasound");
const fingers = new Fingers();
let isTaken = false;
let isFrozen = false;
let travelled = [0, 0];
let mode = null;

events.on("image-tool", (tool) => (isTaken = tool !== null));
events.on("image-frozen", (on) => (isFrozen = on));

function metresPerPixel() {
  const from = pixelToMillimetres(0, 0);
  const to = pixelToMillimetres(0, 1);
  if (!from || !to) return UNKNOWN;
  return ((to[1] - from[1]) * imageCanvas().height) / imageBox().height / 1000;
}

/** Whether the probe's x goes to the left. */
function isFlipped() {
  const from = pixelToMillimetres(0, 0);
  return Boolean(from) && pixelToMillimetres(1, 0)[0] < from[0];
}

place.addEventListener("pointerdown", (event) => {
  if (isTaken || event.button !== 0 || event.defaultPrevented || event.target.closest("button")) return;
  if (fingers.count === 0) {
    travelled = [0, 0];
    mode = null;
  }
  fingers.moved(event);
  place.setPointerCapture(event.pointerId);
  place.classList.add("us-dragging");
});

place.addEventListener("pointermove", (event) => {
  if (!place.hasPointerCapture(event.pointerId)) return;
  const { right, down, turn } = fingers.moved(event);
  if (isFrozen) {
    remindFrozen();
    return;
  }
  travelled = [travelled[0] + right, travelled[1] + down];
  const scale = metresPerPixel();
  if (fingers.count > 1) {
    hand.ask({ by: { press: down * scale, rotation: turn } }, event.timeStamp);
    return;
  }
  if (!mode) {
    if (Math.hypot(...travelled) < DECIDED) return;
    mode = Math.abs(travelled[1]) >= Math.abs(travelled[0]) ? "press" : "slide";
  }
  const across = isFlipped() ? -right : right;
  const by = mode === "press" ? { press: down * scale } : { slide: [across * scale, 0] };
  hand.ask({ by }, event.timeStamp);
});

for (const name of ["pointerup", "pointercancel"]) {
  place.addEventListener(name, (event) => {
    fingers.left(event);
    if (!fingers.count) place.classList.remove("us-dragging");
  });
}

place.addEventListener(
  "wheel",
  (event) => {
    event.preventDefault();
    if (isFrozen) {
      remindFrozen();
      return;
    }
    const notches = event.deltaMode === 0 ? event.deltaY / 100 : event.deltaY / 3;
    hand.ask({ by: { press: notches * NOTCH } }, event.timeStamp);
  },
  { passive: false },
);
