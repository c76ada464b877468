"""Sums of a stable neo-Hookean material over the tetrahedra of any mesh, sixty-four at a time.

What sixty-four tetrahedra need is gathered from their nodes into one buffer, row by row; a loop
without branches runs over its columns, which LLVM turns into vector instructions; what comes out is
added to the nodes in order, so the same input gives the same bytes.

>>> import numpy as np
>>> from us_sim.tissue.materials import Material, uniform_material
>>> from us_sim.tissue.mesh import box_mesh
>>> from us_sim.tissue.neo_hookean_tetrahedra import TetrahedraSums
>>> mesh = box_mesh([0.0, 0.1], [0.0, 0.1], [0.0, 0.1])
>>> sums = TetrahedraSums(mesh, uniform_material(mesh, Material(3e3, 0.2, 1000.0)), np.float64)
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
from us_sim.tissue.elasticity import shape_gradients
from us_sim.tissue.materials import TissueMaterials
from us_sim.tissue.mesh import TetrahedralMesh
from us_sim.tissue.neo_hookean_point import (
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

__all__ = ["TetrahedraSums"]

# Tetrahedra in one buffer: a few vectors of the widest kind, and all its rows stay in the L1 cache.
_LANES = 64

# Rows of the constants of sixty-four tetrahedra: three gradients, then V mu, V element, V nodal/4.
_SHEAR, _ELEMENT, _NODAL, _CONSTANTS = 9, 10, 11, 12

# Rows of what the tangent needs: gradient of the displacement, and V (p - mu).
_K, _TANGENT = 9, 10

# Rows of the buffer: the field at four nodes, the nodes' sums, and from here what comes out.
_OUT = 16


class TetrahedraSums:
    """Energies, forces and their slopes of every tetrahedron, summed at the nodes.

    ``nodal`` arguments are (N,) sums or pressures of the nodes' share of the bulk stiffness.
    """

    def __init__(self, mesh: TetrahedralMesh, materials: TissueMaterials, dtype: DTypeLike) -> None:
        count = len(mesh.tetrahedra)
        shares = bulk_shares(materials)
        rows = np.empty((count, _CONSTANTS))
        rows[:, :9] = shape_gradients(mesh)[:, 1:].reshape(-1, 9)
        rows[:, _SHEAR] = mesh.volumes * shares.shear
        rows[:, _ELEMENT] = mesh.volumes * shares.element
        rows[:, _NODAL] = mesh.volumes * shares.nodal / 4
        self._constants = _in_lanes(rows).astype(dtype)
        # Places beyond the last tetrahedron name node 0 and have no stiffness.
        self._nodes = _in_lanes(mesh.tetrahedra.astype(np.uint32))
        self._tangent = np.zeros((len(self._nodes), _TANGENT * _LANES), dtype=dtype)
        self._lanes = np.zeros((_OUT + 24) * _LANES, dtype=dtype)

    def energy(self, displacement: NDArray) -> float:
        """J, of the tetrahedra's own share."""
        return _energy(displacement, self._nodes, self._constants, self._lanes)

    def volume_ratios(self, displacement: NDArray) -> tuple[float, int]:
        """The smallest volume over rest volume, and how many are not above zero."""
        return _volume_ratios(displacement, self._nodes, self._constants, self._lanes)

    def volume_changes(self, displacement: NDArray, nodal: NDArray) -> None:
        """J, at each node the sum over its tetrahedra of their nodal weight times J - 1."""
        _volume_changes(displacement, self._nodes, self._constants, self._lanes, nodal)

    def forces(self, displacement: NDArray, nodal: NDArray, out: NDArray) -> None:
        """(3, N) N, the energy's slope, given the nodes' mean volume change."""
        _forces(displacement, nodal, self._nodes, self._constants, self._lanes, out)

    def linearise(self, displacement: NDArray, nodal: NDArray, loosest: np.floating) -> None:
        """Keep what the slopes at this displacement need, ``loosest`` being that of `limited`."""
        _linearise(
            displacement, nodal, self._nodes, self._constants, self._lanes, self._tangent, loosest
        )

    def volume_slopes(self, change: NDArray, nodal: NDArray) -> None:
        """J, how much `volume_changes` changes with the displacement."""
        _volume_slopes(change, self._nodes, self._constants, self._tangent, self._lanes, nodal)

    def tangent_product(self, change: NDArray, nodal: NDArray, out: NDArray) -> None:
        """(3, N) N, how much the forces change, given the change of the nodes' mean."""
        _tangent_product(
            change, nodal, self._nodes, self._constants, self._tangent, self._lanes, out
        )

    def diagonal_blocks(self, out: NDArray) -> None:
        """(6, N) N/m xx, xy, xz, yy, yz, zz of each node's block, without the nodes' share."""
        _diagonal_blocks(self._nodes, self._constants, self._tangent, self._lanes, out)


def _in_lanes(rows: NDArray) -> NDArray:
    """(chunks, R * _LANES) from (M, R): one row after the other of _LANES tetrahedra each."""
    chunks = -(-len(rows) // _LANES)
    padded = np.zeros((chunks * _LANES, rows.shape[1]), dtype=rows.dtype)
    padded[: len(rows)] = rows
    lanes = padded.reshape(chunks, _LANES, -1).transpose(0, 2, 1)
    return np.ascontiguousarray(lanes).reshape(chunks, -1)


@njit(**INLINED)
def _gather(field, nodes, lanes):
    """Rows 3 b + axis of lanes: the field (3, N) at the b-th node of each tetrahedron."""
    for axis in range(3):
        values = field[axis]
        for corner in range(4):
            into = lanes[(3 * corner + axis) * _LANES : (3 * corner + axis + 1) * _LANES]
            at = nodes[corner * _LANES : (corner + 1) * _LANES]
            for w in range(_LANES):
                into[w] = values[at[w]]


@njit(**INLINED)
def _gather_scalar(values, nodes, lanes):
    """Rows 12 to 15 of lanes: the values (N,) at the nodes of each tetrahedron."""
    for w in range(4 * _LANES):
        lanes[12 * _LANES + w] = values[nodes[w]]


@njit(**INLINED)
def _scatter(lanes, nodes, field):
    """Add rows 3 b + axis of lanes to the field (3, N) at the b-th node of each tetrahedron."""
    for axis in range(3):
        values = field[axis]
        for corner in range(4):
            added = lanes[(_OUT + 3 * corner + axis) * _LANES :]
            at = nodes[corner * _LANES : (corner + 1) * _LANES]
            for w in range(_LANES):
                values[at[w]] += added[w]


@njit(**INLINED)
def _scatter_scalar(lanes, nodes, values):
    """Add row 0 of lanes to the values (N,) at all four nodes of each tetrahedron."""
    for corner in range(4):
        at = nodes[corner * _LANES : (corner + 1) * _LANES]
        for w in range(_LANES):
            values[at[w]] += lanes[_OUT * _LANES + w]


@njit(**INLINED)
def _gradient(field, constants, w):
    """The gradient of the field whose rows `_gather` has made."""
    x0, y0, z0 = field[w], field[_LANES + w], field[2 * _LANES + w]
    x1, y1, z1 = field[3 * _LANES + w] - x0, field[4 * _LANES + w] - y0, field[5 * _LANES + w] - z0
    x2, y2, z2 = field[6 * _LANES + w] - x0, field[7 * _LANES + w] - y0, field[8 * _LANES + w] - z0
    x3, y3, z3 = (
        field[9 * _LANES + w] - x0,
        field[10 * _LANES + w] - y0,
        field[11 * _LANES + w] - z0,
    )
    a0, a1, a2 = constants[w], constants[_LANES + w], constants[2 * _LANES + w]
    b0, b1, b2 = constants[3 * _LANES + w], constants[4 * _LANES + w], constants[5 * _LANES + w]
    c0, c1, c2 = constants[6 * _LANES + w], constants[7 * _LANES + w], constants[8 * _LANES + w]
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
    a = px * constants[w] + py * constants[_LANES + w] + pz * constants[2 * _LANES + w]
    b = px * constants[3 * _LANES + w] + py * constants[4 * _LANES + w]
    b += pz * constants[5 * _LANES + w]
    c = px * constants[6 * _LANES + w] + py * constants[7 * _LANES + w]
    c += pz * constants[8 * _LANES + w]
    lanes[(_OUT + axis) * _LANES + w] = -(a + b + c)
    lanes[(_OUT + 3 + axis) * _LANES + w] = a
    lanes[(_OUT + 6 + axis) * _LANES + w] = b
    lanes[(_OUT + 9 + axis) * _LANES + w] = c


@njit(**INLINED)
def _put_forces(p, constants, w, lanes):
    """Rows 3 b + axis of out: the force of the stress p, times volume, at the b-th node."""
    _put_row(p[0], p[1], p[2], constants, w, lanes, 0)
    _put_row(p[3], p[4], p[5], constants, w, lanes, 1)
    _put_row(p[6], p[7], p[8], constants, w, lanes, 2)


@njit(**INLINED)
def _nodal_sum(lanes, constants, w):
    """The nodal weight times the sum of the nodes' values that `_gather_scalar` has made."""
    first = lanes[12 * _LANES + w] + lanes[13 * _LANES + w]
    second = lanes[14 * _LANES + w] + lanes[15 * _LANES + w]
    return constants[_NODAL * _LANES + w] * (first + second)


@njit(**INLINED)
def _keep(h, rows, w):
    """Put the gradient into the first nine rows."""
    rows[w] = h[0]
    rows[_LANES + w] = h[1]
    rows[2 * _LANES + w] = h[2]
    rows[3 * _LANES + w] = h[3]
    rows[4 * _LANES + w] = h[4]
    rows[5 * _LANES + w] = h[5]
    rows[6 * _LANES + w] = h[6]
    rows[7 * _LANES + w] = h[7]
    rows[8 * _LANES + w] = h[8]


@njit(**INLINED)
def _stored(rows, w):
    """The gradient in the first nine rows."""
    return (
        rows[w],
        rows[_LANES + w],
        rows[2 * _LANES + w],
        rows[3 * _LANES + w],
        rows[4 * _LANES + w],
        rows[5 * _LANES + w],
        rows[6 * _LANES + w],
        rows[7 * _LANES + w],
        rows[8 * _LANES + w],
    )


@njit(**LOOP)
def _energy(displacement, nodes, constants, lanes):
    total = 0.0
    for chunk in range(len(nodes)):
        _gather(displacement, nodes[chunk], lanes)
        rows = constants[chunk]
        for w in range(_LANES):
            h = _gradient(lanes, rows, w)
            lanes[_OUT * _LANES + w] = energy_density(
                h, rows[_SHEAR * _LANES + w], rows[_ELEMENT * _LANES + w]
            )
        for w in range(_LANES):
            total += lanes[_OUT * _LANES + w]
    return total


@njit(**LOOP)
def _volume_ratios(displacement, nodes, constants, lanes):
    smallest = np.inf
    inverted = 0
    for chunk in range(len(nodes)):
        _gather(displacement, nodes[chunk], lanes)
        rows = constants[chunk]
        for w in range(_LANES):
            lanes[_OUT * _LANES + w] = ONE + volume_change(_gradient(lanes, rows, w))
        for w in range(_LANES):
            ratio = lanes[_OUT * _LANES + w]
            if rows[_SHEAR * _LANES + w] > 0:
                if ratio < smallest or np.isnan(ratio):
                    smallest = ratio
                if not ratio > 0:
                    inverted += 1
    return smallest, inverted


@njit(**LOOP)
def _volume_changes(displacement, nodes, constants, lanes, nodal):
    nodal[:] = 0
    for chunk in range(len(nodes)):
        _gather(displacement, nodes[chunk], lanes)
        rows = constants[chunk]
        for w in range(_LANES):
            h = _gradient(lanes, rows, w)
            lanes[_OUT * _LANES + w] = rows[_NODAL * _LANES + w] * volume_change(h)
        _scatter_scalar(lanes, nodes[chunk], nodal)


@njit(**LOOP)
def _forces(displacement, nodal, nodes, constants, lanes, forces):
    forces[:, :] = 0
    for chunk in range(len(nodes)):
        _gather(displacement, nodes[chunk], lanes)
        if len(nodal):
            _gather_scalar(nodal, nodes[chunk], lanes)
        rows = constants[chunk]
        for w in range(_LANES):
            h = _gradient(lanes, rows, w)
            pressure = rows[_ELEMENT * _LANES + w] * volume_change(h) + _nodal_sum(lanes, rows, w)
            _put_forces(stress(h, rows[_SHEAR * _LANES + w], pressure), rows, w, lanes)
        _scatter(lanes, nodes[chunk], forces)


@njit(**LOOP)
def _linearise(displacement, nodal, nodes, constants, lanes, tangent, loosest):
    for chunk in range(len(nodes)):
        _gather(displacement, nodes[chunk], lanes)
        if len(nodal):
            _gather_scalar(nodal, nodes[chunk], lanes)
        rows = constants[chunk]
        kept = tangent[chunk]
        for w in range(_LANES):
            h = _gradient(lanes, rows, w)
            _keep(h, kept, w)
            pressure = rows[_ELEMENT * _LANES + w] * volume_change(h) + _nodal_sum(lanes, rows, w)
            shear = rows[_SHEAR * _LANES + w]
            kept[_K * _LANES + w] = limited(h, shear, pressure - shear, loosest)


@njit(**LOOP)
def _volume_slopes(change, nodes, constants, tangent, lanes, nodal):
    nodal[:] = 0
    for chunk in range(len(nodes)):
        _gather(change, nodes[chunk], lanes)
        rows = constants[chunk]
        kept = tangent[chunk]
        for w in range(_LANES):
            d = _gradient(lanes, rows, w)
            c = cofactor_change(_stored(kept, w))
            lanes[_OUT * _LANES + w] = rows[_NODAL * _LANES + w] * (
                inner(c, d) + (d[0] + d[4] + d[8])
            )
        _scatter_scalar(lanes, nodes[chunk], nodal)


@njit(**LOOP)
def _tangent_product(change, nodal, nodes, constants, tangent, lanes, product):
    product[:, :] = 0
    for chunk in range(len(nodes)):
        _gather(change, nodes[chunk], lanes)
        if len(nodal):
            _gather_scalar(nodal, nodes[chunk], lanes)
        rows = constants[chunk]
        kept = tangent[chunk]
        for w in range(_LANES):
            d = _gradient(lanes, rows, w)
            h = _stored(kept, w)
            c = cofactor_change(h)
            rise = rows[_ELEMENT * _LANES + w] * (inner(c, d) + (d[0] + d[4] + d[8]))
            rise += _nodal_sum(lanes, rows, w)
            slope = stress_slope(h, c, d, rows[_SHEAR * _LANES + w], kept[_K * _LANES + w], rise)
            _put_forces(slope, rows, w, lanes)
        _scatter(lanes, nodes[chunk], product)


@njit(**INLINED)
def _put_block(b, lanes, corner, w):
    """Rows 6 corner to 6 corner + 5 from _OUT on."""
    row = (_OUT + 6 * corner) * _LANES + w
    lanes[row] = b[0]
    lanes[row + _LANES] = b[1]
    lanes[row + 2 * _LANES] = b[2]
    lanes[row + 3 * _LANES] = b[3]
    lanes[row + 4 * _LANES] = b[4]
    lanes[row + 5 * _LANES] = b[5]


@njit(**LOOP)
def _diagonal_blocks(nodes, constants, tangent, lanes, blocks):
    blocks[:, :] = 0
    for chunk in range(len(nodes)):
        rows = constants[chunk]
        kept = tangent[chunk]
        for w in range(_LANES):
            c = cofactor_change(_stored(kept, w))
            shear, element = rows[_SHEAR * _LANES + w], rows[_ELEMENT * _LANES + w]
            x = (rows[w], rows[_LANES + w], rows[2 * _LANES + w])
            y = (rows[3 * _LANES + w], rows[4 * _LANES + w], rows[5 * _LANES + w])
            z = (rows[6 * _LANES + w], rows[7 * _LANES + w], rows[8 * _LANES + w])
            o = (-(x[0] + y[0] + z[0]), -(x[1] + y[1] + z[1]), -(x[2] + y[2] + z[2]))
            _put_block(block(o, c, shear, element), lanes, 0, w)
            _put_block(block(x, c, shear, element), lanes, 1, w)
            _put_block(block(y, c, shear, element), lanes, 2, w)
            _put_block(block(z, c, shear, element), lanes, 3, w)
        for corner in range(4):
            at = nodes[chunk, corner * _LANES : (corner + 1) * _LANES]
            for entry in range(6):
                values = blocks[entry]
                added = lanes[(_OUT + 6 * corner + entry) * _LANES :]
                for w in range(_LANES):
                    values[at[w]] += added[w]
