/** Freezing the image, and looking through the last seconds before that. */

import { events } from "../events.js";
import { hand } from "../hand/hand.js";
import { drawKept, hasImage, isOfOtherScene, onImage, setLive } from "../image.js";
import { stream } from "../stream.js";
import { Cine } from "./cine.js";

const cine = new Cine();
let number = 0;
let isFrozen = false;
let playing = null;
const handlers = [];

function tell() {
  for (const handle of handlers) handle();
}

onImage((frame) => cine.keep(frame));
events.on("scene", () => isFrozen && isOfOtherScene() && freeze.toggle());

export const freeze = {
  cine,

  /** Have `handler()` called when something of it has changed. */
  on(handler) {
    handlers.push(handler);
  },

  get isFrozen() {
    return isFrozen;
  },

  get isPlaying() {
    return playing !== null;
  },

  /** The number of the image that is shown, of those that are kept. */
  get number() {
    return number;
  },

  /** Hold the newest image, or go on with those that come; nothing before the first. */
  toggle() {
    if (!hasImage()) return;
    isFrozen = !isFrozen;
    playing = null;
    number = Math.max(0, cine.frames.length - 1);
    setLive(!isFrozen);
    events.tell("image-frozen", isFrozen);
    if (isFrozen && !hand.isWatching && !hand.isHeldElsewhere) stream.send({ frozen: true });
    tell();
  },

  /** Freeze, if that is not so yet, and stand still. */
  hold() {
    if (!isFrozen) this.toggle();
    else if (playing) this.play(false);
  },

  /** Show one of the kept images; freezes. */
  async show(wanted) {
    if (!hasImage()) return;
    if (!isFrozen) this.toggle();
    number = Math.min(Math.max(wanted, 0), cine.frames.length - 1);
    const frame = cine.frames[number];
    if (frame) await drawKept(frame);
    tell();
  },

  /** Play them as fast as they came, again and again, or stop. */
  play(on = !playing) {
    if (!hasImage()) return;
    if (!isFrozen) this.toggle();
    const { frames } = cine;
    if (!on || frames.length < 2) {
      playing = null;
      tell();
      return;
    }
    const from = number === frames.length - 1 ? 0 : frames[number].time - frames[0].time;
    playing = { began: performance.now() - from };
    requestAnimationFrame(turn);
    tell();
  },
};

async function turn() {
  if (!playing) return;
  const elapsed = (performance.now() - playing.began) % (cine.duration + 100);
  const wanted = cine.at(elapsed);
  if (wanted !== number) await freeze.show(wanted);
  requestAnimationFrame(turn);
}
