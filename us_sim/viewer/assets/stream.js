/**
 * The websocket to the viewer: packets of what is watched come, commands go.
 *
 * A packet is 32 bits of length (little endian), so many bytes of JSON, and bytes. While the
 * handlers of one are at work the next of its kind is on its way already, but none after that: so
 * a slow page gets fewer packets, and always the newest.
 */

import { events } from "./events.js";

const RETRY_MS = 250;
const utf8 = new TextDecoder();

class Stream {
  #socket = null;
  #handlers = new Map();
  #watched = new Set();
  #latest = new Map();
  #work = new Map(); // by kind, what ends with the handlers of the last packet

  constructor() {
    this.#open();
    document.addEventListener("visibilitychange", () => this.#tellWatched());
    addEventListener("pagehide", () => this.#socket?.close());
  }

  /** Whether the address says that this page changes nothing. */
  isWatching = new URLSearchParams(location.search).has("watch");

  /** Whether the viewer answers. */
  get isOpen() {
    return this.#socket?.readyState === WebSocket.OPEN;
  }

  /** Have `handler(header, payload)` called, `payload` an ArrayBuffer view (Uint8Array). */
  on(kind, handler) {
    if (!this.#handlers.has(kind)) this.#handlers.set(kind, []);
    this.#handlers.get(kind).push(handler);
  }

  /** Begin or end to watch a kind. */
  watch(kind, on = true) {
    if (this.#watched.has(kind) === on) return;
    if (on) this.#watched.add(kind);
    else this.#watched.delete(kind);
    this.#tellWatched();
  }

  /** The last packet of a kind, `{header, payload}`, or undefined. */
  latest(kind) {
    return this.#latest.get(kind);
  }

  /** Send a command; whether it could be sent. */
  send(command) {
    if (!this.isOpen) return false;
    this.#socket.send(JSON.stringify(command));
    return true;
  }

  /** Leave, and come back at once: what was sent before is sent anew. */
  reconnect() {
    this.#socket?.close();
  }

  #open() {
    const scheme = location.protocol === "https:" ? "wss:" : "ws:";
    const socket = new WebSocket(`${scheme}//${location.host}/us_sim/stream${this.isWatching ? "?watch" : ""}`);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.#tellWatched();
      events.tell("connection", true);
    };
    socket.onmessage = (event) => this.#take(event.data);
    socket.onclose = () => {
      events.tell("connection", false);
      setTimeout(() => this.#open(), RETRY_MS);
    };
    this.#socket = socket;
  }

  #tellWatched() {
    panelsReturnSoon();
    this.send({ watch: document.hidden ? [] : [...this.#watched] });
  }

  async #take(data) {
    if (typeof data === "string") {
      events.tell("problem", JSON.parse(data).problem);
      return;
    }
    const length = new DataView(data).getUint32(0, true);
    const header = JSON.parse(utf8.decode(new Uint8Array(data, 4, length)));
    const payload = new Uint8Array(data, 4 + length);
    this.#latest.set(header.kind, { header, payload });
    const before = this.#work.get(header.kind);
    this.#work.set(header.kind, this.#handle(header, payload));
    await before;
    this.send({ next: header.kind });
  }

  async #handle(header, payload) {
    try {
      await Promise.all((this.#handlers.get(header.kind) ?? []).map((handle) => handle(header, payload)));
    } catch (error) {
      console.error(error);
    }
  }
}

/** Have NiceGUI's socket, which the panels work by, look for a viewer as often as this one does. */
function panelsReturnSoon() {
  const manager = window.socket?.io;
  manager?.reconnectionDelay(RETRY_MS);
  manager?.reconnectionDelayMax(RETRY_MS);
}

export const stream = new Stream();
