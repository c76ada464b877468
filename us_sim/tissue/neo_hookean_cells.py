"""Sums of a stable neo-Hookean material over the cells of a box mesh, sixty-four at a time.

The cells of a box mesh are numbered by their first node, so that what sixty-four cells need lies in
eight runs of sixty-four nodes: it is copied, not gathered. (Numbers that have no cell, at the far
faces, have no stiffness; a tenth or so of them.) Cells are mirrored in turn along x, which here is
a negative width. In a cell, one tetrahedron at each of four corners has three of the cell's edges,
and the one between them has half sums of face diagonals, so gradients need no matrix.

>>> import numpy as np
>>> from us_sim.tissue.materials import Material, uniform_material
>>> from us_sim.tissue.mesh import box_mesh
>>> from us_sim.tissue.neo_hookean_cells import CellSums
>>> mesh = box_mesh([0.0, 0.1, 0.3], [0.0, 0.1], [0.0, 0.1])
>>> sums = CellSums(mesh, uniform_material(mesh, Material(3e3, 0.2, 1000.0)), np.float64)
>>> stretch = np.ascontiguousarray(mesh.nodes.T) * [[0.2], [0.0], [0.0]]
>>> smallest, inverted = sums.volume_ratios(stretch)
>>> f"{smallest:.6f} {inverted}"
'1.200000 0'
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import DTypeLike, NDArray

from us_sim.tissue.bulk_shares import bulk_shares
from us_sim.tissue.materials import TissueMaterials
from us_sim.tissue.mesh import TetrahedralMesh
from us_sim.tissue.neo_hookean_point import (
    HALF,
    INLINED,
    LOOP,
    ONE,
    block,
    cofactor_change,
    energy_density,
    inner,
    limited,
    stress,
    stress_slope,
    volume_change,
)

__all__ = ["CellSums"]

# Cells in one buffer: a few vectors of the widest kind, and all its rows stay in the L1 cache.
_LANES = 64

# Rows of the constants of sixty-four cells: one over the widths along x (negative where mirrored),
# y and z; then, of each of the five tetrahedra, V mu, V element and V nodal / 4.
_SHEAR, _ELEMENT, _NODAL, _CONSTANTS = 3, 8, 13, 18

# Rows of what the tangent needs: the displacement of eight corners, V (p - mu) of five tetrahedra.
_K, _TANGENT = 24, 29

# Rows of the buffer: a field at eight corners, the nodes' sums there, what they make in the five
# tetrahedra, and from _OUT on what comes out.
_SUM, _SHARE, _OUT, _BUFFER = 24, 32, 37, 37 + 48


class CellSums:
    """Energies, forces and their slopes of every tetrahedron of a box mesh, summed at the nodes.

    ``nodal`` arguments are (N,) sums or means of the nodes' share of the bulk stiffness, or empty
    where there is none.
    """

    def __init__(self, mesh: TetrahedralMesh, materials: TissueMaterials, dtype: DTypeLike) -> None:
        if mesh.planes is None:
            raise ValueError("only a box mesh has cells")
        shape = tuple(len(planes) for planes in mesh.planes)
        widths = [np.diff(planes) for planes in mesh.planes]
        cells = np.indices([n - 1 for n in shape]).reshape(3, -1)
        number = (cells[0] * shape[1] + cells[1]) * shape[2] + cells[2]
        chunks = -(-(int(number[-1]) + 1) // _LANES)
        rows = np.zeros((chunks * _LANES, _CONSTANTS))
        for axis in range(3):
            rows[number, axis] = 1 / widths[axis][cells[axis]]
        rows[number, 0] *= 1 - 2 * (cells.sum(axis=0) % 2)
        shares = bulk_shares(materials)
        rows[number, _SHEAR:_ELEMENT] = (mesh.volumes * shares.shear).reshape(-1, 5)
        rows[number, _ELEMENT:_NODAL] = (mesh.volumes * shares.element).reshape(-1, 5)
        rows[number, _NODAL:] = (mesh.volumes * shares.nodal / 4).reshape(-1, 5)
        lanes = rows.reshape(chunks, _LANES, _CONSTANTS).transpose(0, 2, 1)
        self._constants = np.ascontiguousarray(lanes.reshape(chunks, -1), dtype=dtype)
        # Nodes from one corner of a cell to the next along x, y and z, and the last cell's number.
        self._grid = np.array([shape[1] * shape[2], shape[2], 1, number[-1] + 1])
        self._tangent = np.zeros((chunks, _TANGENT * _LANES), dtype=dtype)
        self._lanes = np.zeros(_BUFFER * _LANES, dtype=dtype)

    def energy(self, displacement: NDArray) -> float:
        """J, of the tetrahedra's own share."""
        return _energy(displacement, self._grid, self._constants, self._lanes)

    def volume_ratios(self, displacement: NDArray) -> tuple[float, int]:
        """The smallest volume over rest volume, and how many are not above zero."""
        return _volume_ratios(displacement, self._grid, self._constants, self._lanes)

    def volume_changes(self, displacement: NDArray, nodal: NDArray) -> None:
        """J, at each node the sum over its tetrahedra of their nodal weight times J - 1."""
        _volume_changes(displacement, self._grid, self._constants, self._lanes, nodal)

    def forces(self, displacement: NDArray, nodal: NDArray, out: NDArray) -> None:
        """(3, N) N, the energy's slope, given the nodes' mean volume change."""
        _forces(displacement, nodal, self._grid, self._constants, self._lanes, out)

    def linearise(self, displacement: NDArray, nodal: NDArray, loosest: np.floating) -> None:
        """Keep what the slopes at this displacement need, ``loosest`` being that of `limited`."""
        _linearise(
            displacement, nodal, self._grid, self._constants, self._lanes, self._tangent, loosest
        )

    def volume_slopes(self, change: NDArray, nodal: NDArray) -> None:
        """J, how much `volume_changes` changes with the displacement."""
        _volume_slopes(change, self._grid, self._constants, self._tangent, self._lanes, nodal)

    def tangent_product(self, change: NDArray, nodal: NDArray, out: NDArray) -> None:
        """(3, N) N, how much the forces change, given the change of the nodes' mean."""
        _tangent_product(
            change, nodal, self._grid, self._constants, self._tangent, self._lanes, out
        )

    def diagonal_blocks(self, out: NDArray) -> None:
        """(6, N) N/m xx, xy, xz, yy, yz, zz of each node's block, without the nodes' share."""
        _diagonal_blocks(self._grid, self._constants, self._tangent, self._lanes, out)


@njit(**INLINED)
def _copy_in(values, grid, first, rows, lanes, row, step):
    """Rows row + step * corner of lanes: the values (N,) at the corners 4 x + 2 y + z of cells.

    The cells are those from ``first`` on, seen mirrored along x where their width is negative.
    """
    count = min(_LANES, grid[3] - first)
    for yz in range(4):
        start = first + (yz // 2) * grid[1] + (yz % 2)
        near = values[start : start + count]
        far = values[start + grid[0] : start + grid[0] + count]
        low = lanes[(row + step * yz) * _LANES : (row + step * yz + 1) * _LANES]
        high = lanes[(row + step * (yz + 4)) * _LANES : (row + step * (yz + 4) + 1) * _LANES]
        for w in range(count):
            a = near[w]
            b = far[w]
            mirrored = rows[w] < 0
            low[w] = b if mirrored else a
            high[w] = a if mirrored else b


@njit(**INLINED)
def _add_out(lanes, row, step, grid, first, rows, values):
    """The reverse of `_copy_in`: add rows to the values (N,) at the corners of cells."""
    count = min(_LANES, grid[3] - first)
    for yz in range(4):
        start = first + (yz // 2) * grid[1] + (yz % 2)
        low = lanes[(row + step * yz) * _LANES : (row + step * yz + 1) * _LANES]
        high = lanes[(row + step * (yz + 4)) * _LANES : (row + step * (yz + 4) + 1) * _LANES]
        near = values[start : start + count]
        for w in range(count):
            a = low[w]
            b = high[w]
            near[w] += b if rows[w] < 0 else a
        far = values[start + grid[0] : start + grid[0] + count]
        for w in range(count):
            a = low[w]
            b = high[w]
            far[w] += a if rows[w] < 0 else b


@njit(**LOOP)
def _copy_field(field, grid, first, rows, lanes):
    """Rows 3 corner + axis of lanes: the field (3, N) at the corners of cells."""
    for axis in range(3):
        _copy_in(field[axis], grid, first, rows, lanes, axis, 3)


@njit(**LOOP)
def _add_field(lanes, grid, first, rows, field):
    """Add rows 3 corner + axis from _OUT on to the field (3, N)."""
    for axis in range(3):
        _add_out(lanes, _OUT + axis, 3, grid, first, rows, field[axis])


@njit(**LOOP)
def _share_nodal(nodal, grid, first, rows, lanes):
    """Rows from _SHARE on: each tetrahedron's nodal weight times the sum of its nodes' values."""
    _copy_in(nodal, grid, first, rows, lanes, _SUM, 1)
    for w in range(_LANES):
        v = _SUM * _LANES + w
        one, two = lanes[v + _LANES], lanes[v + 2 * _LANES]
        four, seven = lanes[v + 4 * _LANES], lanes[v + 7 * _LANES]
        zero, three = lanes[v], lanes[v + 3 * _LANES]
        five, six = lanes[v + 5 * _LANES], lanes[v + 6 * _LANES]
        c = _NODAL * _LANES + w
        share = _SHARE * _LANES + w
        lanes[share] = rows[c] * ((zero + one) + (two + four))
        lanes[share + _LANES] = rows[c + _LANES] * ((six + seven) + (two + four))
        lanes[share + 2 * _LANES] = rows[c + 2 * _LANES] * ((five + seven) + (one + four))
        lanes[share + 3 * _LANES] = rows[c + 3 * _LANES] * ((three + seven) + (one + two))
        lanes[share + 4 * _LANES] = rows[c + 4 * _LANES] * ((one + two) + (four + seven))


@njit(**INLINED)
def _corners(rows, w):
    """Three rows of each of the eight corners."""
    return (
        (rows[w], rows[_LANES + w], rows[2 * _LANES + w]),
        (rows[3 * _LANES + w], rows[4 * _LANES + w], rows[5 * _LANES + w]),
        (rows[6 * _LANES + w], rows[7 * _LANES + w], rows[8 * _LANES + w]),
        (rows[9 * _LANES + w], rows[10 * _LANES + w], rows[11 * _LANES + w]),
        (rows[12 * _LANES + w], rows[13 * _LANES + w], rows[14 * _LANES + w]),
        (rows[15 * _LANES + w], rows[16 * _LANES + w], rows[17 * _LANES + w]),
        (rows[18 * _LANES + w], rows[19 * _LANES + w], rows[20 * _LANES + w]),
        (rows[21 * _LANES + w], rows[22 * _LANES + w], rows[23 * _LANES + w]),
    )


@njit(**INLINED)
def _five(rows, row, w):
    """Five rows from ``row`` on, of the five tetrahedra of a cell."""
    v = row * _LANES + w
    return (
        rows[v],
        rows[v + _LANES],
        rows[v + 2 * _LANES],
        rows[v + 3 * _LANES],
        rows[v + 4 * _LANES],
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
def _gradients(field, rows, w):
    """The gradients in the five tetrahedra of a cell."""
    a, b, c, d, e, f, g, h = _corners(field, w)
    per = (rows[w], rows[_LANES + w], rows[2 * _LANES + w])
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
    v, d = row * _LANES + w, step * _LANES
    lanes[v] = values[0]
    lanes[v + d] = values[1]
    lanes[v + 2 * d] = values[2]
    lanes[v + 3 * d] = values[3]
    lanes[v + 4 * d] = values[4]
    lanes[v + 5 * d] = values[5]
    lanes[v + 6 * d] = values[6]
    lanes[v + 7 * d] = values[7]


@njit(**INLINED)
def _put_forces(p, q, r, s, t, rows, w, lanes):
    """Rows 3 corner + axis from _OUT on: the forces of five stresses times volumes."""
    g = (rows[w], rows[_LANES + w], rows[2 * _LANES + w])
    x = _corner_forces(
        p[0], p[1], p[2], q[0], q[1], q[2], r[0], r[1], r[2], s[0], s[1], s[2], t[0], t[1], t[2], g
    )
    _put_eight(x, lanes, _OUT + 0, 3, w)
    y = _corner_forces(
        p[3], p[4], p[5], q[3], q[4], q[5], r[3], r[4], r[5], s[3], s[4], s[5], t[3], t[4], t[5], g
    )
    _put_eight(y, lanes, _OUT + 1, 3, w)
    z = _corner_forces(
        p[6], p[7], p[8], q[6], q[7], q[8], r[6], r[7], r[8], s[6], s[7], s[8], t[6], t[7], t[8], g
    )
    _put_eight(z, lanes, _OUT + 2, 3, w)


@njit(**INLINED)
def _put_volumes(p, q, r, s, t, w, lanes):
    """Rows corner from _OUT on: the sums of what the five tetrahedra give to each corner."""
    at_one, at_two, at_four = (p + t) + (r + s), (p + t) + (q + s), (p + t) + (q + r)
    _put_eight((p, at_one, at_two, s, at_four, r, q, t + (q + r + s)), lanes, _OUT, 1, w)


@njit(**INLINED)
def _tetrahedron_stress(h, shear, element, share):
    return stress(h, shear, element * volume_change(h) + share)


@njit(**INLINED)
def _tetrahedron_slope(h, d, shear, element, k, share):
    c = cofactor_change(h)
    rise = element * (inner(c, d) + (d[0] + d[4] + d[8])) + share
    return stress_slope(h, c, d, shear, k, rise)


@njit(**INLINED)
def _tetrahedron_k(h, shear, element, share, loosest):
    return limited(h, shear, element * volume_change(h) + share - shear, loosest)


@njit(**INLINED)
def _volume_slope(h, d):
    return inner(cofactor_change(h), d) + (d[0] + d[4] + d[8])


@njit(**LOOP)
def _energy(displacement, grid, constants, lanes):
    total = 0.0
    for chunk in range(len(constants)):
        rows = constants[chunk]
        first = chunk * _LANES
        _copy_field(displacement, grid, first, rows, lanes)
        for w in range(_LANES):
            p, q, r, s, t = _gradients(lanes, rows, w)
            shear = _five(rows, _SHEAR, w)
            element = _five(rows, _ELEMENT, w)
            lanes[_OUT * _LANES + w] = (
                (energy_density(p, shear[0], element[0]) + energy_density(q, shear[1], element[1]))
                + (
                    energy_density(r, shear[2], element[2])
                    + energy_density(s, shear[3], element[3])
                )
                + energy_density(t, shear[4], element[4])
            )
        for w in range(min(_LANES, grid[3] - first)):
            total += lanes[_OUT * _LANES + w]
    return total


@njit(**INLINED)
def _count(ratio, least, count):
    """The least ratio so far, NaN if one is, and how many were not above zero."""
    least = ratio if ratio < least or np.isnan(ratio) else least
    return least, count if ratio > 0 else count + ONE


@njit(**LOOP)
def _volume_ratios(displacement, grid, constants, lanes):
    smallest = np.inf
    inverted = 0
    for chunk in range(len(constants)):
        rows = constants[chunk]
        first = chunk * _LANES
        _copy_field(displacement, grid, first, rows, lanes)
        for w in range(_LANES):
            p, q, r, s, t = _gradients(lanes, rows, w)
            least, count = _count(ONE + volume_change(p), np.float32(np.inf), ONE - ONE)
            least, count = _count(ONE + volume_change(q), least, count)
            least, count = _count(ONE + volume_change(r), least, count)
            least, count = _count(ONE + volume_change(s), least, count)
            lanes[_OUT * _LANES + w], lanes[(_OUT + 1) * _LANES + w] = _count(
                ONE + volume_change(t), least, count
            )
        for w in range(min(_LANES, grid[3] - first)):
            least = lanes[_OUT * _LANES + w]
            if rows[w] != 0 and (least < smallest or np.isnan(least)):
                smallest = least
            inverted += int(lanes[(_OUT + 1) * _LANES + w])
    return smallest, inverted


@njit(**LOOP)
def _volume_changes(displacement, grid, constants, lanes, nodal):
    nodal[:] = 0
    for chunk in range(len(constants)):
        rows = constants[chunk]
        first = chunk * _LANES
        _copy_field(displacement, grid, first, rows, lanes)
        for w in range(_LANES):
            p, q, r, s, t = _gradients(lanes, rows, w)
            weight = _five(rows, _NODAL, w)
            _put_volumes(
                weight[0] * volume_change(p),
                weight[1] * volume_change(q),
                weight[2] * volume_change(r),
                weight[3] * volume_change(s),
                weight[4] * volume_change(t),
                w,
                lanes,
            )
        _add_out(lanes, _OUT, 1, grid, first, rows, nodal)


@njit(**LOOP)
def _forces(displacement, nodal, grid, constants, lanes, forces):
    forces[:, :] = 0
    for chunk in range(len(constants)):
        rows = constants[chunk]
        first = chunk * _LANES
        if len(nodal):
            _share_nodal(nodal, grid, first, rows, lanes)
        _copy_field(displacement, grid, first, rows, lanes)
        for w in range(_LANES):
            p, q, r, s, t = _gradients(lanes, rows, w)
            shear = _five(rows, _SHEAR, w)
            element = _five(rows, _ELEMENT, w)
            share = _five(lanes, _SHARE, w)
            _put_forces(
                _tetrahedron_stress(p, shear[0], element[0], share[0]),
                _tetrahedron_stress(q, shear[1], element[1], share[1]),
                _tetrahedron_stress(r, shear[2], element[2], share[2]),
                _tetrahedron_stress(s, shear[3], element[3], share[3]),
                _tetrahedron_stress(t, shear[4], element[4], share[4]),
                rows,
                w,
                lanes,
            )
        _add_field(lanes, grid, first, rows, forces)


@njit(**LOOP)
def _linearise(displacement, nodal, grid, constants, lanes, tangent, loosest):
    for chunk in range(len(constants)):
        rows = constants[chunk]
        first = chunk * _LANES
        kept = tangent[chunk]
        if len(nodal):
            _share_nodal(nodal, grid, first, rows, lanes)
        _copy_field(displacement, grid, first, rows, kept)
        for w in range(_LANES):
            p, q, r, s, t = _gradients(kept, rows, w)
            shear = _five(rows, _SHEAR, w)
            element = _five(rows, _ELEMENT, w)
            share = _five(lanes, _SHARE, w)
            kept[_K * _LANES + w] = _tetrahedron_k(p, shear[0], element[0], share[0], loosest)
            kept[(_K + 1) * _LANES + w] = _tetrahedron_k(q, shear[1], element[1], share[1], loosest)
            kept[(_K + 2) * _LANES + w] = _tetrahedron_k(r, shear[2], element[2], share[2], loosest)
            kept[(_K + 3) * _LANES + w] = _tetrahedron_k(s, shear[3], element[3], share[3], loosest)
            kept[(_K + 4) * _LANES + w] = _tetrahedron_k(t, shear[4], element[4], share[4], loosest)


@njit(**LOOP)
def _volume_slopes(change, grid, constants, tangent, lanes, nodal):
    nodal[:] = 0
    for chunk in range(len(constants)):
        rows = constants[chunk]
        first = chunk * _LANES
        _copy_field(change, grid, first, rows, lanes)
        kept = tangent[chunk]
        for w in range(_LANES):
            p, q, r, s, t = _gradients(kept, rows, w)
            weight = _five(rows, _NODAL, w)
            dp, dq, dr, ds, dt = _gradients(lanes, rows, w)
            _put_volumes(
                weight[0] * _volume_slope(p, dp),
                weight[1] * _volume_slope(q, dq),
                weight[2] * _volume_slope(r, dr),
                weight[3] * _volume_slope(s, ds),
                weight[4] * _volume_slope(t, dt),
                w,
                lanes,
            )
        _add_out(lanes, _OUT, 1, grid, first, rows, nodal)


@njit(**LOOP)
def _tangent_product(change, nodal, grid, constants, tangent, lanes, product):
    product[:, :] = 0
    for chunk in range(len(constants)):
        rows = constants[chunk]
        first = chunk * _LANES
        if len(nodal):
            _share_nodal(nodal, grid, first, rows, lanes)
        _copy_field(change, grid, first, rows, lanes)
        kept = tangent[chunk]
        for w in range(_LANES):
            p, q, r, s, t = _gradients(kept, rows, w)
            shear = _five(rows, _SHEAR, w)
            element = _five(rows, _ELEMENT, w)
            k = _five(kept, _K, w)
            share = _five(lanes, _SHARE, w)
            dp, dq, dr, ds, dt = _gradients(lanes, rows, w)
            _put_forces(
                _tetrahedron_slope(p, dp, shear[0], element[0], k[0], share[0]),
                _tetrahedron_slope(q, dq, shear[1], element[1], k[1], share[1]),
                _tetrahedron_slope(r, dr, shear[2], element[2], k[2], share[2]),
                _tetrahedron_slope(s, ds, shear[3], element[3], k[3], share[3]),
                _tetrahedron_slope(t, dt, shear[4], element[4], k[4], share[4]),
                rows,
                w,
                lanes,
            )
        _add_field(lanes, grid, first, rows, product)


@njit(**INLINED)
def _corner_blocks(h, i, j, k, shear, element):
    """Blocks of a corner tetrahedron: at its corner, and at the ends of its edges along x, y, z.

    i, j and k are the shape gradient of its corner.
    """
    c = cofactor_change(h)
    none = ONE - ONE
    return (
        block((i, j, k), c, shear, element),
        block((i, none, none), c, shear, element),
        block((none, j, none), c, shear, element),
        block((none, none, k), c, shear, element),
    )


@njit(**INLINED)
def _put_sum(a, b, c, d, lanes, corner, w):
    """Rows of a corner: the sum of four blocks."""
    row = (_OUT + 6 * corner) * _LANES + w
    lanes[row] = (a[0] + b[0]) + (c[0] + d[0])
    lanes[row + _LANES] = (a[1] + b[1]) + (c[1] + d[1])
    lanes[row + 2 * _LANES] = (a[2] + b[2]) + (c[2] + d[2])
    lanes[row + 3 * _LANES] = (a[3] + b[3]) + (c[3] + d[3])
    lanes[row + 4 * _LANES] = (a[4] + b[4]) + (c[4] + d[4])
    lanes[row + 5 * _LANES] = (a[5] + b[5]) + (c[5] + d[5])


@njit(**INLINED)
def _put_one(a, lanes, corner, w):
    """Rows of a corner that one tetrahedron has."""
    row = (_OUT + 6 * corner) * _LANES + w
    lanes[row] = a[0]
    lanes[row + _LANES] = a[1]
    lanes[row + 2 * _LANES] = a[2]
    lanes[row + 3 * _LANES] = a[3]
    lanes[row + 4 * _LANES] = a[4]
    lanes[row + 5 * _LANES] = a[5]


@njit(**LOOP)
def _diagonal_blocks(grid, constants, tangent, lanes, blocks):
    blocks[:, :] = 0
    for chunk in range(len(constants)):
        rows = constants[chunk]
        kept = tangent[chunk]
        for w in range(_LANES):
            p, q, r, s, t = _gradients(kept, rows, w)
            shear = _five(rows, _SHEAR, w)
            element = _five(rows, _ELEMENT, w)
            i, j, k = rows[w], rows[_LANES + w], rows[2 * _LANES + w]
            p0, px, py, pz = _corner_blocks(p, -i, -j, -k, shear[0], element[0])
            q0, qx, qy, qz = _corner_blocks(q, i, j, -k, shear[1], element[1])
            r0, rx, ry, rz = _corner_blocks(r, i, -j, k, shear[2], element[2])
            s0, sx, sy, sz = _corner_blocks(s, -i, j, k, shear[3], element[3])
            i, j, k = HALF * i, HALF * j, HALF * k
            c = cofactor_change(t)
            _put_one(p0, lanes, 0, w)
            _put_sum(block((-i, -j, k), c, shear[4], element[4]), pz, rx, sy, lanes, 1, w)
            _put_sum(block((-i, j, -k), c, shear[4], element[4]), py, qx, sz, lanes, 2, w)
            _put_one(s0, lanes, 3, w)
            _put_sum(block((i, -j, -k), c, shear[4], element[4]), px, qy, rz, lanes, 4, w)
            _put_one(r0, lanes, 5, w)
            _put_one(q0, lanes, 6, w)
            _put_sum(block((i, j, k), c, shear[4], element[4]), qz, ry, sx, lanes, 7, w)
        for entry in range(6):
            _add_out(lanes, _OUT + entry, 6, grid, chunk * _LANES, rows, blocks[entry])
