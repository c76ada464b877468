"""Refusals of the gate: by known speeds, by chi-square's own shares, and never for good."""

import math
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import rotation_exp
from us_sim.tracking.measurement import Measurement
from us_sim.tracking.outlier_gate import OutlierGate, Verdict
from us_sim.tracking.settings import GateSettings

BELIEVED, REFUSED, NEW_PLACE = Verdict.BELIEVED, Verdict.REFUSED, Verdict.NEW_PLACE
MS = 1_000_000
LIMITS = GateSettings(
    maximum_speed=1.0, maximum_angular_speed=10.0, jump=2e-3, rotation_jump=0.02, accept_after=4
)


def seen(ms, x, turn=0.0, covariance=None):
    pose = Pose([x, 0.0, 0.0], rotation_exp(np.array([0.0, turn, 0.0])))
    return Measurement(round(ms * MS), pose, covariance)


def verdicts(gate, *measurements):
    return [gate.judge_measurement(measurement) for measurement in measurements]


@pytest.mark.parametrize(
    ("ms", "x", "turn", "believed"),
    [
        (10, 0.0119, 0.0, True),  # 1 m/s · 10 ms + 2 mm
        (10, 0.0121, 0.0, False),
        (1, 0.0029, 0.0, True),
        (1, 0.0031, 0.0, False),
        (500, 0.501, 0.0, True),
        (10, 0.0, 0.119, True),  # 10 rad/s · 10 ms + 0.02 rad
        (10, 0.0, 0.121, False),
        (10, 0.0, -0.121, False),
        (1000, 0.0, np.pi, True),
    ],
)
def test_limits_on_speed(ms, x, turn, believed):
    gate = OutlierGate(LIMITS)
    assert gate.judge_measurement(seen(0, 0.0)) is BELIEVED
    assert gate.judge_measurement(seen(ms, x, turn)) is (BELIEVED if believed else REFUSED)
    assert bool(gate.reason) is not believed


def settled():
    gate = OutlierGate(LIMITS)
    assert verdicts(gate, *(seen(10 * k, 0.0) for k in range(-5, 1))) == [BELIEVED] * 6
    return gate


def test_refused_poses_that_agree_are_the_new_place():
    gate = settled()
    moved = verdicts(gate, *(seen(10 * k, 0.5 + 0.001 * k) for k in range(1, 7)))
    assert moved == [REFUSED, REFUSED, REFUSED, NEW_PLACE, BELIEVED, BELIEVED]
    assert gate.judge_measurement(seen(70, 0.0)) is REFUSED


def test_refused_poses_that_do_not_agree_are_no_place():
    """However long they come: for 10 s, in which a probe may go anywhere, but does not so."""
    gate = settled()
    rng = np.random.default_rng(2)
    scattered = [seen(10 * k, x) for k, x in enumerate(rng.permutation(np.arange(1000)) / 5 + 1)]
    assert verdicts(gate, *scattered[1:]) == [REFUSED] * 999


def test_after_refused_poses_the_probe_is_believed_where_it_can_have_come_to():
    gate = settled()
    assert verdicts(gate, seen(10, 5.0), seen(20, -5.0)) == [REFUSED] * 2
    assert gate.judge_measurement(seen(30, 0.0319)) is BELIEVED  # 1 m/s · 30 ms + 2 mm


def test_a_first_pose_that_is_wrong_is_outvoted_by_two():
    gate = OutlierGate(LIMITS)
    answers = verdicts(gate, seen(0, -2.0), *(seen(10 * k, 0.0) for k in range(1, 5)))
    assert answers == [BELIEVED, REFUSED, NEW_PLACE, BELIEVED, BELIEVED]


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 200), st.floats(-1, 1)), max_size=30), st.floats(-5, 5))
def test_no_past_locks_a_steady_probe_out(past, place):
    gate, time = OutlierGate(LIMITS), 0
    for step, x in past:
        time += step
        gate.judge_measurement(seen(time, x))
    answers = verdicts(gate, *(seen(time + 10 * k, place) for k in range(1, 6)))
    assert answers[-1] is BELIEVED


COVARIANCE = np.diag([1e-8, 4e-8, 9e-8, 1e-6, 1e-6, 4e-6])
COVARIANCE[0, 4] = COVARIANCE[4, 0] = 5e-8


@pytest.mark.parametrize(("part", "verdict"), [(0.999, BELIEVED), (1.001, REFUSED)])
def test_with_covariances_the_limit_is_chi_squares(part, verdict):
    """A way of its root in deviations, in a nanosecond."""
    deviation = 1e-3
    way = part * math.sqrt(chi2.isf(1e-6, 6)) * deviation
    covariance = np.diag([deviation**2 / 2] * 6)
    gate = OutlierGate(LIMITS)
    gate.judge_measurement(Measurement(0, Pose(), covariance))
    assert gate.judge_measurement(Measurement(1, Pose([0, way, 0]), covariance)) is verdict


def test_with_covariances_the_fastest_motion_is_at_the_limit():
    sure = np.diag([1e-14] * 6)
    for part, verdict in ((0.999, BELIEVED), (1.001, REFUSED)):
        gate = OutlierGate(LIMITS)
        gate.judge_measurement(seen(0, 0.0, covariance=sure))
        assert gate.judge_measurement(seen(100, 0.1 * part, 1.0 * part, covariance=sure)) is verdict
    assert re.search(r"100\.1 mm .*57\.4° .*6\.2.* 6\.2", gate.reason)


def test_one_covariance_alone_says_nothing_of_a_difference():
    """Then the limits hold, with their jump: 11 mm in 10 ms."""
    sure = np.diag([1e-14] * 6)
    for first, second in ((sure, None), (None, sure)):
        gate = OutlierGate(LIMITS)
        answers = verdicts(gate, seen(0, 0.0, 0.0, first), seen(10, 0.011, 0.0, second))
        assert answers == [BELIEVED, BELIEVED]
