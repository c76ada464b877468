"""Sums of a neo-Hookean material over tetrahedra at their nodes, sixty-four tetrahedra at a time.

Row r of a buffer begins at r * `LANES` and holds one number a cell or tetrahedron. The functions
are inlined into the loops that call them, so that the row is a constant there. `cell_sums` are for
the cells of a box mesh, `tetrahedra_sums` for any mesh; `NeoHookean` adds the nodal averages.
Lumens, which most groups have none of, are added in loops of their own, so that a tissue without
vessels takes no longer.
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


def in_lanes(table: NDArray) -> NDArray:
    """(chunks, R * LANES) from (M, R): one row after the other of LANES lines of the table."""
    chunks = -(-len(table) // LANES)
    padded = np.zeros((chunks * LANES, table.shape[1]), dtype=table.dtype)
    padded[: len(table)] = table
    lanes = padded.reshape(chunks, LANES, -1).transpose(0, 2, 1)
    return np.ascontiguousarray(lanes).reshape(chunks, -1)


@njit(**INLINED)
def three(rows, row, w):
    """Three rows from ``row`` on: a vector."""
    v = row * LANES + w
    return rows[v], rows[v + LANES], rows[v + 2 * LANES]


@njit(**INLINED)
def five(rows, row, w):
    """Five rows from ``row`` on, of the five tetrahedra of a cell."""
    v = row * LANES + w
    return (rows[v], rows[v + LANES], rows[v + 2 * LANES], rows[v + 3 * LANES], rows[v + 4 * LANES])


@njit(**INLINED)
def nine(rows, row, w):
    """Nine rows from ``row`` on: a matrix, row by row."""
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
    """Fill six rows from ``row`` on: a symmetric matrix, xx, xy, xz, yy, yz, zz."""
    v = row * LANES + w
    rows[v] = values[0]
    rows[v + LANES] = values[1]
    rows[v + 2 * LANES] = values[2]
    rows[v + 3 * LANES] = values[3]
    rows[v + 4 * LANES] = values[4]
    rows[v + 5 * LANES] = values[5]


@njit(**INLINED)
def put_nine(values, rows, row, w):
    """Fill nine rows from ``row`` on: a matrix, row by row."""
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
    lumens: tuple[NDArray[Any], NDArray[Any]]  # of those groups that have one, see `in_groups`
    tangent: NDArray[Any]  # of each group, which `linearise` fills
    lanes: NDArray[Any]  # work space


def in_groups(table: NDArray, dtype: DTypeLike) -> tuple[NDArray[np.int32], NDArray]:
    """(C,) which row of the other array each group of `LANES` lines has, or -1 if it has no lumen;
    and (L, CONSTANTS * K * LANES) the constants of those that have one.

    Args:
        table: (R, K, CONSTANTS), volumes times those of `lumen_table`, of K tetrahedra a line.
        dtype: of the constants.
    """
    groups = -(-len(table) // LANES)
    padded = np.zeros((groups * LANES, *table.shape[1:]))
    padded[: len(table)] = table
    padded[..., 5] = np.where(padded[..., 0] > 0, padded[..., 5], 1.0)  # no division by zero
    there = padded[..., 0].reshape(groups, -1).any(axis=1)
    row = np.where(there, np.cumsum(there) - 1, -1).astype(np.int32)
    lines = padded.transpose(0, 2, 1).reshape(len(padded), -1)
    return row, in_lanes(lines).astype(dtype)[there]


@njit(**INLINED)
def lumen_energy_at(h, lumen, v, step):
    """`lumen_energy` times volume; the tetrahedron's constants are at v and ``step`` apart."""
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
