"""A field at the nodes of sixty-four tetrahedra, and its gradients in them.

Buffers are rows of `LANES` numbers, one number a tetrahedron: 3 b + axis of the field at its b-th
node, then four of the nodes' sums, and from `OUT` on what comes out. Of the constants, the first
nine rows are the gradients of the shape functions of nodes 1, 2 and 3.

>>> import numpy as np
>>> from us_sim.tissue.elasticity.tetrahedron_lanes import LANES, in_lanes
>>> lanes = in_lanes(np.array([[1.0, 2.0], [3.0, 4.0]]))
>>> lanes.shape == (1, 2 * LANES), lanes[0, :3], lanes[0, LANES : LANES + 3]
(True, array([1., 3., 0.]), array([2., 4., 0.]))
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from us_sim.tissue.elasticity.neo_hookean_point import INLINED

__all__ = [
    "LANES",
    "OUT",
    "ROWS",
    "gather",
    "gather_scalar",
    "gradient",
    "in_lanes",
    "keep",
    "put_block",
    "put_forces",
    "scatter",
    "scatter_scalar",
    "stored",
]

# Tetrahedra in one buffer: a few vectors of the widest kind, and all its rows stay in the L1 cache.
LANES = 64

# The row of a buffer from which on is what comes out, and how many rows there are in all.
OUT, ROWS = 16, 16 + 24


def in_lanes(rows: NDArray) -> NDArray:
    """(chunks, R * LANES) from (M, R): one row after the other of LANES tetrahedra each."""
    chunks = -(-len(rows) // LANES)
    padded = np.zeros((chunks * LANES, rows.shape[1]), dtype=rows.dtype)
    padded[: len(rows)] = rows
    lanes = padded.reshape(chunks, LANES, -1).transpose(0, 2, 1)
    return np.ascontiguousarray(lanes).reshape(chunks, -1)


@njit(**INLINED)
def gather(field, nodes, lanes):
    """Rows 3 b + axis of lanes: the field (3, N) at the b-th node of each tetrahedron."""
    for axis in range(3):
        values = field[axis]
        for corner in range(4):
            into = lanes[(3 * corner + axis) * LANES : (3 * corner + axis + 1) * LANES]
            at = nodes[corner * LANES : (corner + 1) * LANES]
            for w in range(LANES):
                into[w] = values[at[w]]


@njit(**INLINED)
def gather_scalar(values, nodes, lanes):
    """Rows 12 to 15 of lanes: the values (N,) at the nodes of each tetrahedron."""
    for w in range(4 * LANES):
        lanes[12 * LANES + w] = values[nodes[w]]


@njit(**INLINED)
def scatter(lanes, nodes, field):
    """Add rows 3 b + axis of lanes to the field (3, N) at the b-th node of each tetrahedron."""
    for axis in range(3):
        values = field[axis]
        for corner in range(4):
            added = lanes[(OUT + 3 * corner + axis) * LANES :]
            at = nodes[corner * LANES : (corner + 1) * LANES]
            for w in range(LANES):
                values[at[w]] += added[w]


@njit(**INLINED)
def scatter_scalar(lanes, nodes, values):
    """Add row 0 of lanes to the values (N,) at all four nodes of each tetrahedron."""
    for corner in range(4):
        at = nodes[corner * LANES : (corner + 1) * LANES]
        for w in range(LANES):
            values[at[w]] += lanes[OUT * LANES + w]


@njit(**INLINED)
def gradient(field, constants, w):
    """The gradient of the field whose rows `gather` has made."""
    x0, y0, z0 = field[w], field[LANES + w], field[2 * LANES + w]
    x1, y1, z1 = field[3 * LANES + w] - x0, field[4 * LANES + w] - y0, field[5 * LANES + w] - z0
    x2, y2, z2 = field[6 * LANES + w] - x0, field[7 * LANES + w] - y0, field[8 * LANES + w] - z0
    x3, y3, z3 = (
        field[9 * LANES + w] - x0,
        field[10 * LANES + w] - y0,
        field[11 * LANES + w] - z0,
    )
    a0, a1, a2 = constants[w], constants[LANES + w], constants[2 * LANES + w]
    b0, b1, b2 = constants[3 * LANES + w], constants[4 * LANES + w], constants[5 * LANES + w]
    c0, c1, c2 = constants[6 * LANES + w], constants[7 * LANES + w], constants[8 * LANES + w]
    return (
        x1 * a0 + x2 * b0 + x3 * c0,
        x1 * a1 + x2 * b1 + x3 * c1,
        x1 * a2 + x2 * b2 + x3 * c2,
        y1 * a0 + y2 * b0 + y3 * c0,
        y1 * a1 + y2 * b1 + y3 * c1,
        y1 * a2 + y2 * b2 + y3 * c2,
        z1 * a0 + z2 * b0 + z3 * c0,
        z1 * a1 + z2 * b1 + z3 * c1,
        z1 * a2 + z2 * b2 + z3 * c2,
    )


@njit(**INLINED)
def _put_row(px, py, pz, constants, w, lanes, axis):
    """Along one axis, the force of a row of the stress times volume at all four nodes."""
    a = px * constants[w] + py * constants[LANES + w] + pz * constants[2 * LANES + w]
    b = px * constants[3 * LANES + w] + py * constants[4 * LANES + w]
    b += pz * constants[5 * LANES + w]
    c = px * constants[6 * LANES + w] + py * constants[7 * LANES + w]
    c += pz * constants[8 * LANES + w]
    lanes[(OUT + axis) * LANES + w] = -(a + b + c)
    lanes[(OUT + 3 + axis) * LANES + w] = a
    lanes[(OUT + 6 + axis) * LANES + w] = b
    lanes[(OUT + 9 + axis) * LANES + w] = c


@njit(**INLINED)
def put_forces(p, constants, w, lanes):
    """Rows 3 b + axis of out: the force of the stress p, times volume, at the b-th node."""
    _put_row(p[0], p[1], p[2], constants, w, lanes, 0)
    _put_row(p[3], p[4], p[5], constants, w, lanes, 1)
    _put_row(p[6], p[7], p[8], constants, w, lanes, 2)


@njit(**INLINED)
def keep(h, rows, w):
    """Put the gradient into the first nine rows."""
    rows[w] = h[0]
    rows[LANES + w] = h[1]
    rows[2 * LANES + w] = h[2]
    rows[3 * LANES + w] = h[3]
    rows[4 * LANES + w] = h[4]
    rows[5 * LANES + w] = h[5]
    rows[6 * LANES + w] = h[6]
    rows[7 * LANES + w] = h[7]
    rows[8 * LANES + w] = h[8]


@njit(**INLINED)
def stored(rows, w):
    """The gradient in the first nine rows."""
    return (
        rows[w],
        rows[LANES + w],
        rows[2 * LANES + w],
        rows[3 * LANES + w],
        rows[4 * LANES + w],
        rows[5 * LANES + w],
        rows[6 * LANES + w],
        rows[7 * LANES + w],
        rows[8 * LANES + w],
    )


@njit(**INLINED)
def put_block(b, lanes, corner, w):
    """Rows 6 corner to 6 corner + 5 from OUT on."""
    row = (OUT + 6 * corner) * LANES + w
    lanes[row] = b[0]
    lanes[row + LANES] = b[1]
    lanes[row + 2 * LANES] = b[2]
    lanes[row + 3 * LANES] = b[3]
    lanes[row + 4 * LANES] = b[4]
    lanes[row + 5 * LANES] = b[5]
