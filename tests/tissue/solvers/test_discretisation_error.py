"""The estimated discretisation error against errors that are known."""

import numpy as np
import pytest

from us_sim.evaluation.tissue.reference import solve_contact
from us_sim.geometry.collider import Capsule, RoundedBox, Sphere
from us_sim.geometry.pose import Pose
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, box_mesh
from us_sim.tissue.model import TissueModel
from us_sim.tissue.solvers.discretisation_error import estimate_interpolation_error
from us_sim.tissue.solvers.fem_cg import FemCg
from us_sim.tissue.solvers.fem_nonlinear import FemNonlinear

SIDE = np.linspace(0.0, 1.0, 13)


def unstructured():
    """A box mesh whose inner nodes are moved at random."""
    mesh = box_mesh(SIDE, SIDE, SIDE)
    inside = ((mesh.nodes > 0) & (mesh.nodes < 1)).all(axis=1)
    moved = np.random.default_rng(1).uniform(-0.15, 0.15, mesh.nodes.shape) / 12
    return TetrahedralMesh(mesh.nodes + inside[:, None] * moved, mesh.tetrahedra)


def norms(mesh, field):
    """L2 norms of a field (N, 3) of places, and of what its linear interpolation leaves out of it,
    by 64 Gauss points in each tetrahedron (M. G. Duffy, SIAM J. Numer. Anal. 19, 1982).
    """
    at, weight = np.polynomial.legendre.leggauss(4)
    at, weight = (at + 1) / 2, weight / 2
    r, s, t = (axis.ravel() for axis in np.meshgrid(at, at, at, indexing="ij"))
    share = 6 * np.einsum("i,j,k->ijk", weight, weight, weight).ravel() * (1 - r) ** 2 * (1 - s)
    inner = np.column_stack([r, s * (1 - r), t * (1 - r) * (1 - s)])
    linear = np.column_stack([1 - inner.sum(axis=1), inner])
    places = np.einsum("qk,ekd->eqd", linear, mesh.nodes[mesh.tetrahedra])
    whole = field(places.reshape(-1, 3)).reshape(places.shape)
    missed = whole - np.einsum("qk,ekd->eqd", linear, field(mesh.nodes)[mesh.tetrahedra])
    squares = [np.einsum("e,q,eqd->", mesh.volumes, share, v**2) for v in (whole, missed)]
    return np.sqrt(squares)


@pytest.mark.parametrize("mesh", [box_mesh(SIDE, SIDE, SIDE), unstructured()])
def test_what_linear_tetrahedra_leave_out_of_a_known_field_is_found(mesh):
    def field(places):
        x, y, z = 3.0 * places.T
        return np.column_stack([np.sin(x) * y, np.cos(x + z), np.sin(y) * np.sin(z)])

    whole, missed = norms(mesh, field)
    assert estimate_interpolation_error(mesh, field(mesh.nodes)) == pytest.approx(
        (missed, whole), rel=0.15
    )


def settled(model, *poses):
    """Displacement (N, 3) m and its estimated error under the last pose, at rest there."""
    solver = FemNonlinear(model)
    for pose in poses:
        solver.deform(pose)
    for _ in range(40):
        last = solver.deform(poses[-1])
    return last.nodes - model.mesh.nodes, solver.estimate_discretisation_error()


def test_under_a_plate_the_error_is_how_far_it_sinks_in():
    plate, soft = RoundedBox(0.2, 0.2, 0.06, 0.005), Material(10e3, 0.0, 1000.0)
    model = TissueModel.make_block((0.06,) * 3, (4, 4, 4), material=soft, collider=plate)
    displacement, estimate = settled(model, Pose([0.0, 0.0, 0.0003]))
    exact = np.zeros_like(displacement)  # all of the column is compressed alike, as nu is zero
    exact[:, 2] = 0.0003 * (1 - model.mesh.nodes[:, 2] / 0.06)
    error = np.linalg.norm(displacement - exact) / np.linalg.norm(exact)
    assert 0.001 < error < 0.1
    assert estimate == pytest.approx(error, rel=0.2)


def tilted(x, z, degrees):
    half = np.radians(degrees) / 2
    return Pose([x, 0.0, z], [0.0, np.sin(half), 0.0, np.cos(half)])


CASES = {  # none of which the estimate was made with: probe, poses, Poisson's ratio, nodes
    "sphere": (Sphere(0.03), [Pose([0, 0, 0.005]), Pose([0, 0, 0.01])], 0.45, (9, 9, 7)),
    "capsule": (Capsule(0.025, 0.03), [tilted(0, 0.004, 8), tilted(0, 0.008, 8)], 0.3, (10, 9, 8)),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_the_estimate_is_within_a_factor_of_two_of_the_error_to_a_fine_mesh(case):
    probe, poses, ratio, nodes = CASES[case]
    material = Material(10e3, ratio, 1000.0)
    size = (0.12, 0.1, 0.06)
    model = TissueModel.make_block(size, nodes, material=material, collider=probe)
    fine = np.linspace(-0.06, 0.06, 11), np.linspace(0, 0.05, 5), np.linspace(0, 0.06, 6)
    exact = solve_contact(fine, material, probe, poses).interpolate_displacement(model.mesh.nodes)
    displacement, estimate = settled(model, *poses)
    error = np.linalg.norm(displacement - exact) / np.linalg.norm(exact)
    assert error / 2 < estimate < 2 * error


def test_what_cannot_be_estimated_is_not():
    model = TissueModel.make_block(nodes=(5, 5, 5))
    pressed = Pose([0.0, 0.0, 0.008])
    untouched, linear = FemNonlinear(model), FemCg(model)
    linear.deform(pressed)
    untouched.deform(Pose([0.0, 0.0, -0.05]))
    for solver in (untouched, linear):
        assert solver.estimate_discretisation_error() is None
    untouched.deform(pressed)
    assert untouched.estimate_discretisation_error() > 0.01
    untouched.reset()
    assert untouched.estimate_discretisation_error() is None
