/**
 * The stage of the 3D scene: renderer, camera, and when and how finely it draws.
 *
 * Units are metres, in frame `patient`; up on the screen is -z, out of the body. Nothing is drawn
 * unless something changed. Drawing takes a part of the time only: where it is done by the
 * processor, as without a graphics card, the simulator needs the rest. While something moves
 * pixels are as coarse as that asks for; once all stands still, one fine picture is drawn.
 */

import { THREE, OrbitControls } from "nicegui-scene";
import { element } from "../events.js";
import { Readback } from "./readback.js";

/** Part of the time that drawing may take; less where the processor draws. */
const BUSY = 0.65;
const BUSY_SLOW = 0.2;
/** ms between two drawings at least, and how long one may take before pixels become coarser. */
const SHORTEST_MS = 1000 / 60;
const LONG_MS = 24;
const SHORT_MS = 10;
/** ms after which what has not moved stands still. */
const STILL_MS = 300;
/** ms between two drawings where only the image on its plane changes. */
const IMAGE_MS = 1000 / 30;
const RATIOS = [0.5, 0.7, 0.85, 1];
const AVERAGED = 0.8;
/** ms before the next drawing at which what is to be drawn then is asked for. */
const AHEAD_MS = 50;

const place = await element("scene");
const canvas = document.createElement("canvas");
canvas.className = "us-scene-canvas";
canvas.tabIndex = 0;
canvas.setAttribute("role", "img");
canvas.setAttribute("aria-label", "The patient and the probe in 3D; keys 0 to 6 choose a view");
place.append(canvas);

const isSlow = drawsInSoftware();
const renderer = new THREE.WebGLRenderer({
  canvas: isSlow ? new OffscreenCanvas(1, 1) : canvas,
  antialias: !isSlow,
  alpha: false,
  powerPreference: "high-performance",
});
renderer.setClearColor("#0e1113");
renderer.localClippingEnabled = true; // see cut.js
const gl = renderer.getContext();
const readback = isSlow ? new Readback(gl, canvas) : null;

const scene = new THREE.Scene();
const camera = new THREE.PerspectiveCamera(30, 1, 0.01, 3);
camera.up.set(0, 0, -1);
camera.position.set(0.16, 0.3, -0.2);
const controls = new OrbitControls(camera, canvas);
controls.target.set(0, 0, 0.01);
controls.enableDamping = false;
controls.minDistance = 0.03;
controls.maxDistance = 1.2;
controls.zoomSpeed = 1.2;
controls.screenSpacePanning = true;
controls.update();

const preparations = [];
const followers = [];
const witnesses = [];
let isDirty = true;
let isDrawing = false;
let isFine = false;
let moved = 0;
let earliest = 0;
let level = isSlow ? 0 : RATIOS.length - 1;
let cost = 0;
let timer = 0;
let drawn = 0;
let waiting = withResolvers();

/** A promise, and what resolves it. */
function withResolvers() {
  let resolve;
  const promise = new Promise((done) => {
    resolve = done;
  });
  return { promise, resolve };
}

/** Whether the processor draws, and no graphics card. */
function drawsInSoftware() {
  const context = document.createElement("canvas").getContext("webgl2");
  const known = context?.getExtension("WEBGL_debug_renderer_info");
  const name = known ? context.getParameter(known.UNMASKED_RENDERER_WEBGL) : "";
  context?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}

function schedule() {
  if (timer || isDrawing || document.hidden) return;
  timer = setTimeout(() => requestAnimationFrame(draw), Math.max(0, earliest - performance.now()));
}

function draw() {
  timer = 0;
  const now = performance.now();
  const isStill = now - moved > STILL_MS;
  if (!isDirty && (isFine || !isStill)) return;
  const done = waiting;
  waiting = withResolvers();
  // Fine only when there is nothing new at all: an image that streams is drawn as while moving.
  const fine = !isDirty;
  isDirty = false;
  isDrawing = true;
  size(fine ? Math.min(2, Math.max(1, devicePixelRatio) * (isSlow ? 1.5 : 1)) : coarseRatio());
  isFine = fine;
  try {
    for (const prepare of preparations) prepare({ isStill });
    renderer.render(scene, camera);
    for (const follow of followers) follow();
  } catch (error) {
    console.error(error);
  }
  readback?.ask();
  const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
  gl.flush();
  finish(fence, now, fine, done.resolve);
}

/** Once the graphics card, or what stands for it, has drawn: see how long it took, and go on. */
function finish(fence, begun, fine, done) {
  if (!gl.isContextLost() && gl.getSyncParameter(fence, gl.SYNC_STATUS) !== gl.SIGNALED) {
    setTimeout(() => finish(fence, begun, fine, done), 2);
    return;
  }
  gl.deleteSync(fence);
  if (!gl.isContextLost()) readback?.show();
  for (const witness of witnesses) witness();
  const end = performance.now();
  const took = end - begun;
  isDrawing = false;
  drawn += 1;
  earliest = begun + Math.max(SHORTEST_MS, took / (isSlow ? BUSY_SLOW : BUSY));
  const early = earliest - AHEAD_MS - end;
  if (early > 0) setTimeout(done, early);
  else done();
  if (!fine) {
    cost = cost ? AVERAGED * cost + (1 - AVERAGED) * took : took;
    if (cost > LONG_MS && level > 0) [level, cost] = [level - 1, 0];
    else if (cost < SHORT_MS && level < RATIOS.length - 1) [level, cost] = [level + 1, 0];
  }
  if (isDirty) schedule();
  else if (!isFine) setTimeout(schedule, STILL_MS);
}

function coarseRatio() {
  return RATIOS[level] * Math.min(devicePixelRatio, 1.5);
}

function size(ratio) {
  const width = Math.max(1, place.clientWidth);
  const height = Math.max(1, place.clientHeight);
  const was = renderer.getSize(new THREE.Vector2());
  if (renderer.getPixelRatio() === ratio && was.x === width && was.y === height) return;
  renderer.setPixelRatio(ratio);
  renderer.setSize(width, height, false);
  camera.aspect = width / height;
  camera.updateProjectionMatrix();
}

export const stage = {
  THREE,
  place,
  canvas,
  scene,
  camera,
  controls,

  /**
   * Something has moved, or looks otherwise: draw it. Resolves when it is drawn, and newer would
   * be drawn soon: what comes before that is work for nothing.
   */
  move() {
    moved = performance.now();
    isDirty = true;
    schedule();
    return waiting.promise;
  },

  /** Only what the image shows has changed. */
  refresh() {
    isDirty = true;
    if (performance.now() - moved > STILL_MS) {
      earliest = Math.max(earliest, performance.now() + IMAGE_MS / 2);
    }
    schedule();
  },

  /** Have `prepare({isStill})` called before each drawing: bring what is shown up to date. */
  beforeDrawing(prepare) {
    preparations.push(prepare);
  },

  /** Have `follow()` called after each drawing: labels follow what they name. */
  afterDrawing(follow) {
    followers.push(follow);
  },

  /** Have `witness()` called when a drawing is seen, which may be long after it was begun. */
  afterShowing(witness) {
    witnesses.push(witness);
  },

  /** Whether something has changed that is not seen yet. */
  get isPending() {
    return isDirty || isDrawing;
  },

  /** CSS pixels in the scene of a point (m), and whether it is before the camera. */
  project(point) {
    camera.updateMatrixWorld(); // it may have moved since it was drawn
    const at = point.clone().project(camera);
    return {
      x: (0.5 + 0.5 * at.x) * place.clientWidth,
      y: (0.5 - 0.5 * at.y) * place.clientHeight,
      isVisible: at.z < 1,
    };
  },

  /**
   * Pictures drawn, ms that the last ones took, pixels for each CSS pixel, whether the processor
   * draws, and whether there is nothing left to be drawn.
   */
  get pace() {
    const isAtRest = isFine && !isDirty && !isDrawing;
    return { drawn, cost, ratio: renderer.getPixelRatio(), isSlow, isAtRest };
  },
};

controls.addEventListener("change", () => stage.move());
new ResizeObserver(() => stage.move()).observe(place);
document.addEventListener("visibilitychange", () => stage.move());
renderer.domElement.addEventListener("webglcontextlost", (event) => {
  event.preventDefault();
  readback?.forget();
});
renderer.domElement.addEventListener("webglcontextrestored", () => stage.move());
