"""Least squares against SciPy, its ends, and intervals that hold the truth as often as said."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from us_sim.errors import SolverError, StiffnessError
from us_sim.tissue.identification.fit import FARTHEST, blocks, covariance, fit, jackknife, quantile

DEPTH = np.linspace(0.0, 1.0, 40)
GROUPS = np.repeat([0, 1], 20)
OFFSETS = np.eye(2)[GROUPS]


def model(at):
    """Forces and torques that two moduli make, and their slopes."""
    one, other = np.exp(at)
    lever = np.where(GROUPS == 0, 1.0, 0.01)
    first, second = lever * one * DEPTH**2, lever * np.sqrt(other) * DEPTH * (1 + GROUPS)
    return first + second, np.column_stack([first, second / 2])


def test_it_ends_where_scipy_does():
    random = np.random.default_rng(2)
    noise = np.where(GROUPS == 0, 0.02, 0.0002)
    measured = model(np.log([3.0, 5.0]))[0] + OFFSETS @ [0.5, 0.01] + noise * random.normal(size=40)
    found = fit(model, measured, GROUPS, OFFSETS, np.zeros(2))

    def residual(unknown):
        return (measured - model(unknown[:2])[0] - OFFSETS @ unknown[2:]) / found.noise

    other = least_squares(residual, np.zeros(4), x_scale="jac", xtol=1e-12)
    assert found.log_moduli == pytest.approx(other.x[:2], abs=2e-3)
    assert found.nuisance == pytest.approx(other.x[2:], abs=1e-3)
    assert not found.bounded.any()
    assert found.noise[0] == pytest.approx(0.02, rel=0.4)
    assert found.noise[-1] == pytest.approx(0.0002, rel=0.4)


def test_a_modulus_that_runs_away_is_stopped_and_said():
    def soft(at):
        force = DEPTH * np.exp(at[0])
        return force, force[:, None]

    found = fit(soft, 1e3 * DEPTH, 0 * GROUPS, np.ones((40, 1)), np.zeros(1))
    assert found.bounded.tolist() == [True]
    assert found.log_moduli[0] == pytest.approx(np.log(FARTHEST))


def test_where_the_model_has_no_answer_a_shorter_step_is_taken():
    def narrow(at):
        if at[0] > 1.0:
            raise SolverError("too stiff")
        return model(at)

    truth = np.log([2.0, 5.0])
    found = fit(narrow, model(truth)[0], GROUPS, OFFSETS, np.array([-3.0, 0.0]))
    assert found.log_moduli == pytest.approx(truth, abs=1e-3)


def test_a_model_that_has_no_answer_where_the_fit_begins_is_an_error():
    def never(_):
        raise StiffnessError("no balance")

    with pytest.raises(StiffnessError, match="no balance"):
        fit(never, DEPTH, GROUPS, OFFSETS, np.zeros(2))


TIMES = np.repeat(np.arange(60.0), 3)
DEPTHS = np.repeat(np.sin(np.pi * (np.arange(60) + 0.5) / 60), 3)
DESIGN = np.column_stack([DEPTHS, DEPTHS**2, np.ones(180)])


@pytest.mark.parametrize("correlation", [0.0, 0.7])
def test_95_percent_intervals_hold_the_truth_in_95_of_100_runs(correlation):
    random = np.random.default_rng(4)
    inside, runs = 0, 400
    for _ in range(runs):
        noise = random.normal(size=(60, 3))
        for k in range(1, 60):
            noise[k] = correlation * noise[k - 1] + np.sqrt(1 - correlation**2) * noise[k]
        found, *_ = np.linalg.lstsq(DESIGN, noise.ravel(), rcond=None)
        residual = noise.ravel() - DESIGN @ found
        half = quantile(0.95) * np.sqrt(covariance(DESIGN, residual, TIMES, DEPTHS))
        inside += np.abs(found[0]) <= half[0]
    assert inside >= 0.93 * runs


def test_independent_residuals_have_the_classical_covariance():
    random = np.random.default_rng(5)
    design = random.normal(size=(4000, 3))
    residual = 0.3 * random.normal(size=4000)
    found = jackknife(design, residual, blocks(np.arange(4000.0), 200))
    assert np.diag(found) == pytest.approx(
        0.09 * np.diag(np.linalg.inv(design.T @ design)), rel=0.3
    )


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(0, 50), min_size=1, max_size=100), st.integers(1, 12))
def test_blocks_are_in_order_and_keep_equals_together(order, count):
    part = blocks(np.array(order, dtype=float), count)
    assert part.min() == 0
    assert part.max() < count
    for value in set(order):
        assert len({int(p) for p, v in zip(part, order, strict=True) if v == value}) == 1
    assert (np.diff(part[np.argsort(order, kind="stable")]) >= 0).all()
