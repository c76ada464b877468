"""A field at the nodes of sixty-four tetrahedra, and its gradients in them.

Buffers and constants are rows of `LANES` numbers, one number a tetrahedron; the rows' names are
defined here.

>>> import numpy as np
>>> from us_sim.tissue.elasticity.lanes import LANES, in_lanes
>>> from us_sim.tissue.elasticity.tetrahedron_lanes import ROWS, SUMS, gather_scalar
>>> nodes, lanes = in_lanes(np.array([[3, 2, 1, 0]], dtype=np.uint32))[0], np.zeros(ROWS * LANES)
>>> gather_scalar(np.array([0.5, 1.5, 2.5, 3.5]), nodes, lanes)
>>> lanes.reshape(ROWS, LANES)[SUMS:SUMS + 4, 0]
array([3.5, 2.5, 1.5, 0.5])
"""

from __future__ import annotations

import numpy as np

from us_sim.kernels import njit
from us_sim.tissue.elasticity.lanes import LANES, nine, three
from us_sim.tissue.elasticity.neo_hookean_point import INLINED

SHAPE = np.int64(0)  # and no literal, for each of which numba would compile what takes a row
"""First row of the constants' gradients of the shape functions of nodes 1, 2 and 3."""

FIELD = np.int64(0)
"""First row of a buffer's field, row 3 b + axis of it at the b-th node."""

SUMS = FIELD + 12
"""First row of a buffer's nodal sums, one a node."""

OUT = SUMS + 4
"""First row of a buffer's result: a field of 3 b + axis, 6 rows a node, or fewer."""

ROWS = OUT + 24
"""Number of rows of a buffer."""


@njit(**INLINED)
def gather(field, nodes, lanes):
    """Rows 3 b + axis of lanes: the field (3, N) at the b-th node of each tetrahedron."""
    for axis in range(3):
        values = field[axis]
        for corner in range(4):
            row = FIELD + 3 * corner + axis
            into = lanes[row * LANES : (row + 1) * LANES]
            at = nodes[corner * LANES : (corner + 1) * LANES]
            for w in range(LANES):
                into[w] = values[at[w]]


@njit(**INLINED)
def gather_scalar(values, nodes, lanes):
    """Rows from SUMS on of lanes: the values (N,) at the nodes of each tetrahedron."""
    for w in range(4 * LANES):
        lanes[SUMS * LANES + w] = values[nodes[w]]


@njit(**INLINED)
def scatter(lanes, nodes, field):
    """Add rows 3 b + axis from OUT on to the field (3, N) at the b-th node of each tetrahedron."""
    for axis in range(3):
        values = field[axis]
        for corner in range(4):
            added = lanes[(OUT + 3 * corner + axis) * LANES :]
            at = nodes[corner * LANES : (corner + 1) * LANES]
            for w in range(LANES):
                values[at[w]] += added[w]


@njit(**INLINED)
def scatter_scalar(lanes, nodes, values):
    """Add row OUT of lanes to the values (N,) at all four nodes of each tetrahedron."""
    for corner in range(4):
        at = nodes[corner * LANES : (corner + 1) * LANES]
        for w in range(LANES):
            values[at[w]] += lanes[OUT * LANES + w]


@njit(**INLINED)
def gradient(field, constants, w):
    """The gradient of the field whose rows `gather` has made."""
    x0, y0, z0 = three(field, FIELD, w)
    x1, y1, z1 = three(field, FIELD + 3, w)
    x2, y2, z2 = three(field, FIELD + 6, w)
    x3, y3, z3 = three(field, FIELD + 9, w)
    x1, y1, z1 = x1 - x0, y1 - y0, z1 - z0
    x2, y2, z2 = x2 - x0, y2 - y0, z2 - z0
    x3, y3, z3 = x3 - x0, y3 - y0, z3 - z0
    a0, a1, a2, b0, b1, b2, c0, c1, c2 = nine(constants, SHAPE, w)
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
def _put_row(px, py, pz, constants, w, lanes, row):
    """Along the axis of ``row``, the force of the stress's row times volume at all four nodes."""
    a0, a1, a2, b0, b1, b2, c0, c1, c2 = nine(constants, SHAPE, w)
    a = px * a0 + py * a1 + pz * a2
    b = px * b0 + py * b1 + pz * b2
    c = px * c0 + py * c1 + pz * c2
    lanes[row * LANES + w] = -(a + b + c)
    lanes[(row + 3) * LANES + w] = a
    lanes[(row + 6) * LANES + w] = b
    lanes[(row + 9) * LANES + w] = c


@njit(**INLINED)
def put_forces(p, constants, w, lanes):
    """Rows 3 b + axis from OUT on: the force of the stress p, times volume, at the b-th node."""
    _put_row(p[0], p[1], p[2], constants, w, lanes, OUT)
    _put_row(p[3], p[4], p[5], constants, w, lanes, OUT + 1)
    _put_row(p[6], p[7], p[8], constants, w, lanes, OUT + 2)
