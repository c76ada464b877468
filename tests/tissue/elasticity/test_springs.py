"""Springs against theory: Algorithm 1, fitted springs, energies, slopes."""

import math

import numpy as np
import pytest
from tissue_block import SOFT, block_mesh

from us_sim.tissue.elasticity.linear_tetrahedra import assemble_stiffness
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import TissueMaterials, make_uniform_materials
from us_sim.tissue.elasticity.springs import SpringNetwork, build_springs, fit_springs
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh

MESH = block_mesh((4, 3, 3))
SPRINGS = build_springs(MESH, make_uniform_materials(MESH, SOFT))


def one_spring() -> SpringNetwork:
    """Of 1 m, 100 N/m and 7 N s/m."""
    edges, one = np.array([[0, 1]], dtype=np.int32), np.ones(1)
    return SpringNetwork(edges, 100 * one, 7 * one, one)


def test_algorithm_1_on_two_tetrahedra_that_share_a_face():
    nodes = [[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]
    mesh = TetrahedralMesh(nodes, [[0, 1, 2, 3], [4, 2, 1, 3]])
    materials = TissueMaterials(np.array([1e3, 5e3]), np.zeros(2), np.ones(2))
    springs = build_springs(mesh, materials)
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
    force = one_spring().compute_forces(positions, velocity)
    pull = 100 * 0.2 + 7 * 0.5
    np.testing.assert_allclose(force, [[0, pull, 0], [0, -pull, 0]])


def test_coincident_nodes_are_not_a_division_by_zero():
    np.testing.assert_array_equal(one_spring().compute_forces(np.zeros((2, 3)), np.ones((2, 3))), 0)


def test_fitted_springs_on_a_regular_tetrahedron():
    # Edge a = 0.1 m: V = a**3 / 72**0.5, six edges, k = 15 mu V / 6 a**2 = mu a 15 / 6 / 72**0.5.
    nodes = 0.1 / math.sqrt(8) * np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    mesh = TetrahedralMesh(
        nodes, [[0, 1, 2, 3]] if np.linalg.det(nodes[1:] - nodes[0]) > 0 else [[0, 1, 3, 2]]
    )
    materials = make_uniform_materials(mesh, Material(10e3, 0.25, 1000.0))
    springs = fit_springs(mesh, materials)
    np.testing.assert_allclose(springs.stiffness, 4e3 * 0.1 * 15 / 6 / math.sqrt(72))
    # There springs and elasticity agree on a swelling exactly, node by node.
    swollen = (1e-6 * nodes).ravel()
    factor = springs.factor_stiffness(mesh.nodes)
    elastic = assemble_stiffness(mesh, materials) @ swollen
    np.testing.assert_allclose(factor.T @ (factor @ swollen), elastic, rtol=1e-9)


@pytest.mark.parametrize("ratio", [0.0, 0.25, 0.45, 0.4999])
@pytest.mark.parametrize("shape", [(4, 3, 3), (9, 5, 7)])
def test_fitted_springs_store_the_energy_of_elasticity_whatever_the_spacing(shape, ratio):
    mesh = block_mesh(shape)
    springs = fit_springs(mesh, make_uniform_materials(mesh, Material(10e3, ratio, 1000.0)))
    quarter = make_uniform_materials(mesh, Material(10e3, 0.25, 1000.0))
    matrix, factor = assemble_stiffness(mesh, quarter), springs.factor_stiffness(mesh.nodes)
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


@pytest.mark.parametrize(
    "part",
    [SPRINGS, SPRINGS.drop_fixed(MESH.nodes[:, 2] == 0.1)],
    ids=["springs", "springs of a held mesh"],
)
def test_the_factor_gives_the_derivative_of_the_forces(part):
    factor = part.factor_stiffness(MESH.nodes)
    move = np.random.default_rng(3).normal(0, 1e-7, MESH.nodes.shape)
    still = np.zeros_like(MESH.nodes)
    change = part.compute_forces(MESH.nodes - move, still) - part.compute_forces(
        MESH.nodes + move, still
    )
    linear = (factor.T @ (factor @ move.ravel())).reshape(-1, 3)
    np.testing.assert_allclose(linear, change / 2, atol=1e-6 * abs(linear).max())
