/** Surfaces whose points move: what a packet holds of them, and their normals. */

import { THREE } from "nicegui-scene";

/** Reads arrays one after another from a packet's bytes. */
export class PacketReader {
  #payload;
  #offset = 0;

  constructor(payload) {
    this.#payload = payload;
  }

  floats(count) {
    return this.#take(Float32Array, count);
  }

  indices(count) {
    return this.#take(Uint32Array, count);
  }

  #take(Type, count) {
    const array = new Type(this.#payload.buffer, this.#payload.byteOffset + this.#offset, count);
    this.#offset += 4 * count;
    return array;
  }
}

/** Points at rest with triangles and edges, of a packet `…_mesh`, and where the points are now. */
export class MovingPoints {
  constructor(header, payload) {
    const reader = new PacketReader(payload);
    this.number = header.mesh;
    this.rest = reader.floats(3 * header.points);
    this.triangles = reader.indices(3 * header.triangles);
    this.edges = reader.indices(2 * header.edges);
    this.positions = new Float32Array(this.rest);
  }

  /** Take whole steps from rest; false where they are of another mesh. The farthest new step, m. */
  move(header, payload) {
    if (header.mesh !== this.number) return { isMine: false, moved: 0 };
    const steps = new Int16Array(payload.buffer, payload.byteOffset, 3 * header.points);
    const { rest, positions } = this;
    const resolution = header.resolution;
    let moved = 0;
    for (let i = 0; i < steps.length; i++) {
      const now = rest[i] + resolution * steps[i];
      const by = Math.abs(now - positions[i]);
      if (by > moved) moved = by;
      positions[i] = now;
    }
    return { isMine: true, moved };
  }
}

/** A geometry over points that it shares with whoever moves them. */
export function geometryOf(positions, triangles) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
  geometry.setAttribute(
    "normal",
    new THREE.BufferAttribute(new Float32Array(positions.length), 3),
  );
  geometry.setIndex(new THREE.BufferAttribute(triangles, 1));
  geometry.computeBoundingSphere();
  return geometry;
}

/**
 * Sums of the adjacent triangles' normals, which the shader makes of length one; `isFirst`: of
 * no other triangles before.
 */
export function sumNormals(positions, triangles, normals, isFirst = true) {
  if (isFirst) normals.fill(0);
  for (let t = 0; t < triangles.length; t += 3) {
    const i = 3 * triangles[t];
    const j = 3 * triangles[t + 1];
    const k = 3 * triangles[t + 2];
    const ax = positions[j] - positions[i];
    const ay = positions[j + 1] - positions[i + 1];
    const az = positions[j + 2] - positions[i + 2];
    const bx = positions[k] - positions[i];
    const by = positions[k + 1] - positions[i + 1];
    const bz = positions[k + 2] - positions[i + 2];
    // In square millimetres, so that their squares fit single precision.
    const x = 1e6 * (ay * bz - az * by);
    const y = 1e6 * (az * bx - ax * bz);
    const z = 1e6 * (ax * by - ay * bx);
    normals[i] += x;
    normals[i + 1] += y;
    normals[i + 2] += z;
    normals[j] += x;
    normals[j + 1] += y;
    normals[j + 2] += z;
    normals[k] += x;
    normals[k + 1] += y;
    normals[k + 2] += z;
  }
}
