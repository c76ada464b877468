"""The tissue that solvers deform: mesh, materials, fixed nodes, and nodes the probe can touch.

>>> from us_sim.tissue.model import TissueModel
>>> model = TissueModel.block()
>>> len(model.mesh.nodes), len(model.contact_nodes)
(216, 36)
>>> f"{model.lumped_mass.sum():.3f} kg"
'1.000 kg'
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError
from us_sim.geometry.collider import Collider, Sphere
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import TissueMaterials, uniform_material
from us_sim.tissue.mesh.node_selection import face_nodes
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, box_mesh, uniform_planes

_SOFT = Material(young_modulus=10e3, poisson_ratio=0.45, density=1000.0)


@dataclass(frozen=True, eq=False)
class TissueModel:
    """A tissue and the probe that can press it.

    A node that is both held and reachable stays where it is; the probe passes through it.

    Raises:
        MeshError: an array has the wrong shape, or names nodes that the mesh has not.
    """

    mesh: TetrahedralMesh
    materials: TissueMaterials
    fixed: NDArray[np.bool_]  # (N,), held at rest
    collider: Collider
    contact_nodes: NDArray[np.int32]  # (C,), which the probe can touch

    @classmethod
    def block(
        cls,
        size: tuple[float, float, float] = (0.1, 0.1, 0.1),
        nodes: tuple[int, int, int] = (6, 6, 6),
        *,
        material: Material = _SOFT,
        collider: Collider | None = None,
        held: Sequence[str] = ("bottom",),
    ) -> TissueModel:
        """A box of one material with its top around the origin, for examples and tests.

        Args:
            size: m, along x, y and z.
            nodes: of its mesh, along x, y and z.
            material: soft tissue by default.
            collider: a sphere of 30 mm radius by default.
            held: names of the faces that are fixed, as `face_nodes` takes them. The probe can
                touch the top.
        """
        mesh = box_mesh(
            uniform_planes(-size[0] / 2, size[0] / 2, nodes[0]),
            uniform_planes(-size[1] / 2, size[1] / 2, nodes[1]),
            uniform_planes(0.0, size[2], nodes[2]),
        )
        fixed = np.zeros(len(mesh.nodes), dtype=bool)
        for face in held:
            fixed[face_nodes(mesh, face)] = True
        materials = uniform_material(mesh, material)
        return cls(mesh, materials, fixed, collider or Sphere(0.03), face_nodes(mesh, "top"))

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
