/** The last seconds of images, as the bytes that came. */

/** ms, and bytes, of images that are kept at most. */
const KEPT_MS = 10_000;
const KEPT_BYTES = 96 * 2 ** 20;

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

  /** Keep a frame; those that are too old, or too many, are let go. */
  keep(frame) {
    const { time } = frame;
    this.#frames.push(frame);
    this.#bytes += frame.payload.byteLength;
    let old = 0;
    let bytes = this.#bytes;
    while (
      old < this.#frames.length - 1 &&
      (time - this.#frames[old].time > KEPT_MS || bytes > KEPT_BYTES)
    ) {
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
