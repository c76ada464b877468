"""The local model of the contact: a spring wall, the slope of its energy, never a pull, secants."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tissue_block import block

from us_sim.errors import TrackingError
from us_sim.geometry import se3
from us_sim.geometry.pose import Pose
from us_sim.tissue.solvers.solver import create_solver
from us_sim.tracking.haptic.contact_model import ContactModel, SecantStiffness

SPRING = 350.0  # N/m
SEEDS = st.integers(0, 2**32 - 1)


def random_model(random):
    """Pushed with a few newtons, on a stiffness of all signs."""
    factor = random.normal(size=(6, 6))
    scale = np.diag([1, 1, 1, 0.03, 0.03, 0.03])
    stiffness = scale @ (300 * (factor @ factor.T) / 6 - 50 * np.eye(6)) @ scale
    wrench = random.normal(size=6) * [2, 2, 2, 0.05, 0.05, 0.05]
    return ContactModel(0, Pose(random.normal(size=3), random.normal(size=4)), wrench, stiffness)


def moved(start, twist):
    return Pose(
        start.position + twist[:3],
        se3.product(se3.rotation_exp(twist[3:]), start.orientation),
    )


@pytest.mark.parametrize("depth", [0.0, 0.002, 0.005, 0.02])
def test_a_wall_gives_stiffness_times_depth_and_its_energy(depth):
    known = 0.008
    wall = ContactModel(
        0,
        Pose([0.01, 0.0, known]),
        np.array([0.0, 0.0, -SPRING * known, 0.0, 0.0, 0.0]),
        np.diag([0.0, 0.0, SPRING, 0.0, 0.0, 0.0]),
    )
    pressed = Pose([0.0, 0.03, depth])
    np.testing.assert_allclose(wall.wrench_at(pressed)[2], -SPRING * depth, atol=1e-12)
    assert wall.energy_at(pressed) == pytest.approx(0.5 * SPRING * depth**2, abs=1e-15)
    lifted = Pose([0.0, 0.03, -depth])
    np.testing.assert_allclose(wall.wrench_at(lifted), 0.0, atol=1e-12)


@given(SEEDS)
@settings(max_examples=50, deadline=None)
def test_at_its_pose_it_is_the_wrench_and_near_it_falls_by_the_stiffness(seed):
    random = np.random.default_rng(seed)
    model = random_model(random)
    np.testing.assert_allclose(model.wrench_at(model.pose), model.wrench, atol=1e-12)
    energy, slope = model._slope(np.zeros(6))
    step = 1e-9 * random.normal(size=6)
    lacking = model._split[4] + np.outer(model._split[2], model._split[2]) / float(
        model._split[0] @ model._split[2][:3]
    )
    change = model._slope(step)[1] - slope
    np.testing.assert_allclose(change, -lacking @ step, atol=1e-11)
    assert energy >= 0.0


@given(SEEDS)
@settings(max_examples=50, deadline=None)
def test_the_wrench_is_what_works_against_the_energy(seed):
    """Anywhere, far beyond where contact ends: force and torque times a small motion."""
    random = np.random.default_rng(seed)
    model = random_model(random)
    here = moved(model.pose, random.normal(size=6) * [0.01, 0.01, 0.01, 0.4, 0.4, 0.4])
    step = 1e-7 * random.normal(size=6)
    gained = model.energy_at(moved(here, step)) - model.energy_at(moved(here, -step))
    assert model.wrench_at(here) @ (2 * step) == pytest.approx(-gained, rel=1e-3, abs=1e-11)


@given(SEEDS)
@settings(max_examples=20, deadline=None)
def test_where_the_push_has_ended_there_is_nothing(seed):
    model = random_model(np.random.default_rng(seed))
    away = Pose(model.pose.position + 0.5 * model.push, model.pose.orientation)
    twist = model.displacement(away)
    if model._split[1] - model._split[2] @ twist <= 0.0:
        np.testing.assert_array_equal(model.wrench_at(away), 0.0)
        assert model.energy_at(away) == 0.0


@given(SEEDS)
@settings(max_examples=50, deadline=None)
def test_a_light_touch_ends_without_a_kick(seed):
    """Wherever the probe goes, the force along the push stays within a few times what it was."""
    random = np.random.default_rng(seed)
    model = random_model(random)
    light = ContactModel(0, model.pose, 0.01 * model.wrench, model.stiffness)
    size = np.linalg.norm(light.wrench[:3])
    spring = float(light._split[2][:3] @ light.push)
    for _ in range(50):
        here = moved(light.pose, random.uniform(-1, 1, 6) * [0.02, 0.02, 0.02, 0.3, 0.3, 0.3])
        deeper = max(0.0, -float(light._split[2] @ light.displacement(here)))
        along = float(light.wrench_at(here)[:3] @ light.push)
        assert abs(along) <= (2.5 * size + deeper) * (1 + 1e-9)
    assert spring > 0.0


def test_without_contact_nothing_is_felt_anywhere():
    model = ContactModel(0, Pose(), np.zeros(6), np.zeros((6, 6)))
    np.testing.assert_array_equal(model.wrench_at(Pose([0.0, 0.0, 1.0])), 0.0)
    np.testing.assert_array_equal(model.push, 0.0)


@pytest.mark.parametrize(
    ("wrench", "stiffness", "sentence"),
    [
        (np.zeros(3), np.zeros((6, 6)), "a wrench of 6 numbers"),
        (np.zeros(6), np.zeros((3, 3)), "a 6 by 6 stiffness"),
        (np.full(6, np.nan), np.zeros((6, 6)), "not finite"),
        (np.zeros(6), np.full((6, 6), np.inf), "not finite"),
        (np.full(6, 1e9), np.zeros((6, 6)), "a wrench of 1e\\+09 N"),
        (np.zeros(6), 1e12 * np.eye(6), "a stiffness of 1e\\+12 N/m: no tissue is so"),
        (np.zeros(6), np.triu(np.ones((6, 6))), "not symmetric"),
    ],
)
def test_a_model_that_cannot_be_is_refused(wrench, stiffness, sentence):
    with pytest.raises(TrackingError, match=sentence):
        ContactModel(0, Pose(), wrench, stiffness)


def test_a_secant_is_the_springs_along_the_push():
    secant, push = SecantStiffness(), np.array([0.6, 0.0, -0.8])

    def at(depth, aside):
        wrench = np.concatenate([SPRING * depth * push, np.zeros(3)])
        return secant.at(Pose(-depth * push + aside * np.array([0.8, 0.0, 0.6])), wrench)

    np.testing.assert_array_equal(at(0.004, 0.0), 0.0)
    np.testing.assert_array_equal(at(0.0041, 0.02), 0.0)  # too near to tell
    for depth in (0.005, 0.0075, 0.003):
        expected = np.zeros((6, 6))
        expected[:3, :3] = SPRING * np.outer(push, push)
        np.testing.assert_allclose(at(depth, 0.01 * depth), expected, atol=1e-9)
    secant.at(Pose(), np.zeros(6))  # lifted, and all is forgotten
    np.testing.assert_array_equal(at(0.001, 0.0), 0.0)


@pytest.mark.parametrize(("name", "tolerance"), [("fem_cg", 0.1), ("msds_implicit", 0.2)])
def test_secants_come_near_the_tangent_of_solvers_that_know_none(name, tolerance):
    """Of the push when pressed deeper, against a difference of the settled wrenches."""
    solver, secant = create_solver(name, block()), SecantStiffness()

    def settled(depth, frames):
        for _ in range(frames):
            deformation = solver.deform(Pose([0.0, 0.0, depth]))
        return np.concatenate([deformation.force, deformation.torque])

    for depth in np.arange(0.0, 0.0101, 0.001):
        found = secant.at(Pose([0.0, 0.0, depth]), settled(depth, 20))
    measured = (settled(0.0095, 60) - settled(0.0105, 60))[2] / 0.001
    assert measured > 200  # N/m
    assert found[2, 2] == pytest.approx(measured, rel=tolerance)


def test_a_solver_that_swings_makes_no_absurd_stiffness():
    random, secant = np.random.default_rng(0), SecantStiffness()
    for k in range(200):
        found = secant.at(Pose([0.0, 0.0, 6e-4 * k]), 50.0 * random.normal(size=6))
        assert 0.0 <= np.trace(found) <= 3e3 * (1 + 1e-9)
