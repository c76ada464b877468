"""Sums of a neo-Hookean material over tetrahedra at their nodes, sixty-four tetrahedra at a time.

Row r of a buffer begins at r * `LANES` and holds one number a cell or tetrahedron. The functions
are inlined into the loops that call them, so that the row is a constant there. One class does the
sums for the cells of a box mesh, another for any tetrahedra; `NeoHookean` adds the nodal averages.
Lumens, which most groups have none of, are added in loops of their own, so that a tissue without
vessels takes no longer.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from us_sim.kernels import njit
from us_sim.tissue.elasticity.neo_hookean_material import INLINED, emptying, volume_change

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


_Kernel = Callable[..., Any]


class Kernels(NamedTuple):
    """The compiled functions behind the methods of `NodalSums`, by the methods' names."""

    volume_ratios: _Kernel
    volume_changes: _Kernel
    energy_and_forces: _Kernel
    linearise: _Kernel
    volume_slopes: _Kernel
    tangent_product: _Kernel
    diagonal_blocks: _Kernel


class NodalSums:
    """Energies, forces and their slopes of every tetrahedron, summed at the nodes.

    Displacements and their changes are (3, N) m. ``nodal`` is (N,) and belongs to the nodal part
    of the bulk stiffness; it is empty where there is none.
    """

    _kernels: ClassVar[Kernels]
    _nodes: NDArray[Any]  # how kernels find the nodes of a tetrahedron
    _constants: NDArray[Any]  # of each block of tetrahedra
    _lumens: tuple[NDArray[Any], NDArray[Any]]  # of those blocks that have one, see `in_groups`
    _tangent: NDArray[Any]  # what `linearise` stores of each block
    _lanes: NDArray[Any]  # what kernels work in

    def volume_ratios(self, displacement: NDArray) -> tuple[float, int]:
        """The smallest volume over rest volume, and how many are not above zero."""
        ratios: tuple[float, int] = self._kernels.volume_ratios(
            displacement, self._nodes, self._constants, self._lanes
        )
        return ratios

    def volume_changes(self, displacement: NDArray, nodal: NDArray) -> None:
        """Fill nodal, J: at each node the sum over its tetrahedra of their weight times J - 1."""
        self._kernels.volume_changes(displacement, self._nodes, self._constants, self._lanes, nodal)

    def energy_and_forces(self, displacement: NDArray, nodal: NDArray, out: NDArray) -> float:
        """J, of each tetrahedron by itself, without the nodal part; and (3, N) N into ``out``, the
        whole energy's slope, where nodal is the nodes' mean volume change.
        """
        energy: float = self._kernels.energy_and_forces(
            displacement, nodal, self._nodes, self._constants, self._lumens, self._lanes, out
        )
        return energy

    def linearise(self, displacement: NDArray, nodal: NDArray) -> None:
        """Store what the slopes at this displacement need; nodal is the nodes' mean change."""
        self._kernels.linearise(
            *(displacement, nodal, self._nodes, self._constants),
            *(self._lumens, self._lanes, self._tangent),
        )

    def volume_slopes(self, change: NDArray, nodal: NDArray) -> None:
        """Fill nodal, J: how much `volume_changes` changes with the displacement."""
        self._kernels.volume_slopes(
            change, self._nodes, self._constants, self._tangent, self._lanes, nodal
        )

    def tangent_product(self, change: NDArray, nodal: NDArray, out: NDArray) -> None:
        """(3, N) N, how much the forces change, where nodal is the change of the nodes' mean."""
        self._kernels.tangent_product(
            change, nodal, self._nodes, self._constants, self._tangent, self._lanes, out
        )

    def diagonal_blocks(self, out: NDArray) -> None:
        """(6, N) N/m xx, xy, xz, yy, yz, zz of each node's block, without the nodes' averages."""
        self._kernels.diagonal_blocks(self._nodes, self._constants, self._tangent, self._lanes, out)


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
def emptied(h, lumen, v, step):
    """`emptying` of a tetrahedron, times its volume; its constants are at v and so many apart."""
    return emptying(
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
