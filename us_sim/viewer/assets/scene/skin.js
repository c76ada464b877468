/** The patient's skin, which the probe dents. */

import { THREE } from "nicegui-scene";
import { stream } from "../stream.js";
import { cutPlane } from "./cut.js";
import { setOpacity, softMaterial } from "./shading.js";
import { MovingPoints, geometryOf, sumNormals } from "./surface_geometry.js";
import { stage } from "./stage.js";
import { tissue } from "./tissue.js";

/** m: what moves less is not seen to move. */
const VISIBLE = 2e-5;
/** ms: a skin that was told so long before another tissue is of the scene before, which may have
 * had one where this one has none. */
const SAME_SCENE_MS = 30_000;

const material = softMaterial("#dba88b", {
  opacity: 0.34,
  rim: 0.55,
  gloss: 0.08,
  cut: cutPlane,
});
const mesh = new THREE.Mesh(new THREE.BufferGeometry(), material);
mesh.name = "skin";
mesh.renderOrder = 5;
mesh.visible = false;
stage.scene.add(mesh);

let points = null;
let isStale = false;
let isShown = true;
let isOfScene = false;
let told = 0;

function take(header, payload) {
  points = new MovingPoints(header, payload);
  mesh.geometry.dispose();
  mesh.geometry = geometryOf(points.positions, points.triangles);
  const last = stream.latest("skin");
  if (last) points.move(last.header, last.payload);
  told = performance.now();
  isStale = true;
  appear(true);
}

function appear(on) {
  isOfScene = on;
  mesh.visible = on && isShown;
  stage.move();
}

function move(header, payload) {
  const { isMine, moved } = points?.move(header, payload) ?? {};
  if (isMine && !isOfScene) appear(true);
  if (!isMine || moved < VISIBLE) return undefined;
  isStale = true;
  return stage.move(); // the next is asked for when this is drawn
}

stage.beforeDrawing(() => {
  if (!isStale || !mesh.visible) return;
  isStale = false;
  const { position, normal } = mesh.geometry.attributes;
  sumNormals(points.positions, points.triangles, normal.array);
  position.needsUpdate = normal.needsUpdate = true;
});

tissue.onMesh(() => {
  if (points && performance.now() - told > SAME_SCENE_MS) appear(false);
});
stream.on("skin_mesh", take);
stream.on("skin", move);
stream.watch("skin_mesh");
stream.watch("skin");

export const skin = {
  mesh,

  /** Its points at rest and as they are now; null where the scene has no skin. */
  get points() {
    return isOfScene ? points : null;
  },

  /** Show or hide it; while hidden it is not sent either. */
  setVisible(on) {
    isShown = on;
    mesh.visible = on && isOfScene;
    stream.watch("skin", on);
    isStale = true;
    stage.move();
  },

  /** 0 to 1. */
  setOpacity(value) {
    setOpacity(material, value);
    stage.move();
  },
};
