"""The interface of sums over tetrahedra, at their nodes, that a neo-Hookean tissue needs.

`NeoHookean` adds the nodal averages. One class does the sums for the cells of a box mesh, another
for any tetrahedra.

>>> from us_sim.tissue.elasticity.neo_hookean_cells import CellSums
>>> from us_sim.tissue.elasticity.neo_hookean_tetrahedra import TetrahedraSums
>>> from us_sim.tissue.elasticity.nodal_sums import NodalSums
>>> issubclass(CellSums, NodalSums), issubclass(TetrahedraSums, NodalSums)
(True, True)
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

__all__ = ["NodalSums"]


@runtime_checkable
class NodalSums(Protocol):
    """Energies, forces and their slopes of every tetrahedron, summed at the nodes.

    Displacements and their changes are (3, N) m. ``nodal`` is (N,) and belongs to the nodal part
    of the bulk stiffness; it is empty where there is none.
    """

    def energy(self, displacement: NDArray) -> float:
        """J, of each tetrahedron by itself, without the nodal part."""
        ...

    def volume_ratios(self, displacement: NDArray) -> tuple[float, int]:
        """The smallest volume over rest volume, and how many are not above zero."""
        ...

    def volume_changes(self, displacement: NDArray, nodal: NDArray) -> None:
        """Fill nodal, J: at each node the sum over its tetrahedra of their weight times J - 1."""
        ...

    def forces(self, displacement: NDArray, nodal: NDArray, out: NDArray) -> None:
        """(3, N) N, the energy's slope, where nodal is the nodes' mean volume change."""
        ...

    def linearise(self, displacement: NDArray, nodal: NDArray, loosest: np.float32) -> None:
        """Store what the slopes at this displacement need.

        Args:
            displacement: (3, N) m.
            nodal: the nodes' mean volume change.
            loosest: as in `us_sim.tissue.elasticity.neo_hookean_point.limited`.
        """
        ...

    def volume_slopes(self, change: NDArray, nodal: NDArray) -> None:
        """Fill nodal, J: how much `volume_changes` changes with the displacement."""
        ...

    def tangent_product(self, change: NDArray, nodal: NDArray, out: NDArray) -> None:
        """(3, N) N, how much the forces change, where nodal is the change of the nodes' mean."""
        ...

    def diagonal_blocks(self, out: NDArray) -> None:
        """(6, N) N/m xx, xy, xz, yy, yz, zz of each node's block, without the nodes' averages."""
        ...
