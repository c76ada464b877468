"""Sums over tetrahedra, at their nodes, that a neo-Hookean tissue needs.

`NeoHookean` adds the nodal averages. One class does the sums for the cells of a box mesh, another
for any tetrahedra; they differ in their kernels and in how these find a tetrahedron's nodes.

>>> from us_sim.tissue.elasticity.neo_hookean_cells import CellSums
>>> from us_sim.tissue.elasticity.neo_hookean_tetrahedra import TetrahedraSums
>>> from us_sim.tissue.elasticity.nodal_sums import NodalSums
>>> issubclass(CellSums, NodalSums), issubclass(TetrahedraSums, NodalSums)
(True, True)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

from numpy.typing import NDArray

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
