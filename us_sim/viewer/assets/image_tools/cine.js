/** The last seconds of images, as the bytes that came. */

/** ms, and bytes, of images that are kept at most. */
const KEPT_MS = 10_000;
const KEPT_BYTES = 96 * 2 ** 20;

/** ms without an image after which an earlier one is no late one: the clock was set back. */
const RESENT_MS = 1000;

/** When a frame was taken, ms of the simulation's clock. */
function taken({ header }) {
  return 1e-6 * Number(header.stamp);
}

export class Cine {
  #frames = [];
  #bytes = 0;

  /** The frames, oldest first. */
  get frames() {
    return this.#frames;
  }

  /** Bytes that are held. */
  get bytes() {
    return this.#bytes;
  }

  /** Keep a frame; those that are too old, too many, or of another scene are let go. */
  keep(frame) {
    const { time, header } = frame;
    const newest = this.#frames.at(-1);
    const isBack = newest && taken(frame) < taken(newest);
    // Who begins to watch a kind of image is sent the last one at once, however old it is.
    if (isBack && time - newest.time < RESENT_MS) return;
    if (isBack || newest?.header.scene !== header.scene) this.#frames = [];
    this.#frames.push(frame);
    const isOld = (other) =>
      time - other.time > KEPT_MS || taken(frame) - taken(other) > KEPT_MS;
    let bytes = this.#frames.reduce((sum, { payload }) => sum + payload.byteLength, 0);
    let old = 0;
    while (old < this.#frames.length - 1 && (isOld(this.#frames[old]) || bytes > KEPT_BYTES)) {
      bytes -= this.#frames[old].payload.byteLength;
      old += 1;
    }
    this.#frames.splice(0, old);
    this.#bytes = bytes;
  }

  /** The number of the image that was shown so many ms after the first. */
  at(elapsed) {
    const [first] = this.#frames;
    let number = 0;
    while (
      number < this.#frames.length - 1 &&
      this.#frames[number + 1].time - first.time <= elapsed
    ) {
      number += 1;
    }
    return number;
  }

  /** ms from the first image to the last. */
  get duration() {
    return this.#frames.length ? this.#frames.at(-1).time - this.#frames[0].time : 0;
  }
}
