"""Springs and volume term against theory: Algorithm 1, fitted springs, energies, slopes."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tissue_block import SOFT, block_mesh

from us_sim.tissue.elasticity.linear_tetrahedra import stiffness
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import TissueMaterials, uniform_material
from us_sim.tissue.elasticity.springs import SpringNetwork, fitted_springs, springs_of, volume_term
from us_sim.tissue.elasticity.stability import count_inverted
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, signed_volumes

MESH = block_mesh((4, 3, 3))
SPRINGS = springs_of(MESH, uniform_material(MESH, SOFT))


def one_spring() -> SpringNetwork:
    """Of 1 m, 100 N/m and 7 N s/m."""
    edges, one = np.array([[0, 1]], dtype=np.int32), np.ones(1)
    return SpringNetwork(edges, 100 * one, 7 * one, one)


def test_algorithm_1_on_two_tetrahedra_that_share_a_face():
    nodes = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]
    mesh = TetrahedralMesh(nodes, [[0, 1, 2, 3], [4, 2, 1, 3]])
    materials = TissueMaterials(np.array([1e3, 5e3]), np.zeros(2), np.ones(2))
    springs = springs_of(mesh, materials)
    found = {tuple(edge): k for edge, k in zip(springs.edges, springs.stiffness, strict=True)}
    # 0.002 of Young's modulus an edge; the shared face's three edges have both.
    expected = dict.fromkeys([(0, 1), (0, 2), (0, 3)], 2.0)
    expected |= dict.fromkeys([(1, 2), (1, 3), (2, 3)], 12.0)
    expected |= dict.fromkeys([(1, 4), (2, 4), (3, 4)], 10.0)
    assert found == pytest.approx(expected)
    np.testing.assert_allclose(springs.damping, 0.1 * springs.stiffness)
    assert springs.rest_length.max() == pytest.approx(math.sqrt(2))


def test_voigt_element_has_the_force_of_equation_1():
    positions = np.array([[0.0, 0, 0], [0.0, 1.2, 0]])
    velocity = np.array([[0.0, 0, 0], [0.3, 0.5, 0.0]])  # 0.5 m/s along the spring
    force = one_spring().forces(positions, velocity)
    pull = 100 * 0.2 + 7 * 0.5
    np.testing.assert_allclose(force, [[0, pull, 0], [0, -pull, 0]])


def test_coincident_nodes_are_not_a_division_by_zero():
    np.testing.assert_array_equal(one_spring().forces(np.zeros((2, 3)), np.ones((2, 3))), 0)


def test_fitted_springs_on_a_regular_tetrahedron():
    # Edge a = 0.1 m: V = a**3 / 72**0.5, six edges, k = 15 mu V / 6 a**2 = mu a 15 / 6 / 72**0.5.
    nodes = 0.1 / math.sqrt(8) * np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    mesh = TetrahedralMesh(
        nodes, [[0, 1, 2, 3]] if np.linalg.det(nodes[1:] - nodes[0]) > 0 else [[0, 1, 3, 2]]
    )
    materials = uniform_material(mesh, Material(10e3, 0.25, 1000.0))
    springs = fitted_springs(mesh, materials)
    np.testing.assert_allclose(springs.stiffness, 4e3 * 0.1 * 15 / 6 / math.sqrt(72))
    np.testing.assert_allclose(springs.lame_constant, 4e3)
    # There springs and elasticity agree on a swelling exactly, node by node.
    swollen = (1e-6 * nodes).ravel()
    factor = springs.factor(mesh.nodes)
    elastic = stiffness(mesh, materials) @ swollen
    np.testing.assert_allclose(factor.T @ (factor @ swollen), elastic, rtol=1e-9)


@pytest.mark.parametrize("ratio", [0.0, 0.25, 0.45, 0.4999])
@pytest.mark.parametrize("shape", [(4, 3, 3), (9, 5, 7)])
def test_fitted_springs_store_the_energy_of_elasticity_whatever_the_spacing(shape, ratio):
    mesh = block_mesh(shape)
    springs = fitted_springs(mesh, uniform_material(mesh, Material(10e3, ratio, 1000.0)))
    shear = 10e3 / (2 * (1 + max(ratio, 0.25)))
    quarter = uniform_material(mesh, Material(2.5 * shear, 0.25, 1000.0))
    matrix, factor = stiffness(mesh, quarter), springs.factor(mesh.nodes)
    swollen = 1e-3 * mesh.nodes.ravel()
    energy = ((factor @ swollen) ** 2).sum()
    assert energy == pytest.approx(swollen @ (matrix @ swollen), rel=1e-9)
    random = np.random.default_rng(0)
    ratios = []
    for _ in range(50):  # any other strain on average over its orientations
        turn, _ = np.linalg.qr(random.normal(size=(3, 3)))
        strained = 1e-3 * (mesh.nodes @ turn @ np.diag([1.0, -0.4, 0.0]) @ turn.T).ravel()
        ratios.append(((factor @ strained) ** 2).sum() / (strained @ (matrix @ strained)))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.1)


NO_SPRINGS = SpringNetwork(np.zeros((0, 2), np.int32), np.zeros(0), np.zeros(0), np.zeros(0))
STILL = np.zeros_like(MESH.nodes)


def term(ratio, damping_time=0.0):
    materials = uniform_material(MESH, Material(10e3, ratio, 1000.0))
    return volume_term(MESH, materials, fitted_springs(MESH, materials), damping_time)


def energy(volume, positions):
    """As the term states it, from the tetrahedra's volumes."""
    change = signed_volumes(positions, volume.tetrahedra) / volume.rest_volume - 1.0
    weight = volume.nodal * volume.rest_volume / 4
    around, total = np.zeros((2, len(positions)))
    for corner in volume.tetrahedra.T:
        np.add.at(around, corner, weight * change)
        np.add.at(total, corner, weight)
    nodal = around[total > 0.0] ** 2 / total[total > 0.0]
    return 0.5 * (volume.element @ (volume.rest_volume * change**2) + nodal.sum())


@given(st.integers(0, 1000), st.sampled_from([0.3, 0.45, 0.499]))
@settings(max_examples=20, deadline=None)
def test_forces_are_the_gradient_of_the_energy_and_keep_momentum(seed, ratio):
    volume = term(ratio)
    random = np.random.default_rng(seed)
    positions = MESH.nodes + random.normal(0, 0.01, MESH.nodes.shape)
    direction = random.normal(0, 1, MESH.nodes.shape)
    step = 1e-7
    change = energy(volume, positions + step * direction) - energy(
        volume, positions - step * direction
    )
    force = volume.forces(positions, STILL)
    scale = np.linalg.norm(force) * np.linalg.norm(direction)
    assert change / (2 * step) == pytest.approx(-np.vdot(force, direction), abs=1e-5 * scale)
    np.testing.assert_allclose(force.sum(axis=0), 0, atol=1e-12 * abs(force).max())
    np.testing.assert_allclose(
        np.cross(positions, force).sum(axis=0), 0, atol=1e-12 * abs(force).max()
    )


@pytest.mark.parametrize("ratio", [0.3, 0.45, 0.49])
def test_damping_takes_energy_from_swelling_and_none_from_turning(ratio):
    volume = term(ratio, damping_time=0.1)
    swelling, turning = MESH.nodes.copy(), np.cross([0.0, 0.0, 1.0], MESH.nodes)
    damped = volume.forces(MESH.nodes, swelling)
    assert np.vdot(damped, swelling) < 0
    assert abs(volume.forces(MESH.nodes, turning)).max() < 1e-12 * abs(damped).max()
    np.testing.assert_array_equal(volume.forces(MESH.nodes, STILL), 0)


@pytest.mark.parametrize("ratio", [0.25, 0.3, 0.4])
def test_springs_and_volumes_swell_as_elasticity_does(ratio):
    materials = uniform_material(MESH, Material(10e3, ratio, 1000.0))
    springs = fitted_springs(MESH, materials)
    factors = [springs.factor(MESH.nodes), term(ratio).factor(MESH.nodes)]
    swollen = 1e-3 * MESH.nodes.ravel()
    stored = sum(((factor @ swollen) ** 2).sum() for factor in factors)
    exact = swollen @ (stiffness(MESH, materials) @ swollen)
    assert stored == pytest.approx(exact, rel=1e-9)


@pytest.mark.parametrize(
    "part",
    [SPRINGS, SPRINGS.without(MESH.nodes[:, 2] == 0.1), term(0.3), term(0.49)],
    ids=["springs", "springs of a held mesh", "volume", "volume, nearly incompressible"],
)
def test_the_factor_gives_the_derivative_of_the_forces(part):
    factor = part.factor(MESH.nodes)
    move = np.random.default_rng(3).normal(0, 1e-7, MESH.nodes.shape)
    change = part.forces(MESH.nodes - move, STILL) - part.forces(MESH.nodes + move, STILL)
    linear = (factor.T @ (factor @ move.ravel())).reshape(-1, 3)
    np.testing.assert_allclose(linear, change / 2, atol=1e-6 * abs(linear).max())


def test_a_tetrahedron_inside_out_is_pushed_back():
    volume = term(0.45)
    tangled = MESH.nodes.copy()
    tangled[13] += [0.0, 0.0, 0.08]
    assert count_inverted(tangled, MESH.tetrahedra) > 0
    assert volume.forces(tangled, STILL)[13, 2] < 0
