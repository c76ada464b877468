/**
 * Moving the probe in the 3D scene: dragging over the skin puts it there, dragging the probe along
 * itself presses, across itself slides, with shift it tilts. With two fingers down presses and
 * turning rotates: a finger puts the probe only once it moves, or is up, without another one.
 * The wheel presses over the probe, and with shift over the skin. A click on the number of a point
 * puts the probe there, also where the probe hides the point.
 */

import { events } from "../events.js";
import { onPointer, probePose, setGizmo, stage } from "../scene/scene.js";
import { Fingers } from "./fingers.js";
import { hand } from "./hand.js";

/** CSS pixels after which a drag of the probe is either a press or a slide. */
const DECIDED = 5;
/** m a CSS pixel that two fingers press: however small the patient is drawn. */
const FINGERS = 1e-4;
/** m: how near to the face the body can be grabbed to tilt it. */
const SHORTEST = 0.03;
/** m a notch of the wheel. */
const NOTCH = 0.0005;

const { THREE } = stage;
const fingers = new Fingers();
let drag = null;

onPointer((event, hit) => {
  if (event.type === "wheel") return press(event, hit);
  if (event.type === "pointerdown" && !drag) return begin(event, hit);
  if (!drag) return false;
  if (event.type === "pointerdown" || event.type === "pointermove") go(event, hit);
  else if (event.type === "pointerup" || event.type === "pointercancel") {
    if (event.type === "pointerup" && drag.mode === "touch") put(hit, event);
    end();
  }
  return true;
});

events.on("target", (point) => hand.leads && hand.ask({ to: { point } }));

function press(event, hit) {
  if (hit?.object !== "probe" && !(event.shiftKey && hit)) return false;
  // With shift some systems turn the wheel sideways.
  const turned = event.deltaY || event.deltaX;
  const notches = event.deltaMode === 0 ? turned / 100 : turned / 3;
  hand.ask({ by: { press: notches * NOTCH } }, event.timeStamp);
  return true;
}

function begin(event, hit) {
  if (!hit || event.button !== 0 || event.altKey || event.ctrlKey || !hand.leads) return false;
  const isProbe = hit.object === "probe";
  const isFinger = event.pointerType === "touch";
  const mode = isProbe ? (event.shiftKey ? "tilt" : null) : isFinger ? "touch" : "place";
  drag = { mode, travelled: [0, 0], lever: isProbe ? leverOf(hit.point) : 0 };
  fingers.clear();
  fingers.moved(event);
  stage.canvas.style.cursor = "grabbing";
  if (drag.mode === "place") put(hit, event);
  return true;
}

function go(event, hit) {
  const { right, down, turn } = fingers.moved(event);
  if (fingers.count > 1) {
    drag.mode = "fingers";
    hand.ask({ by: { press: down * FINGERS, rotation: turn } }, event.timeStamp);
  } else if (drag.mode === "touch") {
    drag.travelled = [drag.travelled[0] + right, drag.travelled[1] + down];
    if (Math.hypot(...drag.travelled) >= DECIDED) drag.mode = "place";
  } else if (drag.mode === "place") {
    put(hit, event);
  } else if (drag.mode === "tilt") {
    tilt(right, down, event);
  } else if (drag.mode !== "fingers") {
    carry(right, down, event);
  }
}

function put(hit, event) {
  if (hit && hit.object !== "probe") hand.ask({ to: { point: hit.point } }, event.timeStamp);
}

/** Along the probe's own axes, as they are seen. */
function carry(right, down, event) {
  drag.travelled[0] += right;
  drag.travelled[1] += down;
  const axes = axesOnScreen();
  if (!axes) return;
  if (!drag.mode) {
    const [x, y] = drag.travelled;
    if (Math.hypot(x, y) < DECIDED) return;
    const inwards = Math.abs(x * axes.z[0] + y * axes.z[1]) / Math.hypot(...axes.z);
    drag.mode = inwards > 0.7 * Math.hypot(x, y) ? "press" : "slide";
  }
  const { z } = axes;
  if (drag.mode === "press") {
    const square = z[0] ** 2 + z[1] ** 2;
    hand.ask({ by: { press: (right * z[0] + down * z[1]) / square } }, event.timeStamp);
  } else {
    hand.ask({ by: { slide: alongFace(right, down, axes) } }, event.timeStamp);
  }
}

/** The place that was grabbed follows the pointer, the face stays. */
function tilt(right, down, event) {
  const axes = axesOnScreen();
  if (!axes) return;
  // Above the face, a turn about y goes against x, and one about x along y.
  const [x, y] = alongFace(right, down, axes);
  hand.ask({ by: { rock: -x / drag.lever, fan: y / drag.lever } }, event.timeStamp);
}

/** m along the probe's x and y whose picture is the pointer's way. */
function alongFace(right, down, { x, y }) {
  // Damped, for where an axis is seen from its end.
  const damping = 0.02 * Math.max(x[0] ** 2 + x[1] ** 2, y[0] ** 2 + y[1] ** 2);
  const xx = x[0] ** 2 + x[1] ** 2 + damping;
  const yy = y[0] ** 2 + y[1] ** 2 + damping;
  const xy = x[0] * y[0] + x[1] * y[1];
  const rx = right * x[0] + down * x[1];
  const ry = right * y[0] + down * y[1];
  const determinant = xx * yy - xy * xy;
  return [(yy * rx - xy * ry) / determinant, (xx * ry - xy * rx) / determinant];
}

/** m from the probe's face to a point of its body. */
function leverOf(point) {
  const pose = probePose();
  if (!pose) return SHORTEST;
  return Math.max(SHORTEST, Math.hypot(...point.map((value, i) => value - pose.position[i])));
}

function end() {
  drag = null;
  fingers.clear();
  stage.canvas.style.cursor = "";
}

/** CSS pixels a metre along the probe's x, y and z, as it is seen: {x: [right, down], ...}. */
function axesOnScreen() {
  const pose = probePose();
  if (!pose) return null;
  const origin = new THREE.Vector3(...pose.position);
  const turn = new THREE.Quaternion(...pose.quaternion);
  const at = stage.project(origin);
  const seen = (direction) => {
    const tip = stage.project(direction.applyQuaternion(turn).multiplyScalar(1e-3).add(origin));
    return [1e3 * (tip.x - at.x), 1e3 * (tip.y - at.y)];
  };
  const axis = (x, y, z) => seen(new THREE.Vector3(x, y, z));
  const axes = { x: axis(1, 0, 0), y: axis(0, 1, 0), z: axis(0, 0, 1) };
  return Math.hypot(...axes.z) < 100 ? { ...axes, z: [0, 1000] } : axes; // seen from above
}

const TURNS = { x: "fan", y: "rock", z: "rotation" };
let moved = 0;

events.on("gizmo", (on) => setGizmo(on ? follow : null));

function follow({ phase, mode, axis, amount }) {
  if (phase === "start") moved = 0;
  const step = amount - moved;
  moved = amount;
  if (phase !== "move") return;
  if (mode === "rotate") hand.ask({ by: { [TURNS[axis]]: step } });
  else if (axis === "z") hand.ask({ by: { press: step } });
  else hand.ask({ by: { slide: axis === "x" ? [step, 0] : [0, step] } });
}
