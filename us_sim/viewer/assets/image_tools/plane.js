/** Where millimetres of the image plane are on the screen, and back. */

import { hasImage, imageBox, imageCanvas, pixelToMillimetres } from "../image.js";

/**
 * The affine map of now: {toScreen([mm, mm]) -> [CSS px, CSS px] in `#ultrasound`, toPlane}, and
 * toImage, which is toPlane of the nearest place in the image.
 */
export function plane() {
  const origin = pixelToMillimetres(0, 0);
  const { width: columns, height: rows } = imageCanvas();
  if (!origin || !hasImage()) return null;
  const [ox, oy] = origin;
  const [ax, ay] = pixelToMillimetres(1, 0).map((value, i) => value - origin[i]);
  const [bx, by] = pixelToMillimetres(0, 1).map((value, i) => value - origin[i]);
  const determinant = ax * by - bx * ay;
  const box = imageBox();
  // Column 0 is the middle of the first pixel.
  const toPixels = ([x, y]) => [
    ((x - box.left) / box.width) * columns - 0.5,
    ((y - box.top) / box.height) * rows - 0.5,
  ];
  return {
    toPlane(at) {
      const [column, row] = toPixels(at);
      return [ox + ax * column + bx * row, oy + ay * column + by * row];
    },
    toImage([x, y]) {
      const within = (value, low, size) => Math.min(Math.max(value, low), low + size);
      return this.toPlane([within(x, box.left, box.width), within(y, box.top, box.height)]);
    },
    toScreen([x, y]) {
      const column = (by * (x - ox) - bx * (y - oy)) / determinant;
      const row = (ax * (y - oy) - ay * (x - ox)) / determinant;
      return [
        box.left + ((column + 0.5) / columns) * box.width,
        box.top + ((row + 0.5) / rows) * box.height,
      ];
    },
  };
}
