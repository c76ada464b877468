"""A field at the corners of sixty-four cells of a box mesh, and its gradients in their tetrahedra.

The cells of a box mesh are numbered by their first node, so that the corners of sixty-four cells
are eight runs of sixty-four nodes: they are copied, not gathered. (About a tenth of the numbers, at
the upper faces, have no cell: there width and stiffness are zero.) Corner 4 x + 2 y + z of a cell
is that many nodes along x, y and z from its first. Cells are mirrored in turn along x, which here
is a negative width. In a cell, the tetrahedra p, q, r and s at its corners 0, 6, 5 and 3 have three
of its edges each, and t between them has half sums of the faces' diagonals.

Buffers are rows of `LANES` numbers, one number a cell. ``grid`` (4,) holds the number of nodes from
a cell to the next along x, y and z, and the first number beyond the last cell.

>>> import numpy as np
>>> from us_sim.tissue.elasticity.cell_lanes import add_out, copy_in
>>> from us_sim.tissue.elasticity.lanes import LANES
>>> values, grid = np.arange(8.0), np.array([4, 2, 1, 1])  # one cell
>>> width, lanes, back = np.ones(LANES), np.zeros(8 * LANES), np.zeros(8)
>>> copy_in(values, grid, 0, -width, lanes, 0, 1)
>>> lanes.reshape(8, LANES)[:, 0]
array([4., 5., 6., 7., 0., 1., 2., 3.])
>>> add_out(lanes, 0, 1, grid, 0, -width, back)
>>> bool((back == values).all())
True
"""

from __future__ import annotations

import numpy as np

from us_sim.kernels import njit
from us_sim.tissue.elasticity.lanes import LANES, put_six, three
from us_sim.tissue.elasticity.neo_hookean_point import HALF, INLINED, LOOP

PER_WIDTH = np.int64(0)  # and no literal, for each of which numba would compile what takes a row
"""Row of the constants: one over the width along x (negative where mirrored), then y and z."""

FIELD = np.int64(0)
"""First row of a buffer's field, row 3 corner + axis of it."""

SUMS = FIELD + 24
"""First row of a buffer's nodal sums, one a corner."""

PRESSURES = SUMS + 8
"""First row of a buffer's pressures in the five tetrahedra, which the nodal sums make."""

OUT = PRESSURES + 5
"""First row of a buffer's result: a field of 3 corner + axis, 6 rows a corner, or fewer."""

ROWS = OUT + 48
"""Number of rows of a buffer."""

SCALAR, _VECTOR, SYMMETRIC = np.int64(1), np.int64(3), np.int64(6)
"""Rows a corner, of a number, a vector and a symmetric matrix."""


@njit(**INLINED)
def copy_in(values, grid, first, rows, lanes, row, step):
    """Rows row + step * corner of lanes: the values (N,) at the corners 4 x + 2 y + z of cells.

    The cells are those from ``first`` on, seen mirrored along x where their width is negative.
    """
    count = min(LANES, grid[3] - first)
    for yz in range(4):
        start = first + (yz // 2) * grid[1] + (yz % 2)
        near = values[start : start + count]
        far = values[start + grid[0] : start + grid[0] + count]
        low = lanes[(row + step * yz) * LANES : (row + step * yz + 1) * LANES]
        high = lanes[(row + step * (yz + 4)) * LANES : (row + step * (yz + 4) + 1) * LANES]
        for w in range(count):
            a = near[w]
            b = far[w]
            mirrored = rows[PER_WIDTH * LANES + w] < 0
            low[w] = b if mirrored else a
            high[w] = a if mirrored else b


@njit(**INLINED)
def add_out(lanes, row, step, grid, first, rows, values):
    """The reverse of `copy_in`: add rows to the values (N,) at the corners of cells."""
    count = min(LANES, grid[3] - first)
    for yz in range(4):
        start = first + (yz // 2) * grid[1] + (yz % 2)
        low = lanes[(row + step * yz) * LANES : (row + step * yz + 1) * LANES]
        high = lanes[(row + step * (yz + 4)) * LANES : (row + step * (yz + 4) + 1) * LANES]
        near = values[start : start + count]
        for w in range(count):
            a = low[w]
            b = high[w]
            near[w] += b if rows[PER_WIDTH * LANES + w] < 0 else a
        far = values[start + grid[0] : start + grid[0] + count]
        for w in range(count):
            a = low[w]
            b = high[w]
            far[w] += a if rows[PER_WIDTH * LANES + w] < 0 else b


@njit(**LOOP)
def copy_field(field, grid, first, rows, lanes):
    """Rows 3 corner + axis of lanes: the field (3, N) at the corners of cells."""
    for axis in range(3):
        copy_in(field[axis], grid, first, rows, lanes, FIELD + axis, _VECTOR)


@njit(**LOOP)
def add_field(lanes, grid, first, rows, field):
    """Add rows 3 corner + axis from OUT on to the field (3, N)."""
    for axis in range(3):
        add_out(lanes, OUT + axis, _VECTOR, grid, first, rows, field[axis])


@njit(**INLINED)
def _corners(field, w):
    """The field at each of the eight corners."""
    return (
        three(field, FIELD, w),
        three(field, FIELD + 3, w),
        three(field, FIELD + 6, w),
        three(field, FIELD + 9, w),
        three(field, FIELD + 12, w),
        three(field, FIELD + 15, w),
        three(field, FIELD + 18, w),
        three(field, FIELD + 21, w),
    )


@njit(**INLINED)
def _corner_gradient(x0, x1, y0, y1, z0, z1, g):
    """The gradient at a corner, of a field at the lower and upper ends of its three edges."""
    return (
        (x1[0] - x0[0]) * g[0],
        (y1[0] - y0[0]) * g[1],
        (z1[0] - z0[0]) * g[2],
        (x1[1] - x0[1]) * g[0],
        (y1[1] - y0[1]) * g[1],
        (z1[1] - z0[1]) * g[2],
        (x1[2] - x0[2]) * g[0],
        (y1[2] - y0[2]) * g[1],
        (z1[2] - z0[2]) * g[2],
    )


@njit(**INLINED)
def _middle_gradient(b, c, e, h, g):
    """The gradient in the tetrahedron between the corners 1, 2, 4 and 7."""
    i, j, k = HALF * g[0], HALF * g[1], HALF * g[2]
    return (
        ((e[0] - b[0]) + (h[0] - c[0])) * i,
        ((c[0] - b[0]) + (h[0] - e[0])) * j,
        ((b[0] - c[0]) + (h[0] - e[0])) * k,
        ((e[1] - b[1]) + (h[1] - c[1])) * i,
        ((c[1] - b[1]) + (h[1] - e[1])) * j,
        ((b[1] - c[1]) + (h[1] - e[1])) * k,
        ((e[2] - b[2]) + (h[2] - c[2])) * i,
        ((c[2] - b[2]) + (h[2] - e[2])) * j,
        ((b[2] - c[2]) + (h[2] - e[2])) * k,
    )


@njit(**INLINED)
def gradients(field, rows, w):
    """The gradients in the five tetrahedra of a cell."""
    a, b, c, d, e, f, g, h = _corners(field, w)
    per = three(rows, PER_WIDTH, w)
    return (
        _corner_gradient(a, e, a, c, a, b, per),
        _corner_gradient(c, g, e, g, g, h, per),
        _corner_gradient(b, f, f, h, e, f, per),
        _corner_gradient(d, h, b, d, c, d, per),
        _middle_gradient(b, c, e, h, per),
    )


@njit(**INLINED)
def _corner_forces(px, py, pz, qx, qy, qz, rx, ry, rz, sx, sy, sz, tx, ty, tz, g):
    """Along one axis, the forces at the eight corners of rows of five stresses times volumes."""
    px, py, pz = px * g[0], py * g[1], pz * g[2]
    qx, qy, qz = qx * g[0], qy * g[1], qz * g[2]
    rx, ry, rz = rx * g[0], ry * g[1], rz * g[2]
    sx, sy, sz = sx * g[0], sy * g[1], sz * g[2]
    tx, ty, tz = tx * (HALF * g[0]), ty * (HALF * g[1]), tz * (HALF * g[2])
    return (
        -(px + py + pz),
        (tz - tx - ty) + (pz - rx - sy),
        (ty - tx - tz) + (py - qx - sz),
        (sy + sz) - sx,
        (tx - ty - tz) + (px - qy - rz),
        (rx + rz) - ry,
        (qx + qy) - qz,
        (tx + ty + tz) + (qz + ry + sx),
    )


@njit(**INLINED)
def _put_eight(values, lanes, row, step, w):
    """Rows row + step * corner."""
    v, d = row * LANES + w, step * LANES
    lanes[v] = values[0]
    lanes[v + d] = values[1]
    lanes[v + 2 * d] = values[2]
    lanes[v + 3 * d] = values[3]
    lanes[v + 4 * d] = values[4]
    lanes[v + 5 * d] = values[5]
    lanes[v + 6 * d] = values[6]
    lanes[v + 7 * d] = values[7]


@njit(**INLINED)
def put_forces(p, q, r, s, t, rows, w, lanes):
    """Rows 3 corner + axis from OUT on: the forces of five stresses times volumes."""
    g = three(rows, PER_WIDTH, w)
    x = _corner_forces(
        p[0], p[1], p[2], q[0], q[1], q[2], r[0], r[1], r[2], s[0], s[1], s[2], t[0], t[1], t[2], g
    )
    _put_eight(x, lanes, OUT, _VECTOR, w)
    y = _corner_forces(
        p[3], p[4], p[5], q[3], q[4], q[5], r[3], r[4], r[5], s[3], s[4], s[5], t[3], t[4], t[5], g
    )
    _put_eight(y, lanes, OUT + 1, _VECTOR, w)
    z = _corner_forces(
        p[6], p[7], p[8], q[6], q[7], q[8], r[6], r[7], r[8], s[6], s[7], s[8], t[6], t[7], t[8], g
    )
    _put_eight(z, lanes, OUT + 2, _VECTOR, w)


@njit(**INLINED)
def put_volumes(p, q, r, s, t, w, lanes):
    """Rows corner from OUT on: the five tetrahedra's contributions to each corner, summed."""
    at_one, at_two, at_four = (p + t) + (r + s), (p + t) + (q + s), (p + t) + (q + r)
    corners = (p, at_one, at_two, s, at_four, r, q, t + (q + r + s))
    _put_eight(corners, lanes, OUT, SCALAR, w)


@njit(**INLINED)
def put_sum(a, b, c, d, lanes, row, w):
    """Six rows from ``row`` on: the sum of four blocks."""
    total = (
        (a[0] + b[0]) + (c[0] + d[0]),
        (a[1] + b[1]) + (c[1] + d[1]),
        (a[2] + b[2]) + (c[2] + d[2]),
        (a[3] + b[3]) + (c[3] + d[3]),
        (a[4] + b[4]) + (c[4] + d[4]),
        (a[5] + b[5]) + (c[5] + d[5]),
    )
    put_six(total, lanes, row, w)
