"""The block of tissue that the solvers' tests press: 0.2 x 0.1 x 0.1 m, held at the bottom."""

from dataclasses import replace

from us_sim.geometry.collider import Collider
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.tissue.model import TissueModel

SOFT = Material(young_modulus=10e3, poisson_ratio=0.45, density=1000.0)


def block_mesh(nodes: tuple[int, int, int]) -> TetrahedralMesh:
    """Of so many nodes along x, y and z."""
    return block(nodes).mesh


def block(
    nodes: tuple[int, int, int] = (9, 5, 5),
    collider: Collider | None = None,
    held: tuple[str, ...] = ("bottom",),
    materials: TissueMaterials | None = None,
) -> TissueModel:
    """The block under a sphere of 30 mm radius, unless another collider is given."""
    model = TissueModel.block((0.2, 0.1, 0.1), nodes, material=SOFT, collider=collider, held=held)
    return model if materials is None else replace(model, materials=materials)
