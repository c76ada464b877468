"""Sums of a neo-Hookean material over the tetrahedra of any mesh, sixty-four at a time.

Nodes are gathered into rows of `LANES` numbers, one number a tetrahedron; loops without branches
run over the lanes, which LLVM vectorises. The same input gives the same bytes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike

from us_sim.kernels import njit
from us_sim.tissue.elasticity.linear_tetrahedra import shape_gradients
from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.elasticity.neo_hookean_material import (
    INLINED,
    LOOP,
    ONE,
    barrier_term,
    block,
    bulk_slope,
    cofactor_change,
    energy_density,
    neo_hookean_constants,
    stress,
    stress_rise,
    volume_change,
    volume_slope,
)
from us_sim.tissue.elasticity.nodal_sums import (
    LANES,
    NodalSums,
    in_groups,
    in_lanes,
    lumen_energy_at,
    nine,
    put_nine,
    put_six,
    three,
)
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh

# First row of the constants' gradients of the shape functions of nodes 1, 2 and 3.
SHAPE = np.int64(0)  # numba compiles callers again for each literal
FIELD = np.int64(0)  # First row of a buffer's field, row 3 b + axis of it at the b-th node
SUMS = FIELD + 12  # First row of a buffer's nodal sums, one a node
OUT = SUMS + 4  # First row of a buffer's result: a field of 3 b + axis, 6 rows a node, or fewer
ROWS = OUT + 24  # Number of rows of a buffer


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


_ROW = np.int64(LANES)  # no literal, for which numba would compile `lumen_energy_at` again
# Rows of the constants behind the shape gradients: V mu, V element, V nodal / 4; and their
# number.
_SHEAR, _ELEMENT, _NODAL, _WALL, _CONSTANTS = (
    SHAPE + 9,
    SHAPE + 10,
    SHAPE + 11,
    SHAPE + 12,
    SHAPE + 13,
)

# Rows that the tangent needs: the displacement's gradient, V (p - mu), V times the slope of p by
# J; and their number.
_GRADIENT, _K, _BULK, _TANGENT = np.int64(0), 9, 10, 11
_ENERGY = OUT + 12  # Row of energies, behind those of forces


@njit(**INLINED)
def _nodal_pressure(lanes, constants, w):
    """The nodal weight times the sum of the nodes' values that `gather_scalar` has made."""
    v = SUMS * LANES + w
    first, second = lanes[v] + lanes[v + LANES], lanes[v + 2 * LANES] + lanes[v + 3 * LANES]
    return constants[_NODAL * LANES + w] * (first + second)


@njit(**INLINED)
def _pressure(h, lanes, rows, w):
    """V times the slope by J of all energy but the shear's and lumens'."""
    change = volume_change(h)
    own = rows[_ELEMENT * LANES + w] * change + rows[_WALL * LANES + w] * barrier_term(change)[1]
    return own + _nodal_pressure(lanes, rows, w)


@njit(**LOOP)
def _volume_ratios(displacement, nodes, constants, lanes):
    smallest = np.inf
    inverted = 0
    for chunk in range(len(nodes)):
        gather(displacement, nodes[chunk], lanes)
        rows = constants[chunk]
        for w in range(LANES):
            lanes[OUT * LANES + w] = ONE + volume_change(gradient(lanes, rows, w))
        for w in range(LANES):
            ratio = lanes[OUT * LANES + w]
            if rows[_SHEAR * LANES + w] > 0:
                if ratio < smallest or np.isnan(ratio):
                    smallest = ratio
                if not ratio > 0:
                    inverted += 1
    return smallest, inverted


@njit(**LOOP)
def _volume_changes(displacement, nodes, constants, lanes, nodal):
    nodal[:] = 0
    for chunk in range(len(nodes)):
        gather(displacement, nodes[chunk], lanes)
        rows = constants[chunk]
        for w in range(LANES):
            h = gradient(lanes, rows, w)
            lanes[OUT * LANES + w] = rows[_NODAL * LANES + w] * volume_change(h)
        scatter_scalar(lanes, nodes[chunk], nodal)


@njit(**LOOP)
def _energy_and_forces(displacement, nodal, nodes, constants, lumens, lanes, forces):
    forces[:, :] = 0
    total = 0.0
    for chunk in range(len(nodes)):
        gather(displacement, nodes[chunk], lanes)
        if len(nodal):
            gather_scalar(nodal, nodes[chunk], lanes)
        rows = constants[chunk]
        for w in range(LANES):
            h = gradient(lanes, rows, w)
            lanes[_ENERGY * LANES + w] = energy_density(
                h, rows[_SHEAR * LANES + w], rows[_ELEMENT * LANES + w], rows[_WALL * LANES + w]
            )
            put_forces(
                stress(h, rows[_SHEAR * LANES + w], _pressure(h, lanes, rows, w)), rows, w, lanes
            )
        if lumens[0][chunk] >= 0:
            lumen = lumens[1][lumens[0][chunk]]
            for w in range(LANES):
                h = gradient(lanes, rows, w)
                energy, slope, _ = lumen_energy_at(h, lumen, w, _ROW)
                lanes[_ENERGY * LANES + w] += energy
                pressure = _pressure(h, lanes, rows, w) + slope
                put_forces(stress(h, rows[_SHEAR * LANES + w], pressure), rows, w, lanes)
        for w in range(LANES):
            total += lanes[_ENERGY * LANES + w]
        scatter(lanes, nodes[chunk], forces)
    return total


@njit(**LOOP)
def _linearise(displacement, nodal, nodes, constants, lumens, lanes, tangent):
    for chunk in range(len(nodes)):
        gather(displacement, nodes[chunk], lanes)
        if len(nodal):
            gather_scalar(nodal, nodes[chunk], lanes)
        rows = constants[chunk]
        kept = tangent[chunk]
        for w in range(LANES):
            h = gradient(lanes, rows, w)
            put_nine(h, kept, _GRADIENT, w)
            kept[_K * LANES + w] = _pressure(h, lanes, rows, w) - rows[_SHEAR * LANES + w]
            kept[_BULK * LANES + w] = bulk_slope(
                volume_change(h), rows[_ELEMENT * LANES + w], rows[_WALL * LANES + w]
            )
        if lumens[0][chunk] >= 0:
            lumen = lumens[1][lumens[0][chunk]]
            for w in range(LANES):
                _, pressure, slope = lumen_energy_at(gradient(lanes, rows, w), lumen, w, _ROW)
                kept[_K * LANES + w] += pressure
                kept[_BULK * LANES + w] += slope


@njit(**LOOP)
def _volume_slopes(change, nodes, constants, tangent, lanes, nodal):
    nodal[:] = 0
    for chunk in range(len(nodes)):
        gather(change, nodes[chunk], lanes)
        rows = constants[chunk]
        kept = tangent[chunk]
        for w in range(LANES):
            d = gradient(lanes, rows, w)
            h = nine(kept, _GRADIENT, w)
            lanes[OUT * LANES + w] = rows[_NODAL * LANES + w] * volume_slope(h, d)
        scatter_scalar(lanes, nodes[chunk], nodal)


@njit(**LOOP)
def _tangent_product(change, nodal, nodes, constants, tangent, lanes, product):
    product[:, :] = 0
    for chunk in range(len(nodes)):
        gather(change, nodes[chunk], lanes)
        if len(nodal):
            gather_scalar(nodal, nodes[chunk], lanes)
        rows = constants[chunk]
        kept = tangent[chunk]
        for w in range(LANES):
            d = gradient(lanes, rows, w)
            h = nine(kept, _GRADIENT, w)
            shear, nodal_rise = rows[_SHEAR * LANES + w], _nodal_pressure(lanes, rows, w)
            bulk, k = kept[_BULK * LANES + w], kept[_K * LANES + w]
            put_forces(stress_rise(h, d, shear, bulk, k, nodal_rise), rows, w, lanes)
        scatter(lanes, nodes[chunk], product)


@njit(**LOOP)
def _diagonal_blocks(nodes, constants, tangent, lanes, blocks):
    blocks[:, :] = 0
    for chunk in range(len(nodes)):
        rows = constants[chunk]
        kept = tangent[chunk]
        for w in range(LANES):
            h = nine(kept, _GRADIENT, w)
            c = cofactor_change(h)
            shear = rows[_SHEAR * LANES + w]
            bulk = kept[_BULK * LANES + w]
            x, y, z = three(rows, SHAPE, w), three(rows, SHAPE + 3, w), three(rows, SHAPE + 6, w)
            o = (-(x[0] + y[0] + z[0]), -(x[1] + y[1] + z[1]), -(x[2] + y[2] + z[2]))
            put_six(block(o, c, shear, bulk), lanes, OUT, w)
            put_six(block(x, c, shear, bulk), lanes, OUT + 6, w)
            put_six(block(y, c, shear, bulk), lanes, OUT + 12, w)
            put_six(block(z, c, shear, bulk), lanes, OUT + 18, w)
        for corner in range(4):
            at = nodes[chunk, corner * LANES : (corner + 1) * LANES]
            for entry in range(6):
                values = blocks[entry]
                added = lanes[(OUT + 6 * corner + entry) * LANES :]
                for w in range(LANES):
                    values[at[w]] += added[w]


def tetrahedra_sums(
    mesh: TetrahedralMesh, materials: TissueMaterials, dtype: DTypeLike
) -> NodalSums:
    """Energies, forces and their slopes of the tetrahedra of any mesh, summed at the nodes."""
    made = neo_hookean_constants(mesh, materials)
    rows = np.empty((len(mesh.tetrahedra), _CONSTANTS))
    rows[:, SHAPE:_SHEAR] = shape_gradients(mesh)[:, 1:].reshape(-1, 9)
    rows[:, _SHEAR] = mesh.volumes * made.shear
    rows[:, _ELEMENT] = mesh.volumes * made.element
    rows[:, _NODAL] = mesh.volumes * made.nodal / 4
    rows[:, _WALL] = mesh.volumes * made.wall
    # Lanes beyond the last tetrahedron name node 0 and have no stiffness.
    nodes = in_lanes(mesh.tetrahedra.astype(np.uint32))
    return NodalSums(
        _volume_ratios,
        _volume_changes,
        _energy_and_forces,
        _linearise,
        _volume_slopes,
        _tangent_product,
        _diagonal_blocks,
        nodes=nodes,
        constants=in_lanes(rows).astype(dtype),
        lumens=in_groups(made.lumen_energies(mesh)[:, None], dtype),
        tangent=np.zeros((len(nodes), _TANGENT * LANES), dtype=dtype),
        lanes=np.zeros(ROWS * LANES, dtype=dtype),
    )
