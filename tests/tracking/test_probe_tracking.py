"""From measurements to the probe: frames, covariances, order, outliers, and what restarts it."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.geometry import se3
from us_sim.geometry.pose import Pose
from us_sim.settings.registry import FILTERS
from us_sim.tracking.filters import create_filter
from us_sim.tracking.measurement import Measurement, TrackingState
from us_sim.tracking.outlier_gate import OutlierGate
from us_sim.tracking.probe_tracking import ProbeTracking
from us_sim.tracking.settings import GateSettings

MS = 1_000_000
START = 5_000_000_000


def tracking(method="none", gate=None, **kwargs):
    gate = OutlierGate(gate) if gate else None
    return ProbeTracking(Pose(), Pose(), create_filter(method), gate, **kwargs)


def at(ms, x=0.0, covariance=None):
    return Measurement(START + round(ms * MS), Pose([x, 0.0, 0.0]), covariance)


def take(tracked, *measurements):
    return [tracked.process_measurement(m, m.stamp) for m in measurements]


numbers = st.floats(-1.0, 1.0)
twists = st.tuples(*[numbers] * 6).map(np.array)


@settings(max_examples=40, deadline=None)
@given(twists, twists, twists)
def test_the_probe_is_where_registration_body_and_calibration_put_it(a, b, c):
    registration, body, calibration = se3.exp(a), se3.exp(b), se3.exp(c)
    tracked = ProbeTracking(registration, calibration, create_filter("none"))
    probe = tracked.process_measurement(Measurement(START, body), START)
    expected = registration.matrix @ body.matrix @ calibration.matrix
    np.testing.assert_allclose(probe.pose.matrix, expected, atol=1e-12)


def test_the_covariance_is_that_of_the_probe_in_patient():
    """Against slopes by differences of the composed pose."""
    rng = np.random.default_rng(3)
    registration = Pose([0.3, -0.2, 0.5], [0.4, -0.2, 0.1, 0.8])
    calibration = Pose([0.02, 0.01, 0.15], [0.1, 0.7, -0.3, 0.2])
    body = Pose([0.1, 0.2, 0.6], [-0.3, 0.2, 0.5, 0.7])
    root = np.diag([2e-4, 3e-4, 9e-4, 3e-3, 2e-3, 1e-3]) @ (
        np.eye(6) + 0.4 * rng.normal(size=(6, 6))
    )
    covariance = root @ root.T
    tracked = ProbeTracking(registration, calibration, create_filter("none"))
    told = tracked.process_measurement(Measurement(START, body, covariance, error=0.4), START)
    slopes = np.empty((6, 6))
    step = 1e-6
    for k, way in enumerate(step * np.eye(6)):
        ahead, behind = (
            registration
            @ Pose(
                body.position + s * way[:3],
                se3.multiply_quaternions(se3.rotation_exp(s * way[3:]), body.orientation),
            )
            @ calibration
            for s in (1, -1)
        )
        turn = se3.rotation_between(behind.orientation, ahead.orientation)
        slopes[:, k] = np.r_[ahead.position - behind.position, turn] / (2 * step)
    expected = slopes @ covariance @ slopes.T
    np.testing.assert_allclose(told.covariance, expected, rtol=1e-6, atol=1e-12)
    assert told.error == 0.4


def test_the_time_offset_is_added_to_the_stamp_and_to_nothing_else():
    tracked = tracking(time_offset=-0.0125)
    probe = tracked.process_measurement(at(0), START + 3 * MS)
    assert probe.stamp == START - 12_500_000
    assert tracked.find_state(START + 302 * MS) is TrackingState.TRACKED


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.integers(-2500, 1500), st.floats(-0.05, 0.05)), max_size=25),
    st.sampled_from(FILTERS.names),
)
def test_no_pose_is_published_but_under_its_own_stamp(steps, method):
    tracked, stamp, newest = tracking(method, GateSettings(), time_offset=0.5), START * 10, None
    for step, x in steps:
        stamp += step * MS
        probe = tracked.process_measurement(Measurement(stamp, Pose([x, 0.0, 0.0])), stamp)
        late = newest is not None and -1000 * MS < stamp - newest <= 0
        if late:
            assert probe is None
        else:
            newest = stamp
        assert probe is None or probe.stamp == stamp + 500 * MS


def test_what_is_not_newer_is_refused_and_counted():
    tracked = tracking()
    answers = take(tracked, at(0), at(0), at(-999), at(10), at(5))
    assert [answer is None for answer in answers] == [False, True, True, False, True]
    assert tracked.refused == {"order": 3}
    assert "not newer" in tracked.last_problem


@pytest.mark.parametrize("method", FILTERS.names)
def test_stamps_that_jump_back_start_everything_anew(method):
    tracked = tracking(method, GateSettings())
    take(tracked, *(at(10 * k, 0.001 * k) for k in range(300)))
    again = at(-1000, 0.9)  # another place, which is no outlier: the source was started again
    assert take(tracked, again)[0].pose.position[0] == 0.9
    assert tracked.refused == {}
    assert tracked.restarts == {"stamp": 1}
    follow = take(tracked, at(-990, 0.9))[0]
    assert follow.pose.position[0] == pytest.approx(0.9, abs=1e-9)


@pytest.mark.parametrize("method", FILTERS.names)
def test_after_it_was_lost_it_starts_where_it_is_found(method):
    tracked = tracking(method, GateSettings(), lost_after=0.5)
    take(tracked, *(at(10 * k, 0.001 * k) for k in range(50)))
    assert tracked.find_state(at(490 + 499).stamp) is TrackingState.COASTING
    assert tracked.find_state(at(490 + 500).stamp) is TrackingState.LOST
    found = at(1000, 3.0)
    assert take(tracked, found)[0].pose.position[0] == 3.0
    assert tracked.find_state(found.stamp) is TrackingState.TRACKED
    assert tracked.restarts == {"gap": 1}


@pytest.mark.parametrize("method", FILTERS.names)
def test_a_real_jump_locks_nothing_out_and_is_not_smeared(method):
    """Refused at first; then the filter starts at the new place and not between the two."""
    tracked = tracking(method, GateSettings(accept_after=5))
    take(tracked, *(at(10 * k) for k in range(100)))
    answers = take(tracked, *(at(1000 + 10 * k, 0.8) for k in range(6)))
    assert [answer is None for answer in answers] == [True] * 4 + [False] * 2
    assert answers[4].pose.position[0] == 0.8
    assert answers[5].pose.position[0] == pytest.approx(0.8, abs=1e-12)
    assert tracked.refused == {"gate": 4}
    assert tracked.restarts == {"place": 1}


def test_while_all_is_refused_it_coasts():
    tracked = tracking(gate=GateSettings(accept_after=1000))
    take(tracked, *(at(10 * k) for k in range(10)))
    states = []
    for k in range(10, 60):
        there = at(10 * k, 5.0 + k)
        assert take(tracked, there) == [None]
        states.append(tracked.find_state(there.stamp))
    assert states[28] is TrackingState.TRACKED
    assert states[29] is TrackingState.COASTING  # 0.3 s after the last that was believed


def test_nonsense_is_not_believed_when_the_probe_is_lost_either():
    rng = np.random.default_rng(8)
    tracked = tracking("one_euro", GateSettings())
    take(tracked, *(at(20 * k) for k in range(10)))
    nonsense = take(tracked, *(at(200 + 20 * k, x) for k, x in enumerate(rng.permutation(200) + 1)))
    assert nonsense == [None] * 200
    assert tracked.find_state(at(4200).stamp) is TrackingState.LOST
    answers = take(tracked, *(at(4200 + 20 * k, 0.3) for k in range(6)))
    assert [answer is None for answer in answers] == [True] * 4 + [False] * 2
    assert answers[4].pose.position[0] == 0.3


@pytest.fixture(scope="module")
def recorded(shared_file):
    """Seconds and (4, 4) matrices, mm, of the transforms of a PLUS recording of 500 samples.

    Sample 7 is invalid: its transforms are the identity. So is the first of the stylus.
    """
    file = shared_file("plus-tracker-recordings/TransformInterpolationTest.igs.mha")
    header = file.read_bytes().split(b"ElementDataFile")[0].decode("latin-1")
    times = np.array(re.findall(r"_Timestamp = (\S+)", header), dtype=float)
    matrices = {
        name: np.array(
            [row.split() for row in re.findall(rf"_{name} = ([^\n]*)", header)], dtype=float
        ).reshape(-1, 4, 4)
        for name in ("ProbeToTrackerTransform", "ReferenceToTrackerTransform", "Stylus")
    }
    return times, matrices


@pytest.mark.parametrize("method", FILTERS.names)
@pytest.mark.parametrize(
    ("name", "refused"),
    [
        ("ProbeToTrackerTransform", [7]),
        ("ReferenceToTrackerTransform", [7]),
        ("Stylus", [1, 7]),  # 0 is believed, as nothing is known then, and outvoted by 1 and 2
    ],
)
def test_outliers_of_a_real_tracker_are_refused_and_counted(recorded, method, name, refused):
    times, matrices = recorded
    assert len(times) == len(matrices[name]) == 500
    tracked = tracking(method, GateSettings())
    answers = []
    for time, matrix in zip(times, matrices[name], strict=True):
        pose = Pose(1e-3 * matrix[:3, 3], Pose.from_matrix(matrix).orientation)
        stamp = round(1e9 * time)
        answers.append(tracked.process_measurement(Measurement(stamp, pose), stamp))
    assert [k for k, answer in enumerate(answers) if answer is None] == refused
    assert tracked.refused == {"gate": len(refused)}
    assert tracked.restarts == ({"place": 1} if name == "Stylus" else {})
    raw = np.array([1e-3 * matrix[:3, 3] for matrix in matrices[name]])
    off = [
        np.linalg.norm(answer.pose.position - raw[k])
        for k, answer in enumerate(answers)
        if answer is not None
    ]
    assert max(off) < 0.02  # m: no filter drags an outlier along
