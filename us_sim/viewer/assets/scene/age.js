/** Says when what the 3D scene shows is older than the image beside it, as on a busy computer. */

import { events } from "../events.js";
import { stream } from "../stream.js";
import { probe } from "./probe.js";
import { skin } from "./skin.js";
import { stage } from "./stage.js";
import { structures } from "./structures.js";
import { tissue } from "./tissue.js";

/** ms that what is shown may be older than the image without a word. */
const OLD_MS = 500;
const LOOK_MS = 250;

const badge = document.createElement("p");
badge.className = "us-scene-old";
badge.hidden = true;
badge.setAttribute("role", "status");
stage.place.append(badge);

/** What can be seen to be old; what is hidden is not sent, or not drawn. */
const isSeen = {
  probe: () => probe.frame.visible,
  force: () => probe.isForceShown,
  skin: () => skin.mesh.visible,
  tissue: () => tissue.lines.visible || structures.parts.some((part) => part.isShown),
};
/** Stamps, ms, by what they are of: what has come, is being drawn, and is seen. */
const come = new Map();
let drawn = new Map();
let seen = new Map();
let image = null; // ms, stamp of the image beside

const milliseconds = (stamp) => Number(stamp) / 1e6;

for (const kind of ["probe", "skin", "tissue"]) {
  stream.on(kind, ({ stamp }) => {
    come.set(kind, milliseconds(stamp));
  });
}
stream.on("probe", ({ force_stamp: stamp }) => {
  if (stamp) come.set("force", milliseconds(stamp));
});
events.on("image-drawn", ({ stamp }) => {
  image = milliseconds(stamp);
});
stage.afterDrawing(() => {
  drawn = new Map(come);
});
stage.afterShowing(() => {
  seen = drawn;
});

/** A page that was hidden was sent nothing. */
document.addEventListener("visibilitychange", () => {
  image = null;
  for (const stamps of [come, drawn, seen]) stamps.clear();
});

/** ms by which something that is seen is older than the image, by what it is. */
function lags() {
  if (!stage.isPending) seen = new Map(come); // it moved too little to be drawn anew
  const found = new Map();
  for (const [kind, stamp] of seen) {
    if (isSeen[kind]() && image - stamp > OLD_MS) found.set(kind, image - stamp);
  }
  return found;
}

setInterval(() => {
  if (image === null || document.hidden) return;
  const found = lags();
  probe.markForce(found.has("force"));
  badge.hidden = !found.size;
  if (badge.hidden) return;
  const seconds = (Math.max(...found.values()) / 1000).toFixed(1);
  const isForce = found.size === 1 && found.has("force");
  // Poses came since, and none with a force: it is not that this page is slow.
  const words = isForce && probe.pose?.force_age > OLD_MS / 1000
    ? `No force for ${seconds} s: the tissue is not in balance`
    : `${isForce ? "The force" : "The 3D view"} is ${seconds} s older than the image`;
  if (badge.textContent !== words) badge.textContent = words;
}, LOOK_MS);
