/** Two fingers: how far both have moved down together, and how far the line between them turned. */

export class Fingers {
  #places = new Map();

  /** How many are down. */
  get count() {
    return this.#places.size;
  }

  /** One is down, or has moved; what that changed: {right, down} CSS pixels, and {turn} rad. */
  moved(event) {
    const before = this.#middle();
    const angle = this.#angle();
    const isNew = !this.#places.has(event.pointerId);
    this.#places.set(event.pointerId, [event.clientX, event.clientY]);
    if (isNew) return { right: 0, down: 0, turn: 0 };
    const after = this.#middle();
    const turn = this.count === 2 ? this.#angle() - angle : 0;
    return {
      right: after[0] - before[0],
      down: after[1] - before[1],
      turn: Math.atan2(Math.sin(turn), Math.cos(turn)),
    };
  }

  /** One is up. */
  left(event) {
    this.#places.delete(event.pointerId);
  }

  /** None is down. */
  clear() {
    this.#places.clear();
  }

  #middle() {
    const places = [...this.#places.values()];
    return [0, 1].map((axis) => places.reduce((sum, at) => sum + at[axis], 0) / places.length);
  }

  #angle() {
    if (this.count !== 2) return 0;
    const [[ax, ay], [bx, by]] = this.#places.values();
    return Math.atan2(by - ay, bx - ax);
  }
}
