"""The force of one spring, above all where it is pressed to nothing."""

import numpy as np
import pytest

from us_sim.skin.membrane import SHORTEST, spring_energy, spring_forces

STIFFNESS, LENGTH = 40.0, 0.01  # N/m, m
EDGE = np.array([[0, 1]])
REST = np.array([[0.0, 0.0, 0.0], [LENGTH, 0.0, 0.0]])


def pull(length, direction=(1.0, 0.0, 0.0), prestrain=0.0):
    """(2, 3) N: the spring's force on its two ends, which are ``length`` apart."""
    ends = np.array([np.zeros(3), length * np.array(direction)])
    force = np.empty((2, 3))
    natural = np.array([(1 - prestrain) * LENGTH])
    spring_forces(force, ends, REST, EDGE, natural, prestrain * REST[1:], STIFFNESS, 0.0)
    return force


def stored(length):
    """J, less what it stores at rest."""
    ends = np.array([np.zeros(3), [length, 0.0, 0.0]])
    return spring_energy(
        ends, np.zeros((2, 3)), REST, EDGE, np.array([LENGTH]), np.zeros((1, 3)), STIFFNESS, 0.0,
        np.ones(2),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("length", "newtons"),
    [
        (0.015, 0.2),
        (0.01, 0.0),
        (0.0075, -0.1),
        (0.005, -0.2),  # half of its natural length, where it pushes most
        (0.0025, -0.1),
        (0.001, -0.04),
        (1e-9, -4e-8),
        (0.0, 0.0),
    ],
)
def test_a_spring_pulls_by_hooke_and_lets_go_below_half_of_its_length(length, newtons):
    force = pull(length)
    np.testing.assert_allclose(force[0], [newtons, 0.0, 0.0], rtol=1e-12, atol=1e-18)
    np.testing.assert_array_equal(force[1], -force[0])


def test_a_spring_that_turns_over_changes_its_force_by_little():
    """Through nothing, from one side to the other: by twice 40 N/m times 1 nm."""
    change = pull(1e-9, (1.0, 0.0, 0.0)) - pull(1e-9, (-1.0, 0.0, 0.0))
    assert np.abs(change).max() == pytest.approx(8e-8)


def test_ends_in_one_place_leave_only_what_the_anchors_bear():
    """Of a spring with a prestrain of 20 %: 40 N/m times 2 mm, taken off as at rest."""
    np.testing.assert_allclose(pull(0.0, prestrain=0.2)[0], [-0.08, 0.0, 0.0], rtol=1e-12)


@pytest.mark.parametrize("length", [0.001, 0.0049, 0.0051, 0.02])
def test_the_force_is_the_slope_of_the_energy(length):
    step = 1e-7
    slope = (stored(length + step) - stored(length - step)) / (2 * step)
    assert pull(length)[0, 0] == pytest.approx(slope, rel=1e-5)


def test_the_energy_has_no_step_where_a_spring_lets_go():
    at = SHORTEST * LENGTH
    assert stored(at + 1e-12) == pytest.approx(stored(at - 1e-12), rel=1e-8)
    assert stored(at) == pytest.approx(STIFFNESS * at**2 / 2)
