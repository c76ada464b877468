"""Least squares against SciPy's, and its ends."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from us_sim.errors import SolverError, StiffnessError
from us_sim.tissue.identification.fit import FARTHEST, fit

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
