/** The 3D scene of the page, in frame `patient`, metres; and what others may ask of it. */

import { probe } from "./probe.js";
import "./age.js";
import "./measures.js";

const style = document.createElement("link");
style.rel = "stylesheet";
style.href = new URL("./scene.css", import.meta.url).href;
document.head.append(style);

/** The newest {position, quaternion, force, torque, stamp} of the probe in `patient`, or null. */
export function probePose() {
  return probe.pose;
}

export { setGizmo } from "./gizmo.js";
export { onPointer, pick } from "./pointer.js";
export { setOpacity, setVisible } from "./tools.js";
export { stage } from "./stage.js";
export { view } from "./views.js";
