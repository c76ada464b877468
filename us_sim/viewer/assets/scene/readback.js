/**
 * Brings what is drawn into a canvas outside the page to one that is in it, without waiting.
 *
 * A browser without a graphics card puts a WebGL canvas of the page together with the rest of it
 * in the page's own thread, which waits until the processor has drawn it: nothing else of the page
 * can be painted meanwhile. Pixels that are asked for come when they are ready.
 */

const CHANNELS = 4;

export class Readback {
  #gl;
  #context;
  #buffer = null;
  #size = [0, 0];
  #bytes = new Uint8Array(0);
  #image = null;

  /** `gl`: the WebGL 2 context of the canvas outside the page; `canvas`: the one in it. */
  constructor(gl, canvas) {
    this.#gl = gl;
    this.#context = canvas.getContext("2d", { alpha: false, willReadFrequently: true });
  }

  /** Ask for the pixels of what has been drawn; they are there when a fence after this is passed. */
  ask() {
    const gl = this.#gl;
    const { drawingBufferWidth: width, drawingBufferHeight: height } = gl;
    const isOther = width !== this.#size[0] || height !== this.#size[1];
    this.#buffer ??= gl.createBuffer();
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, this.#buffer);
    if (isOther) {
      this.#size = [width, height];
      this.#bytes = new Uint8Array(CHANNELS * width * height);
      gl.bufferData(gl.PIXEL_PACK_BUFFER, this.#bytes.length, gl.STREAM_COPY);
    }
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, 0);
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
  }

  /** Put the pixels that were asked for on the canvas of the page, which takes their size. */
  show() {
    const gl = this.#gl;
    const [width, height] = this.#size;
    const { canvas } = this.#context;
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, this.#buffer);
    gl.getBufferSubData(gl.PIXEL_PACK_BUFFER, 0, this.#bytes);
    gl.bindBuffer(gl.PIXEL_PACK_BUFFER, null);
    if (this.#image?.width !== width || this.#image.height !== height) {
      this.#image = this.#context.createImageData(width, height);
    }
    // Rows come from the lowest to the highest.
    const row = CHANNELS * width;
    for (let y = 0; y < height; y++) {
      const from = (height - 1 - y) * row;
      this.#image.data.set(this.#bytes.subarray(from, from + row), y * row);
    }
    if (canvas.width !== width || canvas.height !== height) {
      [canvas.width, canvas.height] = [width, height];
    }
    this.#context.putImageData(this.#image, 0, 0);
  }

  /** The context has been lost, and its buffers with it. */
  forget() {
    this.#buffer = null;
    this.#size = [0, 0];
  }
}
