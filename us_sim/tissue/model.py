"""What every tissue solver is given: mesh, materials, what is held, and what the probe can touch.

>>> from us_sim.geometry.collider import Sphere
>>> from us_sim.tissue.mesh.node_selection import face_nodes
>>> from us_sim.tissue.elasticity.material import Material
>>> from us_sim.tissue.elasticity.materials import uniform_material
>>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
>>> across, deep = uniform_planes(-0.05, 0.05, 6), uniform_planes(0.0, 0.1, 6)
>>> mesh = box_mesh(across, across, deep)
>>> held = np.zeros(len(mesh.nodes), dtype=bool)
>>> held[face_nodes(mesh, "bottom")] = True
>>> materials = uniform_material(mesh, Material(10e3, 0.45, 1000.0))
>>> model = TissueModel(mesh, materials, held, Sphere(0.03), face_nodes(mesh, "top"))
>>> f"{model.lumped_mass.sum():.3f} kg"
'1.000 kg'
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError
from us_sim.geometry.collider import Collider
from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh

__all__ = ["TissueModel"]


@dataclass(frozen=True, eq=False)
class TissueModel:
    """A tissue ready to be pressed.

    A node that is both held and reachable stays where it is; the probe passes through it.

    Raises:
        MeshError: an array has the wrong shape, or names nodes that the mesh has not.
    """

    mesh: TetrahedralMesh
    materials: TissueMaterials
    fixed: NDArray[np.bool_]  # (N,), held at rest
    collider: Collider
    contact_nodes: NDArray[np.int32]  # (C,), which the probe can touch

    def __post_init__(self) -> None:
        count = len(self.mesh.nodes)
        if len(self.materials.young_modulus) != len(self.mesh.tetrahedra):
            raise MeshError(
                f"materials are given for {len(self.materials.young_modulus)} tetrahedra, but the "
                f"mesh has {len(self.mesh.tetrahedra)}"
            )
        fixed = np.array(self.fixed)
        if fixed.shape != (count,) or fixed.dtype != np.bool_:
            raise MeshError(
                f"fixed is {fixed.dtype} of shape {fixed.shape}: give {count} booleans, one a node"
            )
        contact = np.array(self.contact_nodes)
        if contact.ndim != 1 or not np.issubdtype(contact.dtype, np.integer):
            raise MeshError("contact_nodes must be a list of node indices")
        if len(contact) and (contact.min() < 0 or contact.max() >= count):
            raise MeshError(
                f"contact_nodes run from {contact.min()} to {contact.max()}, but the mesh has "
                f"nodes 0 to {count - 1}"
            )
        if len(np.unique(contact)) != len(contact):
            raise MeshError("contact_nodes names a node twice: list each node once")
        object.__setattr__(self, "fixed", fixed)
        object.__setattr__(self, "contact_nodes", contact.astype(np.int32))

    @cached_property
    def movable_contact_nodes(self) -> NDArray[np.int32]:
        """Those contact nodes that are not fixed."""
        return self.contact_nodes[~self.fixed[self.contact_nodes]]

    @cached_property
    def contact_spacing(self) -> float:
        """m, median length of the mesh edges between contact nodes; 0 when there are none."""
        reachable = np.zeros(len(self.mesh.nodes), dtype=bool)
        reachable[self.contact_nodes] = True
        ends = self.mesh.nodes[self.mesh.edges[reachable[self.mesh.edges].all(axis=1)]]
        if len(ends) == 0:
            return 0.0
        return float(np.median(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)))

    @cached_property
    def lumped_mass(self) -> NDArray[np.float64]:
        """(N,) kg, a quarter of each tetrahedron's mass at each of its nodes."""
        quarter = self.materials.density * self.mesh.volumes / 4
        mass = np.zeros(len(self.mesh.nodes))
        np.add.at(mass, self.mesh.tetrahedra, quarter[:, None])
        return mass
