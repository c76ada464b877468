"""The block of tissue that the solvers' tests press: 0.2 x 0.1 x 0.1 m, held at the bottom."""

import numpy as np

from us_sim.geometry.collider import Collider, Sphere
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import TissueMaterials, uniform_material
from us_sim.tissue.mesh.node_selection import face_nodes
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, box_mesh, uniform_planes
from us_sim.tissue.model import TissueModel

SOFT = Material(young_modulus=10e3, poisson_ratio=0.45, density=1000.0)


def block_mesh(nodes: tuple[int, int, int]) -> TetrahedralMesh:
    """Of so many nodes along x, y and z."""
    return box_mesh(
        uniform_planes(-0.1, 0.1, nodes[0]),
        uniform_planes(-0.05, 0.05, nodes[1]),
        uniform_planes(0.0, 0.1, nodes[2]),
    )


def block(
    nodes: tuple[int, int, int] = (9, 5, 5),
    collider: Collider | None = None,
    held: tuple[str, ...] = ("bottom",),
    materials: TissueMaterials | None = None,
) -> TissueModel:
    """The block under a sphere of 30 mm radius, unless another collider is given."""
    mesh = block_mesh(nodes)
    fixed = np.zeros(len(mesh.nodes), dtype=bool)
    for face in held:
        fixed[face_nodes(mesh, face)] = True
    return TissueModel(
        mesh=mesh,
        materials=materials or uniform_material(mesh, SOFT),
        fixed=fixed,
        collider=collider or Sphere(0.03),
        contact_nodes=face_nodes(mesh, "top"),
    )
