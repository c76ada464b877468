/**
 * The tissue: its nodes, which carry the structures, and its outer edges as a wireframe.
 *
 * The wireframe is plain, or coloured by how far nodes have moved (mm), or by how much the tissue
 * is strained (%), which is computed only while it is asked for.
 */

import { THREE } from "nicegui-scene";
import { events } from "../events.js";
import { stream } from "../stream.js";
import { colourBar, colourMap } from "./colour_bar.js";
import { clippingPlane } from "./cut.js";
import { MovingPoints, PacketReader } from "./surface_geometry.js";
import { stage } from "./stage.js";

const VISIBLE = 2e-5;
const PLAIN = [0.36, 0.42, 0.47];
/** The largest values that a colour bar may end at, over a power of ten. */
const ROUND = [1, 2, 3, 5, 10];
const LEAST = { displacement: 2, strain: 1 };
/** Part of the nodes that are drawn whose strain lies within the bar: a few corners need not. */
const HELD = 0.95;

const lines = new THREE.LineSegments(
  new THREE.BufferGeometry(),
  new THREE.LineBasicMaterial({
    vertexColors: true,
    transparent: true,
    clippingPlanes: [clippingPlane],
  }),
);
lines.name = "tissue wireframe";
lines.frustumCulled = false;
lines.visible = false;
stage.scene.add(lines);

/** What a ray may hit: never drawn. */
const surface = new THREE.Mesh(
  new THREE.BufferGeometry(),
  new THREE.MeshBasicMaterial({ side: THREE.DoubleSide }),
);
surface.name = "tissue";
surface.visible = false;
stage.scene.add(surface);

const followers = [];
const watchers = [];
let points = null;
let strain = null;
let mode = "off";
let largest = 0;
let isStale = false;

function take(header, payload) {
  if (points && points.number !== header.mesh) for (const watch of watchers) watch();
  points = new MovingPoints(header, payload);
  strain = null;
  const position = new THREE.BufferAttribute(points.positions, 3);
  const colours = new THREE.BufferAttribute(new Float32Array(points.positions.length), 3);
  lines.geometry.dispose();
  lines.geometry = new THREE.BufferGeometry()
    .setAttribute("position", position)
    .setAttribute("color", colours)
    .setIndex(new THREE.BufferAttribute(points.edges, 1));
  surface.geometry.dispose();
  surface.geometry = new THREE.BufferGeometry()
    .setAttribute("position", position)
    .setIndex(new THREE.BufferAttribute(points.triangles, 1));
  const last = stream.latest("tissue");
  if (last) points.move(last.header, last.payload);
  changed();
}

function move(header, payload) {
  const { isMine, moved } = points?.move(header, payload) ?? {};
  // The next is asked for when this is drawn.
  return isMine && moved > VISIBLE ? changed() : undefined;
}

function changed() {
  isStale = true;
  for (const follow of followers) follow(points);
  return stage.move();
}

function values() {
  if (mode === "strain") return strain;
  const { rest, positions } = points;
  const lengths = new Float32Array(rest.length / 3);
  for (let n = 0, i = 0; n < lengths.length; n++, i += 3) {
    lengths[n] = 1000 * Math.hypot(
      positions[i] - rest[i],
      positions[i + 1] - rest[i + 1],
      positions[i + 2] - rest[i + 2],
    );
  }
  return lengths;
}

/** The bar's end: a round number that holds what is drawn, and does not go down at each breath. */
function endOf(found) {
  const drawn = new Set(points.edges);
  const sorted = Float32Array.from(drawn, (n) => found[n]).sort();
  const last = sorted.length - 1;
  const most = Math.max(LEAST[mode], sorted[mode === "strain" ? Math.floor(HELD * last) : last] ?? 0);
  if (most <= largest && most > 0.4 * largest) return largest;
  const power = 10 ** Math.floor(Math.log10(most));
  largest = power * ROUND.find((step) => step * power >= most * 0.999);
  return largest;
}

stage.beforeDrawing(() => {
  if (!isStale || !lines.visible) return;
  isStale = false;
  const { position, color } = lines.geometry.attributes;
  const found = mode === "mesh" ? null : values();
  if (found) {
    const end = endOf(found);
    colourMap(found, end, color.array);
    colourBar.show(mode, end);
  } else {
    for (let i = 0; i < color.array.length; i++) color.array[i] = PLAIN[i % 3];
  }
  position.needsUpdate = color.needsUpdate = true;
});

stream.on("tissue_mesh", take);
stream.on("tissue", move);
stream.on("strain", (header, payload) => {
  if (header.mesh !== points?.number) return;
  strain = new PacketReader(payload).floats(header.points).map((value) => 100 * value);
  isStale = true;
  stage.move();
});
stream.watch("tissue_mesh");
stream.watch("tissue");

export const tissue = {
  lines,
  surface,

  /** Have `watch()` called when another mesh takes the place of one: it is another scene. */
  onMesh(watch) {
    watchers.push(watch);
  },

  /** Have `follow(points)` called whenever the nodes have moved. */
  onMove(follow) {
    followers.push(follow);
    if (points) follow(points);
  },

  /** "off", "mesh", "displacement" or "strain". */
  show(what) {
    mode = what;
    largest = 0;
    lines.visible = mode !== "off";
    lines.material.opacity = mode === "mesh" ? 0.55 : 0.9;
    stream.watch("strain", mode === "strain");
    if (mode === "off" || mode === "mesh") colourBar.hide();
    isStale = true;
    stage.move();
    events.tell("tissue-shown", mode);
  },
};
