"""Sums of a neo-Hookean material over the cells of a box mesh, sixty-four at a time.

The cells of a box mesh are numbered by their first node, so that the corners of sixty-four cells
are eight runs of sixty-four nodes: they are copied, not gathered. (About a tenth of the numbers, at
the upper faces, have no cell: there width and stiffness are zero.) Corner 4 x + 2 y + z of a cell
is that many nodes along x, y and z from its first. Cells are mirrored in turn along x, which here
is a negative width. In a cell, the tetrahedra p, q, r and s at its corners 0, 6, 5 and 3 have three
of its edges each, and t between them has half sums of the faces' diagonals.

Buffers are rows of `LANES` numbers, one number a cell. ``grid`` (4,) holds the number of nodes from
a cell to the next along x, y and z, and the first number beyond the last cell. Loops without
branches run over the lanes, which LLVM vectorises. The same input gives the same bytes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike

from us_sim.kernels import njit
from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.elasticity.neo_hookean_material import (
    CONSTANTS,
    HALF,
    INLINED,
    LOOP,
    ONE,
    barrier_term,
    bulk_slope,
    cofactor_change,
    diagonal_block,
    energy_density,
    neo_hookean_constants,
    piola_stress,
    stress_rise,
    volume_change,
    volume_slope,
)
from us_sim.tissue.elasticity.nodal_sums import (
    LANES,
    NodalSums,
    get_five,
    get_three,
    lumen_energy_at,
    pack_groups,
    pack_lanes,
    put_six,
)
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh

# Row of the constants: one over the width along x (negative where mirrored), then y and z.
PER_WIDTH = np.int64(0)  # numba compiles callers again for each literal
FIELD = np.int64(0)  # First row of a buffer's field, row 3 corner + axis of it
SUMS = FIELD + 24  # First row of a buffer's nodal sums, one a corner
# First row of a buffer's pressures in the five tetrahedra, which the nodal sums make.
PRESSURES = SUMS + 8
# First row of a buffer's result: a field of 3 corner + axis, 6 rows a corner, or fewer.
OUT = PRESSURES + 5
ROWS = OUT + 48  # Number of rows of a buffer
# Rows a corner, of a number, a vector and a symmetric matrix.
SCALAR, _VECTOR, SYMMETRIC = np.int64(1), np.int64(3), np.int64(6)


@njit(**INLINED)
def copy_in(values, grid, first, rows, lanes, row, step):
    """Fill rows row + step * corner with the values (N,) at the corners 4 x + 2 y + z of cells.

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
    """Add rows to the values (N,) at the corners of cells: the reverse of `copy_in`."""
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
    """Fill rows 3 corner + axis with the field (3, N) at the corners of cells."""
    for axis in range(3):
        copy_in(field[axis], grid, first, rows, lanes, FIELD + axis, _VECTOR)


@njit(**LOOP)
def add_field(lanes, grid, first, rows, field):
    """Add rows 3 corner + axis from OUT on to the field (3, N)."""
    for axis in range(3):
        add_out(lanes, OUT + axis, _VECTOR, grid, first, rows, field[axis])


@njit(**INLINED)
def _corners(field, w):
    return (
        get_three(field, FIELD, w),
        get_three(field, FIELD + 3, w),
        get_three(field, FIELD + 6, w),
        get_three(field, FIELD + 9, w),
        get_three(field, FIELD + 12, w),
        get_three(field, FIELD + 15, w),
        get_three(field, FIELD + 18, w),
        get_three(field, FIELD + 21, w),
    )


@njit(**INLINED)
def _corner_gradient(x0, x1, y0, y1, z0, z1, g):
    """Return the gradient at a corner, of a field at the two ends of each of its three edges."""
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
    """Return the gradient in the tetrahedron between the corners 1, 2, 4 and 7."""
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
    """Return the gradients in the five tetrahedra of a cell."""
    a, b, c, d, e, f, g, h = _corners(field, w)
    per = get_three(rows, PER_WIDTH, w)
    return (
        _corner_gradient(a, e, a, c, a, b, per),
        _corner_gradient(c, g, e, g, g, h, per),
        _corner_gradient(b, f, f, h, e, f, per),
        _corner_gradient(d, h, b, d, c, d, per),
        _middle_gradient(b, c, e, h, per),
    )


@njit(**INLINED)
def _corner_forces(  # noqa: PLR0913
    px, py, pz, qx, qy, qz, rx, ry, rz, sx, sy, sz, tx, ty, tz, g
):
    """Return forces along one axis at the eight corners, of rows of five stresses times volumes."""
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
    """Fill rows row + step * corner with eight values."""
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
    """Fill rows OUT + 3 corner + axis with the forces of five stresses times volumes."""
    g = get_three(rows, PER_WIDTH, w)
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
    """Fill rows OUT + corner with the sum of the five tetrahedra's contributions."""
    at_one, at_two, at_four = (p + t) + (r + s), (p + t) + (q + s), (p + t) + (q + r)
    corners = (p, at_one, at_two, s, at_four, r, q, t + (q + r + s))
    _put_eight(corners, lanes, OUT, SCALAR, w)


@njit(**INLINED)
def put_sum(a, b, c, d, lanes, row, w):
    """Fill six rows from ``row`` on with the sum of four blocks."""
    total = (
        (a[0] + b[0]) + (c[0] + d[0]),
        (a[1] + b[1]) + (c[1] + d[1]),
        (a[2] + b[2]) + (c[2] + d[2]),
        (a[3] + b[3]) + (c[3] + d[3]),
        (a[4] + b[4]) + (c[4] + d[4]),
        (a[5] + b[5]) + (c[5] + d[5]),
    )
    put_six(total, lanes, row, w)


_SHEAR, _ELEMENT, _NODAL = PER_WIDTH + 3, PER_WIDTH + 8, PER_WIDTH + 13
# First rows of the constants behind the widths: V mu, V element, V nodal / 4 and V wall of each
# of the five tetrahedra; and the number of rows.
_WALL, _CONSTANTS = PER_WIDTH + 18, PER_WIDTH + 23
# First rows of V (p - mu) and of V times the slope of p by J, which the tangent needs, behind the
# displacement; and the number of rows.
_K, _BULK, _TANGENT = FIELD + 24, FIELD + 29, FIELD + 34
# First row of energies, behind those of forces: all but the lumens', then those of each of the
# five tetrahedra's.
_ENERGY = OUT + 24


@njit(**INLINED)
def add_lumens(field, rows, lumen, entry, row, lanes):
    """Add an entry of `lumen_energy_at` of each tetrahedron to the five rows from ``row`` on."""
    for w in range(LANES):
        p, q, r, s, t = gradients(field, rows, w)
        v = row * LANES + w
        lanes[v] += lumen_energy_at(p, lumen, w, 5 * LANES)[entry]
        lanes[v + LANES] += lumen_energy_at(q, lumen, w + LANES, 5 * LANES)[entry]
        lanes[v + 2 * LANES] += lumen_energy_at(r, lumen, w + 2 * LANES, 5 * LANES)[entry]
        lanes[v + 3 * LANES] += lumen_energy_at(s, lumen, w + 3 * LANES, 5 * LANES)[entry]
        lanes[v + 4 * LANES] += lumen_energy_at(t, lumen, w + 4 * LANES, 5 * LANES)[entry]


@njit(**LOOP)
def _nodal_pressures(nodal, grid, first, rows, lanes):
    """Fill rows from PRESSURES on with each tetrahedron's nodal weight times its nodes' sum."""
    copy_in(nodal, grid, first, rows, lanes, SUMS, SCALAR)
    for w in range(LANES):
        v = SUMS * LANES + w
        s1, s2 = lanes[v + LANES], lanes[v + 2 * LANES]
        s4, s7 = lanes[v + 4 * LANES], lanes[v + 7 * LANES]
        s0, s3 = lanes[v], lanes[v + 3 * LANES]
        s5, s6 = lanes[v + 5 * LANES], lanes[v + 6 * LANES]
        c = _NODAL * LANES + w
        p = PRESSURES * LANES + w
        lanes[p] = rows[c] * ((s0 + s1) + (s2 + s4))
        lanes[p + LANES] = rows[c + LANES] * ((s6 + s7) + (s2 + s4))
        lanes[p + 2 * LANES] = rows[c + 2 * LANES] * ((s5 + s7) + (s1 + s4))
        lanes[p + 3 * LANES] = rows[c + 3 * LANES] * ((s3 + s7) + (s1 + s2))
        lanes[p + 4 * LANES] = rows[c + 4 * LANES] * ((s1 + s2) + (s4 + s7))


@njit(**INLINED)
def _pressure(h, element, wall, nodal):
    """Return V times the slope by J of all energy but the shear's; ``nodal`` is the nodes' part."""
    change = volume_change(h)
    return element * change + nodal + wall * barrier_term(change)[1]


@njit(**INLINED)
def _tetrahedron_stress(h, shear, element, wall, nodal):
    return piola_stress(h, shear, _pressure(h, element, wall, nodal))


@njit(**INLINED)
def _count(ratio, least, count):
    """Return the least ratio so far, NaN if any was, and how many were not above zero."""
    least = ratio if ratio < least or np.isnan(ratio) else least
    return least, count if ratio > 0 else count + ONE


@njit(**LOOP)
def _volume_ratios(displacement, grid, constants, lanes):
    smallest = np.inf
    inverted = 0
    for chunk in range(len(constants)):
        rows = constants[chunk]
        first = chunk * LANES
        copy_field(displacement, grid, first, rows, lanes)
        for w in range(LANES):
            p, q, r, s, t = gradients(lanes, rows, w)
            least, count = _count(ONE + volume_change(p), np.float32(np.inf), ONE - ONE)
            least, count = _count(ONE + volume_change(q), least, count)
            least, count = _count(ONE + volume_change(r), least, count)
            least, count = _count(ONE + volume_change(s), least, count)
            lanes[OUT * LANES + w], lanes[(OUT + 1) * LANES + w] = _count(
                ONE + volume_change(t), least, count
            )
        for w in range(min(LANES, grid[3] - first)):
            least = lanes[OUT * LANES + w]
            if rows[PER_WIDTH * LANES + w] != 0 and (least < smallest or np.isnan(least)):
                smallest = least
            inverted += int(lanes[(OUT + 1) * LANES + w])
    return smallest, inverted


@njit(**LOOP)
def _volume_changes(displacement, grid, constants, lanes, nodal):
    nodal[:] = 0
    for chunk in range(len(constants)):
        rows = constants[chunk]
        first = chunk * LANES
        copy_field(displacement, grid, first, rows, lanes)
        for w in range(LANES):
            p, q, r, s, t = gradients(lanes, rows, w)
            weight = get_five(rows, _NODAL, w)
            put_volumes(
                weight[0] * volume_change(p),
                weight[1] * volume_change(q),
                weight[2] * volume_change(r),
                weight[3] * volume_change(s),
                weight[4] * volume_change(t),
                w,
                lanes,
            )
        add_out(lanes, OUT, SCALAR, grid, first, rows, nodal)


@njit(**LOOP)
def _energy_and_forces(displacement, nodal, grid, constants, lumens, lanes, forces):
    forces[:, :] = 0
    total = 0.0
    for chunk in range(len(constants)):
        rows = constants[chunk]
        first = chunk * LANES
        if len(nodal):
            _nodal_pressures(nodal, grid, first, rows, lanes)
        copy_field(displacement, grid, first, rows, lanes)
        entries = 1
        if lumens[0][chunk] >= 0:
            entries = 6
            lumen = lumens[1][lumens[0][chunk]]
            lanes[(_ENERGY + 1) * LANES : (_ENERGY + 6) * LANES] = 0
            add_lumens(lanes, rows, lumen, 0, _ENERGY + 1, lanes)
            add_lumens(lanes, rows, lumen, 1, PRESSURES, lanes)
        for w in range(LANES):
            p, q, r, s, t = gradients(lanes, rows, w)
            shear = get_five(rows, _SHEAR, w)
            element, wall = get_five(rows, _ELEMENT, w), get_five(rows, _WALL, w)
            mean = get_five(lanes, PRESSURES, w)
            lanes[_ENERGY * LANES + w] = (
                (
                    energy_density(p, shear[0], element[0], wall[0])
                    + energy_density(q, shear[1], element[1], wall[1])
                )
                + (
                    energy_density(r, shear[2], element[2], wall[2])
                    + energy_density(s, shear[3], element[3], wall[3])
                )
                + energy_density(t, shear[4], element[4], wall[4])
            )
            put_forces(
                _tetrahedron_stress(p, shear[0], element[0], wall[0], mean[0]),
                _tetrahedron_stress(q, shear[1], element[1], wall[1], mean[1]),
                _tetrahedron_stress(r, shear[2], element[2], wall[2], mean[2]),
                _tetrahedron_stress(s, shear[3], element[3], wall[3], mean[3]),
                _tetrahedron_stress(t, shear[4], element[4], wall[4], mean[4]),
                rows,
                w,
                lanes,
            )
        if lumens[0][chunk] >= 0:
            lanes[PRESSURES * LANES : (PRESSURES + 5) * LANES] = 0
        add_field(lanes, grid, first, rows, forces)
        for entry in range(_ENERGY, _ENERGY + entries):
            for w in range(min(LANES, grid[3] - first)):
                total += lanes[entry * LANES + w]
    return total


@njit(**LOOP)
def _linearise(displacement, nodal, grid, constants, lumens, lanes, tangent):
    for chunk in range(len(constants)):
        rows = constants[chunk]
        first = chunk * LANES
        kept = tangent[chunk]
        if len(nodal):
            _nodal_pressures(nodal, grid, first, rows, lanes)
        copy_field(displacement, grid, first, rows, kept)
        if lumens[0][chunk] >= 0:
            add_lumens(kept, rows, lumens[1][lumens[0][chunk]], 1, PRESSURES, lanes)
        for w in range(LANES):
            p, q, r, s, t = gradients(kept, rows, w)
            shear = get_five(rows, _SHEAR, w)
            element, wall = get_five(rows, _ELEMENT, w), get_five(rows, _WALL, w)
            mean = get_five(lanes, PRESSURES, w)
            k, bulk = _K * LANES + w, _BULK * LANES + w
            kept[k] = _pressure(p, element[0], wall[0], mean[0]) - shear[0]
            kept[k + LANES] = _pressure(q, element[1], wall[1], mean[1]) - shear[1]
            kept[k + 2 * LANES] = _pressure(r, element[2], wall[2], mean[2]) - shear[2]
            kept[k + 3 * LANES] = _pressure(s, element[3], wall[3], mean[3]) - shear[3]
            kept[k + 4 * LANES] = _pressure(t, element[4], wall[4], mean[4]) - shear[4]
            kept[bulk] = bulk_slope(volume_change(p), element[0], wall[0])
            kept[bulk + LANES] = bulk_slope(volume_change(q), element[1], wall[1])
            kept[bulk + 2 * LANES] = bulk_slope(volume_change(r), element[2], wall[2])
            kept[bulk + 3 * LANES] = bulk_slope(volume_change(s), element[3], wall[3])
            kept[bulk + 4 * LANES] = bulk_slope(volume_change(t), element[4], wall[4])
        if lumens[0][chunk] >= 0:
            add_lumens(kept, rows, lumens[1][lumens[0][chunk]], 2, _BULK, kept)
            lanes[PRESSURES * LANES : (PRESSURES + 5) * LANES] = 0


@njit(**LOOP)
def _volume_slopes(change, grid, constants, tangent, lanes, nodal):
    nodal[:] = 0
    for chunk in range(len(constants)):
        rows = constants[chunk]
        first = chunk * LANES
        copy_field(change, grid, first, rows, lanes)
        kept = tangent[chunk]
        for w in range(LANES):
            p, q, r, s, t = gradients(kept, rows, w)
            weight = get_five(rows, _NODAL, w)
            dp, dq, dr, ds, dt = gradients(lanes, rows, w)
            put_volumes(
                weight[0] * volume_slope(p, dp),
                weight[1] * volume_slope(q, dq),
                weight[2] * volume_slope(r, dr),
                weight[3] * volume_slope(s, ds),
                weight[4] * volume_slope(t, dt),
                w,
                lanes,
            )
        add_out(lanes, OUT, SCALAR, grid, first, rows, nodal)


@njit(**LOOP)
def _tangent_product(change, nodal, grid, constants, tangent, lanes, product):
    product[:, :] = 0
    for chunk in range(len(constants)):
        rows = constants[chunk]
        first = chunk * LANES
        if len(nodal):
            _nodal_pressures(nodal, grid, first, rows, lanes)
        copy_field(change, grid, first, rows, lanes)
        kept = tangent[chunk]
        for w in range(LANES):
            p, q, r, s, t = gradients(kept, rows, w)
            shear = get_five(rows, _SHEAR, w)
            bulk, k = get_five(kept, _BULK, w), get_five(kept, _K, w)
            mean = get_five(lanes, PRESSURES, w)
            dp, dq, dr, ds, dt = gradients(lanes, rows, w)
            put_forces(
                stress_rise(p, dp, shear[0], bulk[0], k[0], mean[0]),
                stress_rise(q, dq, shear[1], bulk[1], k[1], mean[1]),
                stress_rise(r, dr, shear[2], bulk[2], k[2], mean[2]),
                stress_rise(s, ds, shear[3], bulk[3], k[3], mean[3]),
                stress_rise(t, dt, shear[4], bulk[4], k[4], mean[4]),
                rows,
                w,
                lanes,
            )
        add_field(lanes, grid, first, rows, product)


@njit(**INLINED)
def _corner_blocks(h, i, j, k, shear, bulk):
    """Return blocks of a corner tetrahedron: of its corner, and of its edges' ends along x, y, z.

    i, j and k are the shape gradient of its corner.
    """
    c = cofactor_change(h)
    none = ONE - ONE
    return (
        diagonal_block((i, j, k), c, shear, bulk),
        diagonal_block((i, none, none), c, shear, bulk),
        diagonal_block((none, j, none), c, shear, bulk),
        diagonal_block((none, none, k), c, shear, bulk),
    )


@njit(**LOOP)
def _diagonal_blocks(grid, constants, tangent, lanes, blocks):
    blocks[:, :] = 0
    for chunk in range(len(constants)):
        rows = constants[chunk]
        kept = tangent[chunk]
        for w in range(LANES):
            p, q, r, s, t = gradients(kept, rows, w)
            shear = get_five(rows, _SHEAR, w)
            bulk = get_five(kept, _BULK, w)
            i, j, k = get_three(rows, PER_WIDTH, w)
            p0, px, py, pz = _corner_blocks(p, -i, -j, -k, shear[0], bulk[0])
            q0, qx, qy, qz = _corner_blocks(q, i, j, -k, shear[1], bulk[1])
            r0, rx, ry, rz = _corner_blocks(r, i, -j, k, shear[2], bulk[2])
            s0, sx, sy, sz = _corner_blocks(s, -i, j, k, shear[3], bulk[3])
            i, j, k = HALF * i, HALF * j, HALF * k
            c = cofactor_change(t)
            put_six(p0, lanes, OUT, w)
            put_sum(
                diagonal_block((-i, -j, k), c, shear[4], bulk[4]), pz, rx, sy, lanes, OUT + 6, w
            )
            put_sum(
                diagonal_block((-i, j, -k), c, shear[4], bulk[4]), py, qx, sz, lanes, OUT + 12, w
            )
            put_six(s0, lanes, OUT + 18, w)
            put_sum(
                diagonal_block((i, -j, -k), c, shear[4], bulk[4]), px, qy, rz, lanes, OUT + 24, w
            )
            put_six(r0, lanes, OUT + 30, w)
            put_six(q0, lanes, OUT + 36, w)
            put_sum(diagonal_block((i, j, k), c, shear[4], bulk[4]), qz, ry, sx, lanes, OUT + 42, w)
        for entry in range(6):
            add_out(lanes, OUT + entry, SYMMETRIC, grid, chunk * LANES, rows, blocks[entry])


def make_cell_sums(
    mesh: TetrahedralMesh, materials: TissueMaterials, dtype: DTypeLike
) -> NodalSums:
    """Make the sums over the tetrahedra of a box mesh at its nodes."""
    assert mesh.planes is not None
    shape = tuple(len(planes) for planes in mesh.planes)
    widths = [np.diff(planes) for planes in mesh.planes]
    cells = np.indices([n - 1 for n in shape]).reshape(3, -1)
    number = (cells[0] * shape[1] + cells[1]) * shape[2] + cells[2]
    rows = np.zeros((number[-1] + 1, _CONSTANTS))
    for axis in range(3):
        rows[number, PER_WIDTH + axis] = 1 / widths[axis][cells[axis]]
    rows[number, PER_WIDTH] *= 1 - 2 * (cells.sum(axis=0) % 2)
    made = neo_hookean_constants(mesh, materials)
    rows[number, _SHEAR:_ELEMENT] = (mesh.volumes * made.shear).reshape(-1, 5)
    rows[number, _ELEMENT:_NODAL] = (mesh.volumes * made.element).reshape(-1, 5)
    rows[number, _NODAL:_WALL] = (mesh.volumes * made.nodal / 4).reshape(-1, 5)
    rows[number, _WALL:] = (mesh.volumes * made.wall).reshape(-1, 5)
    lumens = np.zeros((len(rows), 5, CONSTANTS))
    lumens[number] = made.lumen_energies(mesh).reshape(-1, 5, CONSTANTS)
    constants = pack_lanes(rows).astype(dtype)
    return NodalSums(
        _volume_ratios,
        _volume_changes,
        _energy_and_forces,
        _linearise,
        _volume_slopes,
        _tangent_product,
        _diagonal_blocks,
        # Steps in node number from a cell's corner to the next along x, y, z; the end of the cells.
        nodes=np.array([shape[1] * shape[2], shape[2], 1, number[-1] + 1]),
        constants=constants,
        lumens=pack_groups(lumens, dtype),
        tangent=np.zeros((len(constants), _TANGENT * LANES), dtype=dtype),
        lanes=np.zeros(ROWS * LANES, dtype=dtype),
    )
