"""The block of tissue that the solvers' tests press, 0.2 x 0.1 x 0.1 m, and how they press it."""

from dataclasses import replace

import numpy as np

from us_sim.evaluation.independent_forces import compute_neo_hookean_forces
from us_sim.geometry.collider import Collider
from us_sim.geometry.pose import Pose
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.tissue.model import Deformation, TissueModel
from us_sim.tissue.solvers.solver import TissueSolver

SOFT = Material(young_modulus=10e3, poisson_ratio=0.45, density=1000.0)


def block_mesh(nodes: tuple[int, int, int]) -> TetrahedralMesh:
    """Of so many nodes along x, y and z."""
    return block(nodes).mesh


def irregular(mesh: TetrahedralMesh, size: float = 0.005) -> TetrahedralMesh:
    """The same mesh with its inner nodes displaced by up to ``size`` m along each axis."""
    inner = np.ones(len(mesh.nodes), dtype=bool)
    inner[mesh.boundary] = False
    nodes = mesh.nodes.copy()
    nodes[inner] += np.random.default_rng(0).uniform(-size, size, (inner.sum(), 3))
    return TetrahedralMesh(nodes, mesh.tetrahedra)


def block(
    nodes: tuple[int, int, int] = (9, 5, 5),
    collider: Collider | None = None,
    held: tuple[str, ...] = ("bottom",),
    materials: TissueMaterials | None = None,
) -> TissueModel:
    """The block under a sphere of 30 mm radius, unless another collider is given."""
    model = TissueModel.make_block(
        (0.2, 0.1, 0.1), nodes, material=SOFT, collider=collider, held=held
    )
    return model if materials is None else replace(model, materials=materials)


def at(x=0.0, y=0.0, z=0.0, orientation=(0.0, 0.0, 0.0, 1.0)) -> Pose:
    """Of the probe, z m deep."""
    return Pose(np.array([x, y, z]), np.array(orientation))


def settle(solver: TissueSolver, pose: Pose | None, frames: int = 300) -> Deformation:
    """The deformation that does not change any more."""
    for _ in range(frames):
        deformation = solver.deform(pose)
        if solver.is_settled:
            return deformation
    raise AssertionError(f"not settled after {frames} frames: residual {deformation.residual}")


def pressed(solver: TissueSolver, pose: Pose | None, frames: int = 10) -> Deformation:
    """The deformation after so many frames at one pose, or when it has settled."""
    for _ in range(frames):
        deformation = solver.deform(pose)
        if solver.is_settled:
            break
    return deformation


def require_reaction(model: TissueModel, pose: Pose, deformation: Deformation) -> None:
    """Assert that the wrench on the probe is what the fixed nodes must be held with."""
    displacement = deformation.nodes - model.mesh.nodes
    held = compute_neo_hookean_forces(model.mesh, model.materials, displacement)[model.fixed]
    torque = np.cross(deformation.nodes[model.fixed] - pose.position, held).sum(axis=0)
    np.testing.assert_allclose(pose.rotation @ deformation.force, held.sum(axis=0), atol=1e-6)
    np.testing.assert_allclose(pose.rotation @ deformation.torque, torque, atol=1e-7)
