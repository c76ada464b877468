"""Algorithm 1, the Voigt element and the limit of the time step against what theory says."""

import math

import numpy as np
import pytest
from scipy.linalg import eigh
from tissue_block import SOFT, block, block_mesh

from us_sim.errors import SolverError
from us_sim.tissue.materials import TissueMaterials, uniform_material
from us_sim.tissue.mesh import TetrahedralMesh
from us_sim.tissue.springs import SpringNetwork, springs_of, stabilised, step_limit

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


def test_nothing_is_lost_in_merging():
    total = 6 * 0.002 * SOFT.young_modulus * len(MESH.tetrahedra)
    assert SPRINGS.stiffness.sum() == pytest.approx(total)
    assert len(SPRINGS.edges) == len(np.unique(SPRINGS.edges, axis=0)) == len(MESH.edges)


def test_voigt_element_has_the_force_of_equation_1():
    positions = np.array([[0.0, 0, 0], [0.0, 1.2, 0]])
    velocity = np.array([[0.0, 0, 0], [0.3, 0.5, 0.0]])  # 0.5 m/s along the spring
    force = one_spring().forces(positions, velocity)
    pull = 100 * 0.2 + 7 * 0.5
    np.testing.assert_allclose(force, [[0, pull, 0], [0, -pull, 0]])


def test_coincident_nodes_are_not_a_division_by_zero():
    np.testing.assert_array_equal(one_spring().forces(np.zeros((2, 3)), np.ones((2, 3))), 0)


def test_at_rest_nothing_pulls_at_all():
    np.testing.assert_array_equal(SPRINGS.forces(MESH.nodes, np.zeros_like(MESH.nodes)), 0)


def test_forces_balance_in_any_state():
    random = np.random.default_rng(2)
    positions = MESH.nodes + random.normal(0, 0.02, MESH.nodes.shape)
    force = SPRINGS.forces(positions, random.normal(0, 1, MESH.nodes.shape))
    scale = abs(force).max()
    np.testing.assert_allclose(force.sum(axis=0), 0, atol=1e-12 * scale)
    np.testing.assert_allclose(np.cross(positions, force).sum(axis=0), 0, atol=1e-12 * scale)


def test_springs_between_held_nodes_are_dropped():
    fixed = MESH.nodes[:, 2] == 0.1
    kept = SPRINGS.without(fixed)
    assert not fixed[kept.edges].all(axis=1).any()
    assert len(SPRINGS.edges) - len(kept.edges) == fixed[MESH.edges].all(axis=1).sum()


@pytest.mark.parametrize("held", [True, False])
def test_highest_frequency_is_the_dense_eigenvalue(held):
    fixed = (MESH.nodes[:, 2] == 0.1) & held
    mass = np.random.default_rng(3).uniform(0.01, 0.1, len(MESH.nodes))
    # Differences of the forces themselves: an independent linearisation.
    count, step = MESH.nodes.size, 1e-7
    still = np.zeros_like(MESH.nodes)
    matrix = np.empty((count, count))
    for i in range(count):
        moved = np.zeros(count)
        moved[i] = step
        moved = moved.reshape(-1, 3)
        change = SPRINGS.forces(MESH.nodes - moved, still) - SPRINGS.forces(
            MESH.nodes + moved, still
        )
        matrix[:, i] = change.ravel() / (2 * step)
    free = np.repeat(~fixed, 3)
    squares = eigh(
        (matrix + matrix.T)[np.ix_(free, free)] / 2,
        np.diag(np.repeat(mass, 3)[free]),
        eigvals_only=True,
    )
    frequency = SPRINGS.highest_frequency(MESH.nodes, mass, fixed)
    assert frequency == pytest.approx(math.sqrt(squares[-1]), rel=1e-3)
    bound = 2 * (SPRINGS.node_stiffness(len(mass)) / mass)[~fixed].max()
    assert frequency**2 < bound


def test_a_few_free_nodes_have_a_frequency_too():
    fixed = np.ones(len(MESH.nodes), dtype=bool)
    fixed[:2] = False
    assert SPRINGS.highest_frequency(MESH.nodes, np.ones(len(MESH.nodes)), fixed) > 0


@pytest.mark.parametrize("damping_factor", [0.0, 1e-3, 0.1])
def test_the_observed_limit_of_stability_is_the_predicted_one(damping_factor):
    springs = springs_of(MESH, uniform_material(MESH, SOFT), damping_factor=damping_factor)
    fixed = MESH.nodes[:, 2] == 0.1
    mass = block((4, 3, 3)).lumped_mass
    limit = step_limit(springs.highest_frequency(MESH.nodes, mass, fixed), damping_factor)

    def grows(step: float) -> bool:
        """Symplectic Euler from a disturbance so small that the springs stay linear."""
        velocity = np.random.default_rng(0).normal(0, 1e-9, MESH.nodes.shape) / step
        velocity[fixed] = 0.0
        positions = MESH.nodes.copy()
        for _ in range(1500):
            force = springs.forces(positions, velocity)
            force[fixed] = 0.0
            velocity += step * force / mass[:, None]
            positions += step * velocity
            if abs(positions - MESH.nodes).max() > 1e-5:
                return True
        return False

    assert not grows(0.98 * limit)
    assert grows(1.02 * limit)


def test_step_limit_solves_its_equation():
    for frequency, damping_factor in ((10.0, 0.0), (1e3, 0.1), (1e6, 0.1), (5.0, 2.0)):
        step = step_limit(frequency, damping_factor)
        span = step**2 + 2 * damping_factor * step
        assert span == pytest.approx(4 / frequency**2, rel=1e-12)


def test_a_stable_step_leaves_the_masses_alone():
    model = block((4, 3, 3))
    mass, substeps, action = stabilised(model, SPRINGS, 1e-6, 0.1, "mass_scaling", 100)
    np.testing.assert_array_equal(mass, model.lumped_mass)
    assert (substeps, action) == (1, "")


def test_masses_are_scaled_where_needed_and_it_is_said():
    model = block((4, 3, 3))
    mass, substeps, action = stabilised(model, SPRINGS, 0.01, 0.1, "mass_scaling", 100)
    assert substeps == 1
    assert (mass >= model.lumped_mass).all()
    frequency = SPRINGS.highest_frequency(MESH.nodes, mass, model.fixed)
    assert 0.01 < step_limit(frequency, 0.1) < 0.03
    factor = (mass / model.lumped_mass)[~model.fixed]
    assert action.startswith(f"masses scaled {factor.min():.0f} to {factor.max():.0f} times")


def test_substeps_are_counted_or_refused():
    model = block((4, 3, 3))
    mass, substeps, action = stabilised(model, SPRINGS, 0.01, 0.1, "substeps", 100)
    np.testing.assert_array_equal(mass, model.lumped_mass)
    assert substeps > 1
    frequency = SPRINGS.highest_frequency(MESH.nodes, mass, model.fixed)
    assert 0.01 / substeps < step_limit(frequency, 0.1) < 4 * 0.01 / substeps
    assert action.startswith(f"{substeps} sub-steps a step")
    with pytest.raises(SolverError, match=f"needs {substeps} sub-steps"):
        stabilised(model, SPRINGS, 0.01, 0.1, "substeps", substeps - 1)
