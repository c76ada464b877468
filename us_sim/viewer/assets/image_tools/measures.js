/** What is measured and written on the image, in mm of frame `probe`: lateral, axial. */

const middle = (a, b) => [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];
const distance = (a, b) => Math.hypot(b[0] - a[0], b[1] - a[1]);

/**
 * The circumference of an ellipse with half axes a and b, exact to rounding, by the
 * arithmetic-geometric mean (Gauss; Abramowitz and Stegun 17.6).
 */
export function circumference(a, b) {
  let [x, y] = a > b ? [a, b] : [b, a];
  if (y === 0) return 4 * x;
  const square = x * x;
  let power = 0.5;
  let sum = power * (x * x - y * y);
  while (x - y > 1e-14 * x) {
    const c = (x - y) / 2;
    [x, y] = [(x + y) / 2, Math.sqrt(x * y)];
    power *= 2;
    sum += power * c * c;
  }
  return (2 * Math.PI * (square - sum)) / x;
}

/** The distance between two points. */
export class Distance {
  constructor(a, b = a) {
    this.points = [a, b];
  }

  /** mm */
  get length() {
    return distance(...this.points);
  }

  get text() {
    return `${this.length.toFixed(1)} mm`;
  }

  /** Have the point of that number elsewhere. */
  move(number, point) {
    this.points[number] = point;
  }

  get isTooSmall() {
    return this.length < 0.2;
  }
}

/** An ellipse by the ends of one axis, and half of the other. */
export class Ellipse {
  constructor(a, b = a) {
    this.axis = [a, b];
    this.half = 0; // mm; 0 is a circle until the third point was moved
  }

  /** Half axes, mm: along, across. */
  get halves() {
    const along = distance(...this.axis) / 2;
    return [along, this.half || along];
  }

  get centre() {
    return middle(...this.axis);
  }

  /** rad, of the first axis. */
  get angle() {
    const [a, b] = this.axis;
    return Math.atan2(b[1] - a[1], b[0] - a[0]);
  }

  /** The ends of the first axis, and of the other. */
  get points() {
    const [x, y] = this.centre;
    const [, across] = this.halves;
    const side = [-Math.sin(this.angle) * across, Math.cos(this.angle) * across];
    return [...this.axis, [x + side[0], y + side[1]], [x - side[0], y - side[1]]];
  }

  /** mm² */
  get area() {
    const [a, b] = this.halves;
    return Math.PI * a * b;
  }

  /** mm */
  get circumference() {
    return circumference(...this.halves);
  }

  get text() {
    return `${this.area.toFixed(1)} mm², circumference ${this.circumference.toFixed(1)} mm`;
  }

  move(number, point) {
    if (number < 2) {
      this.axis[number] = point;
      return;
    }
    const [x, y] = this.centre;
    const across = (point[1] - y) * Math.cos(this.angle) - (point[0] - x) * Math.sin(this.angle);
    this.half = Math.max(Math.abs(across), 0.05);
  }

  get isTooSmall() {
    return distance(...this.axis) < 0.2;
  }
}

/** A text at a point. */
export class Note {
  constructor(point, words = "") {
    this.points = [point];
    this.words = words;
  }

  get text() {
    return this.words;
  }

  move(_, point) {
    this.points[0] = point;
  }

  get isTooSmall() {
    return !this.words.trim();
  }
}
