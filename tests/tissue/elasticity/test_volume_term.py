"""The volume term: forces from its energy, nothing lost, and what of the material it adds."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tissue_block import block_mesh

from us_sim.tissue.elasticity.incremental_potential import IncrementalPotential
from us_sim.tissue.elasticity.linear_tetrahedra import stiffness
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import uniform_material
from us_sim.tissue.elasticity.springs import SpringNetwork, fitted_springs, volume_term
from us_sim.tissue.elasticity.stability import count_inverted
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh

MESH = block_mesh((4, 3, 3))
NO_SPRINGS = SpringNetwork(np.zeros((0, 2), np.int32), np.zeros(0), np.zeros(0), np.zeros(0))
STILL = np.zeros_like(MESH.nodes)


def term(ratio, damping_time=0.0):
    materials = uniform_material(MESH, Material(10e3, ratio, 1000.0))
    return volume_term(MESH, materials, fitted_springs(MESH, materials), damping_time)


def energy(volume, positions):
    """By the implicit tissue's own sums, which share no loop with the forces tested here."""
    potential = IncrementalPotential(NO_SPRINGS, volume, np.ones(len(positions)), 1.0, 0.0)
    return potential.elastic(positions)[0]


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


def test_of_one_tetrahedron_swollen_by_a_percent():
    mesh = TetrahedralMesh(np.vstack([np.zeros(3), np.eye(3)]), [[0, 1, 2, 3]])
    materials = uniform_material(mesh, Material(10e3, 0.4, 1000.0))
    volume = volume_term(mesh, materials, fitted_springs(mesh, materials))
    shear = 10e3 / 2.8
    # lambda is 4 mu at 0.4; the springs have one of them.
    np.testing.assert_allclose(volume.element, 3 * shear)
    assert not volume.nodal.any()
    swollen = mesh.nodes * 1.01 ** (1 / 3)
    assert energy(volume, swollen) == pytest.approx(3 * shear / 2 * 0.01**2 / 6)
    # Pressure times a third of the face opposite to each corner.
    push = volume.forces(swollen, np.zeros_like(swollen))[1]
    face = 0.5 * 1.01 ** (2 / 3)
    np.testing.assert_allclose(push, [-3 * shear * 0.01 * face / 3, 0, 0], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("ratio", [0.25, 0.3, 0.4])
def test_springs_and_volumes_swell_as_elasticity_does(ratio):
    materials = uniform_material(MESH, Material(10e3, ratio, 1000.0))
    springs = fitted_springs(MESH, materials)
    factors = [springs.factor(MESH.nodes), term(ratio).factor(MESH.nodes)]
    swollen = 1e-3 * MESH.nodes.ravel()
    stored = sum(((factor @ swollen) ** 2).sum() for factor in factors)
    exact = swollen @ (stiffness(MESH, materials) @ swollen)
    assert stored == pytest.approx(exact, rel=1e-9)


@pytest.mark.parametrize("ratio", [0.3, 0.49])
def test_the_factor_gives_the_derivative_of_the_forces(ratio):
    volume = term(ratio)
    factor = volume.factor(MESH.nodes)
    move = np.random.default_rng(3).normal(0, 1e-7, MESH.nodes.shape)
    change = volume.forces(MESH.nodes - move, STILL) - volume.forces(MESH.nodes + move, STILL)
    linear = (factor.T @ (factor @ move.ravel())).reshape(-1, 3)
    np.testing.assert_allclose(linear, change / 2, atol=1e-6 * abs(linear).max())


def test_nothing_is_taken_off_where_springs_are_too_stiff():
    for ratio in (0.0, 0.1, 0.25):
        assert 0 <= term(ratio).element.min() <= term(ratio).element.max() < 1e-9 * 10e3
        assert not term(ratio).nodal.any()


def test_a_tetrahedron_inside_out_is_pushed_back():
    volume = term(0.45)
    tangled = MESH.nodes.copy()
    tangled[13] += [0.0, 0.0, 0.08]
    assert count_inverted(tangled, MESH.tetrahedra) > 0
    assert volume.forces(tangled, STILL)[13, 2] < 0
