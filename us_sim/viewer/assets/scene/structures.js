/**
 * Vessels, nerves and bones, which the tissue carries.
 *
 * Each vertex is a sum of four nodes of the tissue. While something moves fewer triangles are
 * drawn, whose vertices come first; once it stands still, all of them.
 */

import { THREE } from "nicegui-scene";
import { events } from "../events.js";
import { stream } from "../stream.js";
import { cutPlane } from "./cut.js";
import { setOpacity, softMaterial, styleOf } from "./shading.js";
import { PacketReader, sumNormals } from "./surface_geometry.js";
import { stage } from "./stage.js";
import { tissue } from "./tissue.js";

const group = new THREE.Group();
group.name = "structures";
stage.scene.add(group);

let parts = []; // {name, mesh, fine, coarse}
let mesh = null; // number of the tissue's mesh
let moving = 0;
let nodes = null;
let weights = null;
let position = null;
let normal = null;
let carriedBy = null;
let isStale = false;
let isFine = false;
const hidden = new Set();
let opacity = 1;

/** Take them out of the scene. */
function clear() {
  for (const part of parts) part.mesh.geometry.dispose();
  group.clear();
  parts = [];
}

/** The name of the scene that they are of; nothing where it is not known. */
let scene = "";
events.on("scene", (name) => {
  if (scene && name !== scene) {
    clear(); // another tissue may have the same mesh
    events.tell("structures", structures.parts);
    stage.move();
  }
  scene = name;
});

stream.on("structures", (header, payload) => {
  const reader = new PacketReader(payload);
  const count = header.vertices;
  nodes = reader.indices(4 * count);
  weights = reader.floats(4 * count);
  ({ mesh, moving } = header);
  position = new THREE.BufferAttribute(new Float32Array(3 * count), 3);
  normal = new THREE.BufferAttribute(new Float32Array(3 * count), 3);
  clear();
  parts = header.parts.map(({ name, colour, fine, coarse }) => {
    const part = {
      name,
      colour: styleOf(colour),
      fine: new THREE.BufferAttribute(reader.indices(3 * fine), 1),
      coarse: new THREE.BufferAttribute(reader.indices(3 * coarse), 1),
    };
    const geometry = new THREE.BufferGeometry()
      .setAttribute("position", position)
      .setAttribute("normal", normal)
      .setIndex(part.coarse);
    part.mesh = new THREE.Mesh(geometry, softMaterial(part.colour, { gloss: 0.22, opacity, cut: cutPlane }));
    part.mesh.name = name;
    part.mesh.frustumCulled = false;
    part.mesh.renderOrder = 1;
    part.mesh.visible = !hidden.has(name);
    group.add(part.mesh);
    return part;
  });
  isStale = true;
  group.visible = carriedBy?.number === mesh;
  events.tell("structures", structures.parts);
  stage.move();
});
stream.watch("structures");

tissue.onMove((points) => {
  carriedBy = points;
  group.visible = points.number === mesh;
  isStale = true;
});

/** Where the first `count` vertices are now. */
function carry(count) {
  const at = position.array;
  const { positions } = carriedBy;
  for (let v = 0, i = 0, w = 0; v < count; v++, i += 3, w += 4) {
    let x = 0;
    let y = 0;
    let z = 0;
    for (let k = w; k < w + 4; k++) {
      const n = 3 * nodes[k];
      const weight = weights[k];
      x += weight * positions[n];
      y += weight * positions[n + 1];
      z += weight * positions[n + 2];
    }
    at[i] = x;
    at[i + 1] = y;
    at[i + 2] = z;
  }
}

/** Normals of the triangles that are drawn, of all parts. */
function shade(which) {
  normal.array.fill(0);
  for (const part of parts) {
    if (part.mesh.visible) sumNormals(position.array, part[which].array, normal.array, false);
  }
}

stage.beforeDrawing(({ isStill }) => {
  if (!parts.length || !group.visible || (!isStale && isStill === isFine)) return;
  isStale = false;
  isFine = isStill;
  carry(isFine ? position.count : moving);
  shade(isFine ? "fine" : "coarse");
  for (const part of parts) part.mesh.geometry.setIndex(isFine ? part.fine : part.coarse);
  for (const attribute of [position, normal]) {
    attribute.clearUpdateRanges();
    if (!isFine) attribute.addUpdateRange(0, 3 * moving);
    attribute.needsUpdate = true;
  }
});

export const structures = {
  group,

  /** {name, colour as a style, isShown} of each. */
  get parts() {
    return parts.map(({ name, colour }) => ({ name, colour, isShown: !hidden.has(name) }));
  },

  /** Show or hide one of them. */
  setVisible(name, on) {
    if (on) hidden.delete(name);
    else hidden.add(name);
    for (const part of parts) part.mesh.visible = !hidden.has(part.name);
    isStale = true;
    stage.move();
  },

  /** Of all of them, 0 to 1. */
  setOpacity(value) {
    opacity = value;
    for (const part of parts) setOpacity(part.mesh.material, value);
    stage.move();
  },
};
