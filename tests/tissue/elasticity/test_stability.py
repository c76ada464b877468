"""The limit of symplectic Euler's time step: closed forms, a dense solver, and what is observed."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import eigh
from tissue_block import SOFT, block, block_mesh

from us_sim.errors import SolverError
from us_sim.tissue.elasticity.materials import make_uniform_materials
from us_sim.tissue.elasticity.springs import SpringNetwork, build_springs, fit_springs
from us_sim.tissue.elasticity.stability import (
    ElasticResidual,
    bound_node_stiffness,
    highest_frequency,
    stabilise,
    step_limit,
)
from us_sim.tissue.model import Intervention, TissueState
from us_sim.tissue.solvers.msds import Msds, MsdsSettings

MESH = block_mesh((4, 3, 3))


def chain(count, stiffness=100.0):
    """Nodes on a line, 1 m apart, and the springs between them."""
    nodes = np.zeros((count, 3))
    nodes[:, 0] = np.arange(count)
    edges = np.stack([np.arange(count - 1), np.arange(1, count)], axis=1).astype(np.int32)
    one = np.ones(count - 1)
    return nodes, SpringNetwork(edges, stiffness * one, 0 * one, one)


@pytest.mark.parametrize("count", [5, 12, 200])
def test_a_chain_between_two_walls(count):
    # w**2 = (4 k / m) sin(n pi / 2 (N + 1))**2; the highest of N masses has n = N.
    nodes, springs = chain(count + 2)
    fixed = np.zeros(count + 2, bool)
    fixed[[0, -1]] = True
    frequency = highest_frequency(springs.factor_stiffness(nodes), np.full(count + 2, 4.0), fixed)
    exact = 2 * math.sqrt(100.0 / 4.0) * math.sin(count * math.pi / (2 * (count + 1)))
    assert frequency == pytest.approx(exact, rel=1e-3)
    bound = bound_node_stiffness(springs.factor_stiffness(nodes))
    np.testing.assert_allclose(bound[1:-1], 200.0)
    assert frequency**2 <= 2 * 200.0 / 4.0


@given(st.floats(1e-3, 1e6), st.floats(0.0, 100.0))
@settings(max_examples=50, deadline=None)
def test_at_the_limit_a_root_of_the_amplification_has_size_one(frequency, damping_factor):
    limit = step_limit(frequency, damping_factor)
    for step, inside in ((0.999 * limit, True), (1.001 * limit, False)):
        damped = damping_factor * frequency**2 * step
        trace = 2 - damped - (frequency * step) ** 2
        largest = abs(np.roots([1.0, -trace, 1 - damped])).max()
        assert (largest <= 1 + 1e-9) == inside


@pytest.mark.parametrize("held", [True, False])
def test_highest_frequency_is_the_dense_eigenvalue(held):
    fixed = (MESH.nodes[:, 2] == 0.1) & held
    mass = np.random.default_rng(3).uniform(0.01, 0.1, len(MESH.nodes))
    springs = fit_springs(MESH, make_uniform_materials(MESH, SOFT))
    # Differences of the forces themselves: an independent linearisation.
    count, step = MESH.nodes.size, 1e-7
    still = np.zeros_like(MESH.nodes)
    matrix = np.empty((count, count))
    for i in range(count):
        moved = np.zeros(count)
        moved[i] = step
        here = MESH.nodes + moved.reshape(-1, 3)
        there = MESH.nodes - moved.reshape(-1, 3)
        change = springs.compute_forces(there, still) - springs.compute_forces(here, still)
        matrix[:, i] = change.ravel() / (2 * step)
    free = np.repeat(~fixed, 3)
    squares = eigh(
        (matrix + matrix.T)[np.ix_(free, free)] / 2,
        np.diag(np.repeat(mass, 3)[free]),
        eigvals_only=True,
    )
    factor = springs.factor_stiffness(MESH.nodes)
    frequency = highest_frequency(factor, mass, fixed)
    assert frequency == pytest.approx(math.sqrt(squares[-1]), rel=1e-3)
    assert frequency**2 < 2 * (bound_node_stiffness(factor) / mass)[~fixed].max()


def observed_limit(model, guess, **chosen):
    """Of `Msds` at given steps, from a disturbance so small that it stays linear; by bisection."""
    disturbed = TissueState.at_rest(len(model.mesh.nodes))
    disturbed.displacement[:] = np.random.default_rng(0).normal(
        0, 1e-11, (len(model.mesh.nodes), 3)
    )
    disturbed.displacement[model.fixed] = 0.0

    def grows(step):
        solver = Msds(
            model,
            MsdsSettings(
                stabilisation="none", time_step=step, steps=2000, rest_tolerance=1e-30, **chosen
            ),
        )
        solver.take_over(disturbed)
        moved = solver.deform(None).nodes - model.mesh.nodes
        failed = Intervention.FRAME_FAILED in solver.deform(None).interventions
        return failed or abs(moved).max() > 1e-8

    low, high = 0.8 * guess, 1.25 * guess
    assert not grows(low)
    assert grows(high)
    while high > 1.004 * low:
        middle = math.sqrt(low * high)
        low, high = (low, middle) if grows(middle) else (middle, high)
    return math.sqrt(low * high)


@pytest.mark.parametrize("damping_factor", [0.0, 1e-3, 0.1])
@pytest.mark.parametrize("chosen", [{}, {"stiffness": "fitted"}])
def test_the_observed_limit_of_stability_is_the_predicted_one(damping_factor, chosen):
    model = block((4, 3, 3))
    chosen = {"damping_factor": damping_factor, **chosen}
    predicted = Msds(model, MsdsSettings(stabilisation="none", **chosen)).step_limit
    assert observed_limit(model, predicted, **chosen) == pytest.approx(predicted, rel=0.02)


def test_beyond_the_limit_the_last_good_state_is_kept_and_it_is_said():
    solver = Msds(block((4, 3, 3)), MsdsSettings(stabilisation="none", time_step=0.01, steps=500))
    assert solver.step_limit < 0.01
    thrown = TissueState.at_rest(len(solver.model.mesh.nodes))
    thrown.velocity[~solver.model.fixed] = [0.0, 0.0, 1e-6]
    solver.take_over(thrown)
    deformation = solver.deform(None)
    assert Intervention.KEPT_STATE in deformation.interventions
    assert np.isfinite(deformation.nodes).all()


def test_masses_are_scaled_where_needed_and_it_is_said():
    model = block((4, 3, 3))
    factor = build_springs(MESH, make_uniform_materials(MESH, SOFT)).factor_stiffness(MESH.nodes)
    mass, substeps, action = stabilise(model, factor, 0.01, 0.1, "mass_scaling", 100)
    assert substeps == 1
    assert (mass >= model.lumped_mass).all()
    frequency = highest_frequency(factor, mass, model.fixed)
    assert 0.01 < step_limit(frequency, 0.1) < 0.03
    raised = (mass / model.lumped_mass)[~model.fixed]
    assert f"{raised.min():.0f} to {raised.max():.0f}" in action


def test_substeps_are_counted_or_refused():
    model = block((4, 3, 3))
    factor = build_springs(MESH, make_uniform_materials(MESH, SOFT)).factor_stiffness(MESH.nodes)
    mass, substeps, action = stabilise(model, factor, 0.01, 0.1, "substeps", 100)
    np.testing.assert_array_equal(mass, model.lumped_mass)
    assert substeps > 1
    frequency = highest_frequency(factor, mass, model.fixed)
    assert 0.01 / substeps < step_limit(frequency, 0.1) < 4 * 0.01 / substeps
    assert str(substeps) in action
    with pytest.raises(SolverError, match=f" {substeps} "):
        stabilise(model, factor, 0.01, 0.1, "substeps", substeps - 1)


def test_the_residual_is_unbalanced_over_contact_force_or_the_largest_since_rest():
    residual, down = ElasticResidual(rounding=1e-12), np.array([[0.0, 0.0, 1.0]])
    elastic = np.array([[0.0, 0.1, 4.0], [0.1, 0.0, 0.0]])  # N; the probe bears 4 N on node 0
    found = residual.compute_residual(elastic, np.array([0]), down)
    assert found == pytest.approx(math.hypot(0.1, 0.1) / 4.0)
    released = residual.compute_residual(elastic / 40, np.array([], int), down[:0])
    assert released == pytest.approx(np.linalg.norm(elastic) / 40 / 4.0)
    residual.reset()
    assert residual.compute_residual(elastic / 40, np.array([], int), down[:0]) == 1.0
    assert residual.compute_residual(elastic / 80, np.array([], int), down[:0]) == 1.0  # not 1/2
