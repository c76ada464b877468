/**
 * The hand that holds the probe: what this page wants of it, and how it is held.
 *
 * All lengths are metres and all angles radians, in frame `patient`; `state.stance` is how the
 * probe is held now, `state.goal` where it goes: {x, y, z, press, rotation, fan, rock}.
 */

import { events } from "../events.js";
import { stream } from "../stream.js";
import { latency } from "./latency.js";

/** ms: wishes that come closer together than a picture are sent as one. */
const TOGETHER_MS = 14;
/** The name of a page that held the probe, for when it is loaded anew: it holds it again. */
const KEPT = "us-hand";
const kept = sessionStorage.getItem(KEPT);
sessionStorage.removeItem(KEPT); // or a copy of the page would bear it, too
const made = Array.from(crypto.getRandomValues(new Uint32Array(2)), (n) => n.toString(36)).join("");
const source = kept ?? made;

let sequence = 0;
let wish = null;
let earliest = 0;
let sent = -TOGETHER_MS;
let isDue = false;
/** Whether this page was the last that held the probe, as far as it knows. */
let isMine = Boolean(kept);
/** Whether another page has taken the probe from this one. */
let isTaken = false;
const { isWatching } = stream;
addEventListener("pagehide", () => isMine && sessionStorage.setItem(KEPT, source));
let heard = 0;
let isSilent = false;
/** ms without a state, after which the viewer does not answer, where it says how often it tells. */
const SILENT_MS = 3000;
const handlers = [];

export const hand = {
  /** The newest of the viewer: {leader, holder, is_resting, obstacle, warning, stance, goal, range}, or null. */
  state: null,

  /** Have `handler(state)` called with each newer state. */
  on(handler) {
    handlers.push(handler);
  },

  /** Whether the viewer answers. */
  get isAnswered() {
    return stream.isOpen && !isSilent;
  },

  /** Whether this page only watches. */
  isWatching,

  /** Whether another page has taken the probe from this one. */
  get isTaken() {
    return isTaken;
  },

  /** Whether pages move the probe. */
  get isOfPages() {
    return this.isAnswered && this.state?.leader === "hand";
  },

  /** Whether the page may move the probe. */
  get leads() {
    return this.isOfPages && !isWatching && !this.isHeldElsewhere;
  },

  /** Whether no page holds the probe. */
  get isFree() {
    return this.isOfPages && !this.state.holder;
  },

  /** Whether another page holds the probe. */
  get isHeldElsewhere() {
    return this.isOfPages && !this.isFree && this.state.holder !== source;
  },

  /** Hold the probe, whichever page does; what is replayed ends. */
  take() {
    stream.send({ take: source });
  },

  /**
   * Ask for values (`to`), for changes (`by`), or for a place (`go`: "home", "lift", "upright").
   *
   * `time`: ms of `performance.now()`, when the person did what this follows from.
   */
  ask({ to = {}, by = {}, go = undefined }, time = performance.now()) {
    if (isWatching) return;
    if (go) flush();
    if (!wish) {
      wish = { to: {}, by: {} };
      earliest = time;
    }
    Object.assign(wish.to, to);
    for (const [name, amount] of Object.entries(by)) {
      if (Array.isArray(amount)) {
        const before = wish.by[name] ?? amount.map(() => 0);
        wish.by[name] = amount.map((value, i) => value + before[i]);
      } else if (name in wish.to) {
        wish.to[name] += amount;
      } else {
        wish.by[name] = (wish.by[name] ?? 0) + amount;
      }
    }
    if (go) wish.go = go;
    if (performance.now() - sent >= TOGETHER_MS) flush();
    else if (!isDue) {
      isDue = true;
      requestAnimationFrame(flush);
    }
  },
};

function flush() {
  isDue = false;
  if (!wish) return;
  sequence += 1;
  if (stream.send({ hand: { source, sequence, ...wish } })) latency.asked(sequence, earliest);
  sent = performance.now();
  wish = null;
}

function tell() {
  if (hand.state) for (const handle of handlers) handle(hand.state);
}

stream.on("hand", (header) => {
  hand.state = header;
  heard = performance.now();
  isSilent = false;
  isTaken = hand.isHeldElsewhere && (isTaken || isMine);
  if (header.holder) isMine = header.holder === source;
  else if (isMine && hand.leads) hand.ask({}); // the connection was lost, and nobody took it since
  tell();
});
stream.watch("hand");
events.on("connection", tell);
document.addEventListener("visibilitychange", () => (heard = performance.now()));
setInterval(() => {
  if (isSilent || document.hidden || !hand.state?.every) return;
  isSilent = performance.now() - heard > SILENT_MS;
  if (isSilent) tell();
}, SILENT_MS / 6);

events.on("image-drawn", ({ command }) => {
  if (command?.[0] === source) requestAnimationFrame(() => latency.seen(command[1]));
});
