"""Linear tetrahedra that do not lock when nearly incompressible: pressures averaged around nodes.

The equations are those of the neo-Hookean material with the same split of the bulk stiffness (see
`us_sim.tissue.elasticity.volumetric_split`), linearised at rest: K u + B' p = f and B u = C p, with
one pressure at each node whose surroundings are nearly incompressible. Kept as unknowns, the
pressures couple neighbours only; eliminated, they leave the stiffness K + B' C^-1 B, which couples
neighbours of neighbours.

>>> import numpy as np
>>> from us_sim.tissue.elasticity.averaged_pressure import averaged_pressure
>>> from us_sim.tissue.elasticity.material import Material
>>> from us_sim.tissue.elasticity.materials import uniform_material
>>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
>>> mesh = box_mesh([0.0, 0.1, 0.2], [0.0, 0.1], [0.0, 0.1])
>>> system = averaged_pressure(mesh, uniform_material(mesh, Material(10e3, 0.49, 1000.0)))
>>> len(system.pressure_nodes)
12
>>> bool(abs(system.stiffness @ np.tile([1.0, 0.0, 0.0], 12)).max() < 1e-9)
True
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, csr_array, dia_array

from us_sim.tissue.elasticity.linear_tetrahedra import lame_stiffness, shape_gradients
from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.elasticity.volumetric_split import volumetric_split
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh


@dataclass(frozen=True, eq=False)
class AveragedPressure:
    """The matrices of the two equations; P nodes have a pressure."""

    element: bsr_array  # (3N, 3N) N/m, K, of shear and the tetrahedra's own bulk stiffness
    coupling: csr_array  # (P, 3N) N/m2 m2, B, change of volume around each node times its stiffness
    capacity: NDArray[np.float64]  # (P,) N m, C, volume around each node times its stiffness
    pressure_nodes: NDArray[np.int32]  # (P,)

    @cached_property
    def stiffness(self) -> csr_array:
        """(3N, 3N) N/m, with the pressures eliminated."""
        scaled = dia_array((1 / self.capacity[None], [0]), shape=2 * self.capacity.shape)
        return (self.element + self.coupling.T @ (scaled @ self.coupling)).tocsr()

    def forces(self, displacement: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 3) N, what holds the nodes at a displacement (N, 3) m."""
        moved = displacement.ravel()
        swelling = self.coupling @ moved
        held = self.element @ moved + self.coupling.T @ (swelling / self.capacity)
        return held.reshape(-1, 3)


def averaged_pressure(mesh: TetrahedralMesh, materials: TissueMaterials) -> AveragedPressure:
    """Assemble the equations of a mesh."""
    split = volumetric_split(materials)
    element = lame_stiffness(mesh, split.element - split.shear, split.shear)
    weight = split.nodal * mesh.volumes / 4
    # A nodal part this small is the rounding of zero: it gets no pressure.
    weight[split.nodal <= 1e-9 * split.element] = 0.0
    capacity: NDArray[np.float64] = np.bincount(
        mesh.tetrahedra.ravel(), np.repeat(weight, 4), len(mesh.nodes)
    ).astype(np.float64)
    with_pressure = np.flatnonzero(capacity > 0).astype(np.int32)
    number = np.cumsum(capacity > 0) - 1
    near = np.flatnonzero(weight > 0)
    corners = mesh.tetrahedra[near]
    divergence = weight[near, None, None] * shape_gradients(mesh)[near]
    rows = np.broadcast_to(number[corners][:, :, None, None], (len(near), 4, 4, 3))
    columns = np.broadcast_to(
        (3 * corners[:, :, None] + np.arange(3))[:, None], (len(near), 4, 4, 3)
    )
    values = np.broadcast_to(divergence[:, None], (len(near), 4, 4, 3))
    coupling = csr_array(
        (values.ravel(), (rows.ravel(), columns.ravel())),
        shape=(len(with_pressure), 3 * len(mesh.nodes)),
    )
    coupling.sum_duplicates()
    return AveragedPressure(element, coupling, capacity[with_pressure], with_pressure)
