"""The handle and the probe: scale, clutch, registration, and work that is the same on both."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.errors import TrackingError
from us_sim.geometry import se3
from us_sim.geometry.pose import Pose
from us_sim.tracking.haptic.device import HapticDevice
from us_sim.tracking.haptic.settings import HapticSettings

SEEDS = st.integers(0, 2**32 - 1)


def pose(random, way=0.1):
    return Pose(way * random.normal(size=3), random.normal(size=4))


def moved(start, twist):
    return Pose(
        start.position + twist[:3],
        se3.product(se3.rotation_exp(twist[3:]), start.orientation),
    )


def test_the_probe_goes_as_far_as_the_scale_says_and_turns_as_the_handle():
    arm = HapticDevice(HapticSettings(scale=0.5))
    turn = se3.rotation_exp(np.array([0.0, 0.0, 0.3]))
    body = arm.take(Pose([0.02, 0.0, -0.04], turn), 7)
    assert body.stamp == 7
    np.testing.assert_allclose(body.pose.position, [0.01, 0.0, -0.02], atol=1e-15)
    np.testing.assert_allclose(body.pose.orientation, turn, atol=1e-15)


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_the_clutch_never_moves_the_probe(seed):
    random = np.random.default_rng(seed)
    arm = HapticDevice(HapticSettings(scale=float(random.uniform(0.1, 5.0))))
    for _ in range(3):
        before = arm.take(pose(random), 0).pose
        arm.clutch(True)
        held = arm.take(pose(random), 1).pose
        np.testing.assert_allclose(held.matrix, before.matrix, atol=1e-12)
        last = pose(random)
        arm.take(last, 2)
        arm.clutch(False)
        np.testing.assert_allclose(arm.take(last, 3).pose.matrix, before.matrix, atol=1e-12)
    # From there a way and a turn of the handle are the probe's, about the same axes.
    twist = 0.01 * random.normal(size=6)
    after = arm.take(moved(last, twist), 4).pose
    np.testing.assert_allclose(
        se3.rotation_between(before.orientation, after.orientation), twist[3:], atol=1e-12
    )
    arm.reset()
    body = arm.take(last, 5).pose
    np.testing.assert_allclose(body.orientation, last.orientation, atol=1e-15)


def test_a_clutch_that_is_held_from_the_start_holds_the_first_pose():
    arm = HapticDevice(HapticSettings())
    arm.clutch(True)
    arm.take(Pose([0.01, 0.0, 0.0]), 0)
    arm.clutch(True)
    np.testing.assert_array_equal(arm.take(Pose([0.05, 0.0, 0.0]), 1).pose.position, [0.01, 0, 0])
    arm.clutch(False)
    arm.clutch(False)
    np.testing.assert_allclose(
        arm.take(Pose([0.05, 0.0, 0.02]), 2).pose.position, [0.01, 0, 0.02], atol=1e-15
    )


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_the_probe_moves_as_the_trackers_frames_say(seed):
    """The motion since a pose is that of registration, body and calibration, clutch or not."""
    random = np.random.default_rng(seed)
    registration, calibration = pose(random), pose(random)
    arm = HapticDevice(HapticSettings(scale=2.5), registration, calibration)
    arm.take(pose(random), 0)
    arm.clutch(True)
    arm.take(pose(random), 1)
    arm.clutch(False)
    first, second = pose(random), pose(random)
    before = registration @ arm.take(first, 2).pose @ calibration
    after = registration @ arm.take(second, 3).pose @ calibration
    motion = arm.probe_moved(before, first, second)
    np.testing.assert_allclose(motion[:3], after.position - before.position, atol=1e-12)
    turned = se3.product(se3.rotation_exp(motion[3:]), before.orientation)
    np.testing.assert_allclose(Pose(orientation=turned).rotation, after.rotation, atol=1e-12)


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_work_at_the_handle_is_work_at_the_probe(seed):
    random = np.random.default_rng(seed)
    arm = HapticDevice(HapticSettings(scale=3.0, force_scale=0.7), pose(random), pose(random))
    handle, probe, wrench = pose(random), pose(random), random.normal(size=6)
    felt = arm.on_handle(probe, np.zeros(3), wrench)
    step = 1e-7 * random.normal(size=6)
    motion = arm.probe_moved(probe, handle, moved(handle, step))
    assert felt @ step == pytest.approx(0.7 / 3.0 * (wrench @ motion), rel=1e-5)


def test_a_wrench_is_turned_into_the_arms_frame():
    quarter = se3.rotation_exp(np.array([0.0, 0.0, np.pi / 2]))  # the arm's x is the patient's y
    arm = HapticDevice(HapticSettings(), Pose(orientation=quarter), Pose([0.0, 0.0, 0.1]))
    felt = arm.on_handle(Pose(), np.zeros(3), np.array([0.0, 2.0, -1.0, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(felt[:3], [2.0, 0.0, -1.0], atol=1e-12)
    # 0.1 m before the handle, 2 N along the patient's y make -0.2 N m about its x, the arm's -y.
    np.testing.assert_allclose(felt[3:], [0.0, 0.2, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("setting", "sentence"),
    [
        ({"scale": 0.0}, "haptic.scale: 0 is outside 0.01 to 100"),
        ({"force_limit": -1.0}, "haptic.force_limit"),
        ({"rate": "1 m"}, "haptic.rate: '1 m' is not a frequency"),
        ({"ramp": float("nan")}, "haptic.ramp: nan is not finite"),
    ],
)
def test_settings_that_make_no_sense_are_refused(setting, sentence):
    with pytest.raises(TrackingError, match=sentence):
        HapticSettings(**setting)
