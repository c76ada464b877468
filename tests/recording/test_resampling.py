"""Resampling against motions that are known at every time."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from us_sim.recording.resampling import latest, linear, slerp

START = 1_700_000_000_000_000_000
steps = st.lists(st.integers(1, 10**9), min_size=2, max_size=30)
parts = st.lists(st.floats(0, 1), min_size=1, max_size=30)


def times_and_moments(steps, parts):
    times = START + np.cumsum(steps)
    moments = times[0] + (np.sort(parts) * (times[-1] - times[0])).astype(np.int64)
    return times, moments


@given(steps, parts, st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=2))
def test_what_changes_at_a_constant_rate_is_met(steps, parts, rates):
    times, moments = times_and_moments(steps, parts)
    made = linear(times, np.outer((times - START) * 1e-9, rates), moments)
    assert made == pytest.approx(np.outer((moments - START) * 1e-9, rates), abs=1e-6, rel=1e-9)


@given(steps, parts, st.tuples(*[st.floats(-2, 2)] * 3), st.integers(0, 2**30 - 1))
def test_a_constant_turn_is_met_whatever_the_signs_of_quaternions(steps, parts, velocity, signs):
    times, moments = times_and_moments(steps, parts)

    def turn(at):
        return Rotation.from_rotvec(np.outer((at - START) * 1e-9, velocity))

    flips = np.array([1 - 2 * (signs >> k & 1) for k in range(len(times))])
    poses = np.hstack([np.zeros((len(times), 3)), turn(times).as_quat() * flips[:, None]])
    made = slerp(times, poses, moments)
    assert (turn(moments).inv() * Rotation.from_quat(made[:, 3:])).magnitude().max() < 1e-6
    assert made[0, 6] >= 0
    assert (np.einsum("ij,ij->i", made[1:, 3:], made[:-1, 3:]) >= 0).all()


@given(steps, parts)
def test_the_latest_is_no_later_and_the_next_one_is(steps, parts):
    times, moments = times_and_moments(steps, parts)
    shown = latest(times, moments)
    assert (times[shown] <= moments).all()
    assert (np.append(times, np.iinfo(np.int64).max)[shown + 1] > moments).all()


def test_a_number_that_a_message_has_not_is_taken_from_those_that_have_it():
    values = np.array([[0.0, 5.0], [np.nan, 6.0], [2.0, np.nan], [3.0, 8.0]])
    made = linear(np.arange(4) * 100, values, np.array([100, 200]))
    assert made.tolist() == [[1.0, 6.0], [2.0, 7.0]]
