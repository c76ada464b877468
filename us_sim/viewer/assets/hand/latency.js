/**
 * How long it takes from what a person does to the first image that shows it.
 *
 * The viewer says with each image which wish of which page its pose contains. What counts begins
 * with the pointer's own event and ends with the frame in which the page is painted with it.
 */

/** Measured values that are kept. */
const KEPT = 500;
/** ms after which a wish is given up: nothing was imaged, as with the probe in the air. */
const GIVEN_UP_MS = 2000;

const open = new Map();
let measured = [];

function quantile(sorted, fraction) {
  return sorted[Math.min(sorted.length - 1, Math.floor(fraction * sorted.length))];
}

export const latency = {
  /** A wish was sent that follows from what happened at `time`, ms of `performance.now()`. */
  asked(sequence, time) {
    for (const [number, began] of open) {
      if (time - began > GIVEN_UP_MS) open.delete(number);
      else break;
    }
    open.set(sequence, time);
  },

  /** An image is painted that contains the wish of that number, and so all before it. */
  seen(sequence) {
    const now = performance.now();
    for (const [number, began] of open) {
      if (number > sequence) break;
      open.delete(number);
      measured.push(now - began);
    }
    if (measured.length > KEPT) measured = measured.slice(-KEPT);
  },

  /** {median, p99, last} ms and count; without any, only the count. */
  get() {
    const sorted = [...measured].sort((a, b) => a - b);
    const count = sorted.length;
    if (!count) return { count };
    const last = measured[count - 1];
    return { median: quantile(sorted, 0.5), p99: quantile(sorted, 0.99), last, count };
  },

  /** Forget what was measured. */
  reset() {
    open.clear();
    measured = [];
  },
};

window.usSim = Object.assign(window.usSim ?? {}, {
  latency: () => latency.get(),
  resetLatency: () => latency.reset(),
});
