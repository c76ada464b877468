"""The nonlinear reference against what is known without it."""

import numpy as np
import pytest
from skfem import Basis, ElementHex2, ElementVector, MeshHex
from skfem.models.elasticity import lame_parameters, linear_elasticity

from us_sim.errors import SolverError
from us_sim.evaluation.block import make_graded_planes
from us_sim.evaluation.tissue.cases import SCENES
from us_sim.evaluation.tissue.finite_elements import NeoHookeanHexahedra
from us_sim.evaluation.tissue.reference import solve_contact
from us_sim.geometry.collider import Capsule, Sphere
from us_sim.geometry.collider_distance import measure_distances
from us_sim.geometry.pose import Pose
from us_sim.tissue.elasticity.material import Material

SOFT = Material(10e3, 0.45, 1000.0)
PLANES = ([-0.03, 0.0, 0.01], [0.0, 0.02, 0.05], [0.0, 0.015, 0.04])


def test_a_uniform_stretch_has_the_published_stress_in_every_element():
    block = NeoHookeanHexahedra(PLANES, SOFT)
    stretch = np.array([[1.3, 0.2, 0.0], [-0.1, 0.8, 0.1], [0.0, 0.3, 0.9]])
    forces = block.compute_forces(block.nodes @ (stretch - np.eye(3)).T)
    # Smith, de Goes and Kim 2018, eq. 13 with lambda raised by mu (their eq. 16), no logarithm.
    shear = 10e3 / 2.9
    bulk = 10e3 * 0.45 / (1.45 * 0.1) + shear
    ratio = np.linalg.det(stretch)
    cofactor = ratio * np.linalg.inv(stretch).T
    stress = shear * stretch + (bulk * (ratio - 1) - shear) * cofactor
    right = np.isclose(block.nodes[:, 0], 0.01)
    inside = (block.nodes > [-0.03, 0, 0]).all(1) & (block.nodes < [0.01, 0.05, 0.04]).all(1)
    np.testing.assert_allclose(forces[inside], 0.0, atol=1e-12)
    # The faces beside contribute at the edges: sum over two opposite faces' difference instead.
    moment = np.einsum("ni,nj->ij", forces, block.nodes)
    np.testing.assert_allclose(moment, stress * 0.04 * 0.05 * 0.04, rtol=1e-12, atol=1e-10)
    assert right.sum() == 25
    volume = block.compute_volume(block.nodes @ (stretch - np.eye(3)).T)
    assert volume == pytest.approx(ratio * 0.04 * 0.05 * 0.04, rel=1e-12)


def test_at_rest_the_stiffness_is_scikit_fems_own():
    block = NeoHookeanHexahedra(([0.0, 0.02], [0.0, 0.01, 0.03], [0.0, 0.02]), SOFT)
    mesh = MeshHex.init_tensor(*block.planes)
    basis = Basis(mesh, ElementVector(ElementHex2()), intorder=5)
    theirs = linear_elasticity(*lame_parameters(10e3, 0.45)).assemble(basis)

    def displacement(at):  # quadratic, so that the change of volume is linear in an element
        x, y, z = at.T
        return np.stack([x * y + z**2, 3 * y**2 - x * z, x**2 + y * z + z], axis=1)

    field = displacement(block.nodes)
    values = displacement(basis.doflocs.T)[np.arange(basis.N), np.arange(basis.N) % 3]
    ours = field.ravel() @ (block.assemble_stiffness(np.zeros_like(field)) @ field.ravel())
    assert ours == pytest.approx(values @ (theirs @ values), rel=1e-12)


def test_a_cubic_displacement_without_change_of_volume_costs_only_shear_energy():
    planes = [0.0, 0.04], [0.0, 0.02], [0.0, 0.01]
    block = NeoHookeanHexahedra(planes, Material(10e3, 0.49, 1000.0))
    x, y, _ = block.nodes.T
    scale = 0.1  # 1/m2
    displacement = scale * np.stack([x**3, -3 * x**2 * y, 0 * x], axis=1)
    # mu times the integral of the squared strain, 18 x^4 + 18 x^2 y^2.
    shear = 10e3 / (2 * 1.49)
    expected = shear * scale**2 * 0.01 * (18 / 5 * 0.04**5 * 0.02 + 2 * 0.04**3 * 0.02**3)
    assert block.compute_energy(displacement) == pytest.approx(expected, rel=0.02)


@pytest.mark.slow
def test_a_shallow_press_has_hertz_force():
    depth = 0.0004
    planes = (
        make_graded_planes(-0.05, 0.05, -0.004, 0.004, 0.002, 2.0),
        make_graded_planes(0.0, 0.05, 0.0, 0.004, 0.002, 2.0),
        make_graded_planes(0.0, 0.07, 0.0, 0.002, 0.002, 2.0),
    )
    solution = solve_contact(planes, SOFT, Sphere(0.03), [Pose([0.0, 0.0, depth])])
    expected = 4 / 3 * 10e3 / (1 - 0.45**2) * np.sqrt(0.03) * depth**1.5
    assert -solution.force[2] == pytest.approx(expected, rel=0.05)
    assert solution.penetration < 2e-5


@pytest.mark.slow
def test_a_tilted_capsule_pushes_everything_out_and_is_mirrored():
    half = np.radians(8) / 2
    pose = Pose([0.0, 0.0, 0.006], [0.0, np.sin(half), 0.0, np.cos(half)])
    planes = SCENES["tilt"].make_reference_planes(0.02)
    probe = Capsule(0.025, 0.04)
    solution = solve_contact(planes, SOFT, probe, [Pose([0.0, 0.0, 0.003]), pose])
    block = solution.block
    surface = block.surface_points + block.surface_values @ solution.displacement
    assert measure_distances(probe, pose, surface)[0].min() > -2e-5
    points = np.array([[0.03, 0.02, 0.01], [0.03, -0.02, 0.01]])
    found = solution.interpolate_displacement(points)
    np.testing.assert_allclose(found[1], found[0] * [1, -1, 1])
    with pytest.raises(SolverError, match="symmetric about y = 0"):
        solve_contact(planes, SOFT, probe, [Pose([0.0, 0.001, 0.0])])
