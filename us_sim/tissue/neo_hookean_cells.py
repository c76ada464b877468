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
    INLINED,
    LOOP,
    block,
    cofactor_change,
    energy_density,
    inner,
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

    def linearise(self, displacement: NDArray, nodal: NDArray) -> None:
        """Keep what the slopes at this displacement need."""
        _linearise(displacement, nodal, self._grid, self._constants, self._lanes, self._tangent)

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


@njit(**INLINED)
def _corner_gradient(lanes, rows, w, x0, x1, y0, y1, z0, z1):
    """The gradient at a corner, of the field at the ends of its three edges."""
    i, j, k = rows[w], rows[_LANES + w], rows[2 * _LANES + w]
    return (
        (lanes[3 * x1 * _LANES + w] - lanes[3 * x0 * _LANES + w]) * i,
        (lanes[3 * y1 * _LANES + w] - lanes[3 * y0 * _LANES + w]) * j,
        (lanes[3 * z1 * _LANES + w] - lanes[3 * z0 * _LANES + w]) * k,
        (lanes[(3 * x1 + 1) * _LANES + w] - lanes[(3 * x0 + 1) * _LANES + w]) * i,
        (lanes[(3 * y1 + 1) * _LANES + w] - lanes[(3 * y0 + 1) * _LANES + w]) * j,
        (lanes[(3 * z1 + 1) * _LANES + w] - lanes[(3 * z0 + 1) * _LANES + w]) * k,
        (lanes[(3 * x1 + 2) * _LANES + w] - lanes[(3 * x0 + 2) * _LANES + w]) * i,
        (lanes[(3 * y1 + 2) * _LANES + w] - lanes[(3 * y0 + 2) * _LANES + w]) * j,
        (lanes[(3 * z1 + 2) * _LANES + w] - lanes[(3 * z0 + 2) * _LANES + w]) * k,
    )


@njit(**INLINED)
def _middle_row(lanes, w, axis):
    """Twice the differences along x, y and z over the tetrahedron between corners 1, 2, 4, 7."""
    first, second = lanes[(3 + axis) * _LANES + w], lanes[(6 + axis) * _LANES + w]
    third, last = lanes[(12 + axis) * _LANES + w], lanes[(21 + axis) * _LANES + w]
    return (
        (third - first) + (last - second),
        (second - first) + (last - third),
        (first - second) + (last - third),
    )


@njit(**INLINED)
def _middle_gradient(lanes, rows, w):
    """The gradient in the tetrahedron between the corners."""
    i, j, k = rows[w] / 2, rows[_LANES + w] / 2, rows[2 * _LANES + w] / 2
    xx, xy, xz = _middle_row(lanes, w, 0)
    yx, yy, yz = _middle_row(lanes, w, 1)
    zx, zy, zz = _middle_row(lanes, w, 2)
    return (xx * i, xy * j, xz * k, yx * i, yy * j, yz * k, zx * i, zy * j, zz * k)


@njit(**INLINED)
def _gradients(lanes, rows, w):
    """The gradients in the five tetrahedra of a cell."""
    return (
        _corner_gradient(lanes, rows, w, 0, 4, 0, 2, 0, 1),
        _corner_gradient(lanes, rows, w, 2, 6, 4, 6, 6, 7),
        _corner_gradient(lanes, rows, w, 1, 5, 5, 7, 4, 5),
        _corner_gradient(lanes, rows, w, 3, 7, 1, 3, 2, 3),
        _middle_gradient(lanes, rows, w),
    )


@njit(**INLINED)
def _put_axis(p, q, r, s, t, rows, w, lanes, axis):
    """Along one axis, the forces at the eight corners of rows of five stresses times volumes."""
    i, j, k = rows[w], rows[_LANES + w], rows[2 * _LANES + w]
    px, py, pz = p[0] * i, p[1] * j, p[2] * k
    qx, qy, qz = q[0] * i, q[1] * j, q[2] * k
    rx, ry, rz = r[0] * i, r[1] * j, r[2] * k
    sx, sy, sz = s[0] * i, s[1] * j, s[2] * k
    tx, ty, tz = t[0] * (i / 2), t[1] * (j / 2), t[2] * (k / 2)
    row = (_OUT + axis) * _LANES + w
    lanes[row] = -(px + py + pz)
    lanes[row + 3 * _LANES] = (tz - tx - ty) + (pz - rx - sy)
    lanes[row + 6 * _LANES] = (ty - tx - tz) + (py - qx - sz)
    lanes[row + 9 * _LANES] = (sy + sz) - sx
    lanes[row + 12 * _LANES] = (tx - ty - tz) + (px - qy - rz)
    lanes[row + 15 * _LANES] = (rx + rz) - ry
    lanes[row + 18 * _LANES] = (qx + qy) - qz
    lanes[row + 21 * _LANES] = (tx + ty + tz) + (qz + ry + sx)


@njit(**INLINED)
def _put_forces(p, q, r, s, t, rows, w, lanes):
    """Rows 3 corner + axis from _OUT on: the forces of five stresses times volumes."""
    _put_axis(p[0:3], q[0:3], r[0:3], s[0:3], t[0:3], rows, w, lanes, 0)
    _put_axis(p[3:6], q[3:6], r[3:6], s[3:6], t[3:6], rows, w, lanes, 1)
    _put_axis(p[6:9], q[6:9], r[6:9], s[6:9], t[6:9], rows, w, lanes, 2)


@njit(**INLINED)
def _put_volumes(p, q, r, s, t, w, lanes):
    """Rows corner from _OUT on: the sums of what the five tetrahedra give to each corner."""
    row = _OUT * _LANES + w
    lanes[row] = p
    lanes[row + _LANES] = (p + t) + (r + s)
    lanes[row + 2 * _LANES] = (p + t) + (q + s)
    lanes[row + 3 * _LANES] = s
    lanes[row + 4 * _LANES] = (p + t) + (q + r)
    lanes[row + 5 * _LANES] = r
    lanes[row + 6 * _LANES] = q
    lanes[row + 7 * _LANES] = t + (q + r + s)


@njit(**INLINED)
def _share_nodal(nodal, grid, first, rows, lanes):
    """Rows from _SHARE on: each tetrahedron's nodal weight times the sum of its nodes' values."""
    if len(nodal) == 0:
        return
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
def _copy_field(field, grid, first, rows, lanes):
    """Rows 3 corner + axis of lanes: the field (3, N) at the corners of cells."""
    for axis in range(3):
        _copy_in(field[axis], grid, first, rows, lanes, axis, 3)


@njit(**INLINED)
def _add_field(lanes, grid, first, rows, field):
    """Add rows 3 corner + axis from _OUT on to the field (3, N)."""
    for axis in range(3):
        _add_out(lanes, _OUT + axis, 3, grid, first, rows, field[axis])


@njit(**INLINED)
def _tetrahedron_stress(h, rows, lanes, w, number):
    """The stress, times volume, of one of a cell's five tetrahedra."""
    pressure = rows[(_ELEMENT + number) * _LANES + w] * volume_change(h)
    pressure += lanes[(_SHARE + number) * _LANES + w]
    return stress(h, rows[(_SHEAR + number) * _LANES + w], pressure)


@njit(**INLINED)
def _tetrahedron_slope(h, d, rows, kept, lanes, w, number):
    """How much the stress times volume of one of a cell's tetrahedra changes."""
    c = cofactor_change(h)
    rise = rows[(_ELEMENT + number) * _LANES + w] * (inner(c, d) + (d[0] + d[4] + d[8]))
    rise += lanes[(_SHARE + number) * _LANES + w]
    shear, k = rows[(_SHEAR + number) * _LANES + w], kept[(_K + number) * _LANES + w]
    return stress_slope(h, c, d, shear, k, rise)


@njit(**INLINED)
def _tetrahedron_volume(h, rows, w, number):
    """The nodal weight times the volume change of one of a cell's tetrahedra."""
    return rows[(_NODAL + number) * _LANES + w] * volume_change(h)


@njit(**INLINED)
def _tetrahedron_volume_slope(h, d, rows, w, number):
    """How much `_tetrahedron_volume` changes."""
    slope = inner(cofactor_change(h), d) + (d[0] + d[4] + d[8])
    return rows[(_NODAL + number) * _LANES + w] * slope


@njit(**INLINED)
def _tetrahedron_k(h, rows, lanes, w, number):
    """V (p - mu) of one of a cell's tetrahedra."""
    pressure = rows[(_ELEMENT + number) * _LANES + w] * volume_change(h)
    pressure += lanes[(_SHARE + number) * _LANES + w]
    return pressure - rows[(_SHEAR + number) * _LANES + w]


@njit(**INLINED)
def _tetrahedron_energy(h, rows, w, number):
    shear, element = rows[(_SHEAR + number) * _LANES + w], rows[(_ELEMENT + number) * _LANES + w]
    return energy_density(h, shear, element)


@njit(**LOOP)
def _energy(displacement, grid, constants, lanes):
    total = 0.0
    for chunk in range(len(constants)):
        rows = constants[chunk]
        first = chunk * _LANES
        _copy_field(displacement, grid, first, rows, lanes)
        for w in range(_LANES):
            p, q, r, s, t = _gradients(lanes, rows, w)
            lanes[_OUT * _LANES + w] = (
                (_tetrahedron_energy(p, rows, w, 0) + _tetrahedron_energy(q, rows, w, 1))
                + (_tetrahedron_energy(r, rows, w, 2) + _tetrahedron_energy(s, rows, w, 3))
                + _tetrahedron_energy(t, rows, w, 4)
            )
        for w in range(min(_LANES, grid[3] - first)):
            total += lanes[_OUT * _LANES + w]
    return total


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
            lanes[_OUT * _LANES + w] = 1 + volume_change(p)
            lanes[(_OUT + 1) * _LANES + w] = 1 + volume_change(q)
            lanes[(_OUT + 2) * _LANES + w] = 1 + volume_change(r)
            lanes[(_OUT + 3) * _LANES + w] = 1 + volume_change(s)
            lanes[(_OUT + 4) * _LANES + w] = 1 + volume_change(t)
        for w in range(min(_LANES, grid[3] - first)):
            if rows[w] != 0:
                for number in range(5):
                    ratio = lanes[(_OUT + number) * _LANES + w]
                    if not ratio >= smallest:
                        smallest = ratio
                    if not ratio > 0:
                        inverted += 1
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
            _put_volumes(
                _tetrahedron_volume(p, rows, w, 0),
                _tetrahedron_volume(q, rows, w, 1),
                _tetrahedron_volume(r, rows, w, 2),
                _tetrahedron_volume(s, rows, w, 3),
                _tetrahedron_volume(t, rows, w, 4),
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
        _share_nodal(nodal, grid, first, rows, lanes)
        _copy_field(displacement, grid, first, rows, lanes)
        for w in range(_LANES):
            p, q, r, s, t = _gradients(lanes, rows, w)
            _put_forces(
                _tetrahedron_stress(p, rows, lanes, w, 0),
                _tetrahedron_stress(q, rows, lanes, w, 1),
                _tetrahedron_stress(r, rows, lanes, w, 2),
                _tetrahedron_stress(s, rows, lanes, w, 3),
                _tetrahedron_stress(t, rows, lanes, w, 4),
                rows,
                w,
                lanes,
            )
        _add_field(lanes, grid, first, rows, forces)


@njit(**LOOP)
def _linearise(displacement, nodal, grid, constants, lanes, tangent):
    for chunk in range(len(constants)):
        rows = constants[chunk]
        first = chunk * _LANES
        kept = tangent[chunk]
        _share_nodal(nodal, grid, first, rows, lanes)
        _copy_field(displacement, grid, first, rows, kept)
        for w in range(_LANES):
            p, q, r, s, t = _gradients(kept, rows, w)
            kept[_K * _LANES + w] = _tetrahedron_k(p, rows, lanes, w, 0)
            kept[(_K + 1) * _LANES + w] = _tetrahedron_k(q, rows, lanes, w, 1)
            kept[(_K + 2) * _LANES + w] = _tetrahedron_k(r, rows, lanes, w, 2)
            kept[(_K + 3) * _LANES + w] = _tetrahedron_k(s, rows, lanes, w, 3)
            kept[(_K + 4) * _LANES + w] = _tetrahedron_k(t, rows, lanes, w, 4)


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
            dp, dq, dr, ds, dt = _gradients(lanes, rows, w)
            _put_volumes(
                _tetrahedron_volume_slope(p, dp, rows, w, 0),
                _tetrahedron_volume_slope(q, dq, rows, w, 1),
                _tetrahedron_volume_slope(r, dr, rows, w, 2),
                _tetrahedron_volume_slope(s, ds, rows, w, 3),
                _tetrahedron_volume_slope(t, dt, rows, w, 4),
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
        _share_nodal(nodal, grid, first, rows, lanes)
        _copy_field(change, grid, first, rows, lanes)
        kept = tangent[chunk]
        for w in range(_LANES):
            p, q, r, s, t = _gradients(kept, rows, w)
            dp, dq, dr, ds, dt = _gradients(lanes, rows, w)
            _put_forces(
                _tetrahedron_slope(p, dp, rows, kept, lanes, w, 0),
                _tetrahedron_slope(q, dq, rows, kept, lanes, w, 1),
                _tetrahedron_slope(r, dr, rows, kept, lanes, w, 2),
                _tetrahedron_slope(s, ds, rows, kept, lanes, w, 3),
                _tetrahedron_slope(t, dt, rows, kept, lanes, w, 4),
                rows,
                w,
                lanes,
            )
        _add_field(lanes, grid, first, rows, product)


@njit(**INLINED)
def _corner_blocks(h, rows, w, number, x, y, z):
    """Blocks of a corner tetrahedron: at its corner, and at the ends of its edges along x, y, z.

    x, y and z are -1 where the edge leaves the corner upwards.
    """
    i, j, k = rows[w], rows[_LANES + w], rows[2 * _LANES + w]
    c = cofactor_change(h)
    shear, element = rows[(_SHEAR + number) * _LANES + w], rows[(_ELEMENT + number) * _LANES + w]
    zero = i * 0
    return (
        block((x * i, y * j, z * k), c, shear, element),
        block((i, zero, zero), c, shear, element),
        block((zero, j, zero), c, shear, element),
        block((zero, zero, k), c, shear, element),
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
            p0, px, py, pz = _corner_blocks(p, rows, w, 0, -1, -1, -1)
            q0, qx, qy, qz = _corner_blocks(q, rows, w, 1, 1, 1, -1)
            r0, rx, ry, rz = _corner_blocks(r, rows, w, 2, 1, -1, 1)
            s0, sx, sy, sz = _corner_blocks(s, rows, w, 3, -1, 1, 1)
            i, j, k = rows[w] / 2, rows[_LANES + w] / 2, rows[2 * _LANES + w] / 2
            c = cofactor_change(t)
            shear, element = rows[(_SHEAR + 4) * _LANES + w], rows[(_ELEMENT + 4) * _LANES + w]
            _put_one(p0, lanes, 0, w)
            _put_sum(block((-i, -j, k), c, shear, element), pz, rx, sy, lanes, 1, w)
            _put_sum(block((-i, j, -k), c, shear, element), py, qx, sz, lanes, 2, w)
            _put_one(s0, lanes, 3, w)
            _put_sum(block((i, -j, -k), c, shear, element), px, qy, rz, lanes, 4, w)
            _put_one(r0, lanes, 5, w)
            _put_one(q0, lanes, 6, w)
            _put_sum(block((i, j, k), c, shear, element), qz, ry, sx, lanes, 7, w)
        for entry in range(6):
            _add_out(lanes, _OUT + entry, 6, grid, chunk * _LANES, rows, blocks[entry])
