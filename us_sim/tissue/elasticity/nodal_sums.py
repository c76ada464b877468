"""Sums of a neo-Hookean material over tetrahedra at their nodes, sixty-four tetrahedra at a time.

Row r of a buffer begins at r * `LANES` and holds one number a cell or tetrahedron. The functions
are inlined into the loops that call them, so that the row is a constant there. `make_cell_sums` is
for the cells of a box mesh, `make_tetrahedra_sums` for any mesh; `NeoHookean` adds the nodal
averages. Most groups have no lumens; these are added in loops of their own, so that a tissue
without vessels takes no longer.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from us_sim.kernels import njit
from us_sim.tissue.elasticity.neo_hookean_material import INLINED, lumen_energy, volume_change

# Numbers in a row: a few vectors of the widest kind, so that all rows stay in the L1 cache.
LANES = 64


def pack_lanes(table: NDArray) -> NDArray:
    """Pack (M, R) as (chunks, R * LANES): one row after the other of LANES lines of the table."""
    chunks = -(-len(table) // LANES)
    padded = np.zeros((chunks * LANES, table.shape[1]), dtype=table.dtype)
    padded[: len(table)] = table
    lanes = padded.reshape(chunks, LANES, -1).transpose(0, 2, 1)
    return np.ascontiguousarray(lanes).reshape(chunks, -1)


@njit(**INLINED)
def get_three(rows, row, w):
    """Return three rows from ``row`` on: a vector."""
    v = row * LANES + w
    return rows[v], rows[v + LANES], rows[v + 2 * LANES]


@njit(**INLINED)
def get_five(rows, row, w):
    """Return five rows from ``row`` on, of the five tetrahedra of a cell."""
    v = row * LANES + w
    return (rows[v], rows[v + LANES], rows[v + 2 * LANES], rows[v + 3 * LANES], rows[v + 4 * LANES])


@njit(**INLINED)
def get_nine(rows, row, w):
    """Return nine rows from ``row`` on: a matrix, row by row."""
    v = row * LANES + w
    return (
        rows[v],
        rows[v + LANES],
        rows[v + 2 * LANES],
        rows[v + 3 * LANES],
        rows[v + 4 * LANES],
        rows[v + 5 * LANES],
        rows[v + 6 * LANES],
        rows[v + 7 * LANES],
        rows[v + 8 * LANES],
    )


@njit(**INLINED)
def put_six(values, rows, row, w):
    """Fill six rows from ``row`` on with a symmetric matrix: xx, xy, xz, yy, yz, zz."""
    v = row * LANES + w
    rows[v] = values[0]
    rows[v + LANES] = values[1]
    rows[v + 2 * LANES] = values[2]
    rows[v + 3 * LANES] = values[3]
    rows[v + 4 * LANES] = values[4]
    rows[v + 5 * LANES] = values[5]


@njit(**INLINED)
def put_nine(values, rows, row, w):
    """Fill nine rows from ``row`` on with a matrix, row by row."""
    v = row * LANES + w
    rows[v] = values[0]
    rows[v + LANES] = values[1]
    rows[v + 2 * LANES] = values[2]
    rows[v + 3 * LANES] = values[3]
    rows[v + 4 * LANES] = values[4]
    rows[v + 5 * LANES] = values[5]
    rows[v + 6 * LANES] = values[6]
    rows[v + 7 * LANES] = values[7]
    rows[v + 8 * LANES] = values[8]


# First row of the constants' gradients of the shape functions of nodes 1, 2 and 3.
SHAPE = np.int64(0)  # numba compiles callers again for each literal
FIELD = np.int64(0)  # First row of a buffer's field, row 3 b + axis of it at the b-th node
SUMS = FIELD + 12  # First row of a buffer's nodal sums, one a node
OUT = SUMS + 4  # First row of a buffer's result: a field of 3 b + axis, 6 rows a node, or fewer
ROWS = OUT + 24  # Number of rows of a buffer


@njit(**INLINED)
def gather_vector(field, nodes, lanes):
    """Fill rows 3 b + axis with the field (3, N) at the b-th node of each tetrahedron."""
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
    """Fill rows from SUMS on with the values (N,) at the nodes of each tetrahedron."""
    for w in range(4 * LANES):
        lanes[SUMS * LANES + w] = values[nodes[w]]


@njit(**INLINED)
def scatter_vector(lanes, nodes, field):
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
    """Return the gradient of the field whose rows `gather_vector` has made."""
    x0, y0, z0 = get_three(field, FIELD, w)
    x1, y1, z1 = get_three(field, FIELD + 3, w)
    x2, y2, z2 = get_three(field, FIELD + 6, w)
    x3, y3, z3 = get_three(field, FIELD + 9, w)
    x1, y1, z1 = x1 - x0, y1 - y0, z1 - z0
    x2, y2, z2 = x2 - x0, y2 - y0, z2 - z0
    x3, y3, z3 = x3 - x0, y3 - y0, z3 - z0
    a0, a1, a2, b0, b1, b2, c0, c1, c2 = get_nine(constants, SHAPE, w)
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
    """Fill rows ``row`` + 3 b with the force at node b along one axis.

    (px, py, pz) is that axis' row of stress times volume.
    """
    a0, a1, a2, b0, b1, b2, c0, c1, c2 = get_nine(constants, SHAPE, w)
    a = px * a0 + py * a1 + pz * a2
    b = px * b0 + py * b1 + pz * b2
    c = px * c0 + py * c1 + pz * c2
    lanes[row * LANES + w] = -(a + b + c)
    lanes[(row + 3) * LANES + w] = a
    lanes[(row + 6) * LANES + w] = b
    lanes[(row + 9) * LANES + w] = c


@njit(**INLINED)
def put_forces(p, constants, w, lanes):
    """Fill rows OUT + 3 b + axis with the force of the stress p, times volume, at node b."""
    _put_row(p[0], p[1], p[2], constants, w, lanes, OUT)
    _put_row(p[3], p[4], p[5], constants, w, lanes, OUT + 1)
    _put_row(p[6], p[7], p[8], constants, w, lanes, OUT + 2)


class NodalSums(NamedTuple):
    """Compiled sums over all tetrahedra at their nodes, and the arrays that they take.

    Displacements and their changes are (3, N) m. ``nodal`` is (N,) and belongs to the nodal part
    of the bulk stiffness; it is empty where there is none.
    """

    # (displacement, nodes, constants, lanes): smallest J, and how many are not above zero
    volume_ratios: Callable[..., tuple[float, int]]
    # (displacement, nodes, constants, lanes, nodal): fills the nodes' weighted sums of J - 1, J
    volume_changes: Callable[..., None]
    # (displacement, nodal, nodes, constants, lumens, lanes, out): J without the nodal part, and the
    # whole energy's slope (3, N) N into out, where nodal is the nodes' mean volume change
    energy_and_forces: Callable[..., float]
    # (displacement, nodal, nodes, constants, lumens, lanes, tangent): fills the tangent
    linearise: Callable[..., None]
    # (change, nodes, constants, tangent, lanes, nodal): fills the slopes of `volume_changes`
    volume_slopes: Callable[..., None]
    # (change, nodal, nodes, constants, tangent, lanes, out): fills the change of the forces
    tangent_product: Callable[..., None]
    # (nodes, constants, tangent, lanes, out): fills (6, N) N/m, without the nodes' averages
    diagonal_blocks: Callable[..., None]
    nodes: NDArray[Any]  # how kernels find the nodes of a tetrahedron
    constants: NDArray[Any]  # of each group of tetrahedra
    lumens: tuple[NDArray[Any], NDArray[Any]]  # of those groups that have one, see `pack_groups`
    tangent: NDArray[Any]  # of each group, which `linearise` fills
    lanes: NDArray[Any]  # work space


def pack_groups(table: NDArray, dtype: DTypeLike) -> tuple[NDArray[np.int32], NDArray]:
    """Pack the lumens of the groups of `LANES` lines that have any.

    Args:
        table: (R, K, CONSTANTS), volumes times those of `lumen_table`, of K tetrahedra a line.
        dtype: of the constants.

    Returns:
        (C,) the row of each group in the second array, -1 if it has no lumen; and
        (L, CONSTANTS * K * LANES) the constants of those that have one.
    """
    groups = -(-len(table) // LANES)
    padded = np.zeros((groups * LANES, *table.shape[1:]))
    padded[: len(table)] = table
    padded[..., 5] = np.where(padded[..., 0] > 0, padded[..., 5], 1.0)  # no division by zero
    there = padded[..., 0].reshape(groups, -1).any(axis=1)
    row = np.where(there, np.cumsum(there) - 1, -1).astype(np.int32)
    lines = padded.transpose(0, 2, 1).reshape(len(padded), -1)
    return row, pack_lanes(lines).astype(dtype)[there]


@njit(**INLINED)
def lumen_energy_at(h, lumen, v, step):
    """Return `lumen_energy` times volume; the constants are at v and ``step`` apart."""
    return lumen_energy(
        volume_change(h),
        (
            lumen[v],
            lumen[v + step],
            lumen[v + 2 * step],
            lumen[v + 3 * step],
            lumen[v + 4 * step],
            lumen[v + 5 * step],
        ),
    )
