"""The haptic node: walls, zero force at any doubt, the whole way from the tissue, steady ticks."""

import itertools
import threading
import time

import numpy as np
import pytest
from bench import pose_at
from geometry_msgs.msg import PoseStamped, WrenchStamped
from rclpy.serialization import deserialize_message, serialize_message
from rclpy.time import Time
from std_msgs.msg import Bool, Float64MultiArray

from us_sim.errors import TrackingError
from us_sim.geometry.pose import Pose
from us_sim.nodes.haptic_renderer import HapticRenderer, PeriodicThread
from us_sim.nodes.messages import (
    contact_model_from,
    contact_model_message,
    serialize_wrench,
    wrench_message,
)
from us_sim.nodes.tissue_deformer import TissueDeformer
from us_sim.recording.decoding import pose_from
from us_sim.tracking.haptic import ContactModel

TRACKER = (
    "tracker: {source: haptic, frame: arm, haptic: {rate: 200, ramp: 20 ms, model_timeout: 5 s"
)
SPRING = 200.0  # N/m


@pytest.fixture
def scene(small_scene, tmp_path):
    file = tmp_path / "haptic.yaml"
    file.write_text(f"{small_scene.read_text()}\n{TRACKER}, pose_timeout: 1 s}}}}\n")
    return file


@pytest.fixture
def arm(bench, scene):
    node = bench.make(HapticRenderer, scene=str(scene))
    wrenches = bench.collect(WrenchStamped, "haptic/wrench")
    return node, wrenches, Handle(bench)


class Handle:
    def __init__(self, bench):
        self._bench = bench
        self.poses = bench.publisher(PoseStamped, "haptic/pose")
        self.models = bench.publisher(Float64MultiArray, "tissue/contact_model")
        self.clutch = bench.publisher(Bool, "haptic/clutch")
        self._nanoseconds = 1_000_000_000

    def move(self, depth, *, model=True):
        self._nanoseconds += 1_000_000
        message = pose_at(depth, 0, frame="arm")
        message.header.stamp = Time(nanoseconds=self._nanoseconds).to_msg()
        self.poses.publish(message)
        if model:
            self._bench.spin_for(2)
            wrench = np.array([0.0, 0.0, -SPRING * max(depth, 0.0), 0.0, 0.0, 0.0])
            stiffness = np.diag([0.0, 0.0, SPRING * (depth > 0), 0.0, 0.0, 0.0])
            pressed = ContactModel(self._nanoseconds, pose_from(message), wrench, stiffness)
            self.models.publish(contact_model_message(pressed))

    def press(self, depth):
        for part in np.linspace(-0.001, depth, 20):
            self.move(part)
            self._bench.spin_for(1)


def felt(wrenches):
    return wrenches[-1].wrench.force.z if wrenches else np.nan


def test_a_wall_pushes_back_with_its_stiffness_times_the_depth(bench, arm):
    node, wrenches, handle = arm
    bench.spin_until(lambda: wrenches)
    assert felt(wrenches) == 0.0
    handle.press(0.005)
    bench.spin_until(lambda: felt(wrenches) == pytest.approx(-SPRING * 0.005, rel=1e-6))
    assert wrenches[-1].header.frame_id == "arm"
    assert wrenches[-1].header.stamp == Time(nanoseconds=1_020_000_000).to_msg()
    bench.spin_until(lambda: node.health.state == "rendering")
    handle.move(0.006, model=False)  # the tissue's answer is not awaited
    bench.spin_until(lambda: felt(wrenches) == pytest.approx(-SPRING * 0.006, rel=1e-6))


@pytest.mark.parametrize(
    ("doubt", "kind", "reason"),
    [
        ("nan", "pose", "not finite"),
        ("clutch", "", "the clutch is held"),
        ("model", "tracking", "51 numbers"),
    ],
)
def test_any_doubt_makes_it_zero_until_there_is_none(bench, arm, doubt, kind, reason):
    node, wrenches, handle = arm
    handle.press(0.005)
    bench.spin_until(lambda: felt(wrenches) < -0.99)
    if doubt == "nan":
        handle.poses.publish(pose_at(float("nan"), 2, frame="arm"))
    elif doubt == "clutch":
        handle.clutch.publish(Bool(data=True))
    else:
        handle.models.publish(Float64MultiArray(data=[1.0, 2.0, 3.0]))
    bench.spin_until(lambda: felt(wrenches) == 0.0)
    bench.spin_until(lambda: node.health.problems["doubt"] == 1)
    assert reason in node.health.measure()["stopped"]
    assert not kind or node.health.problems[kind] == 1
    if doubt == "clutch":
        handle.clutch.publish(Bool(data=False))
        bench.spin_for(10)
    handle.press(0.004)
    bench.spin_until(lambda: felt(wrenches) == pytest.approx(-SPRING * 0.004, rel=1e-6))


def test_a_rendering_that_fails_leaves_a_zero_behind_and_goes_on_anew(bench, arm, monkeypatch):
    node, wrenches, handle = arm
    handle.press(0.005)
    bench.spin_until(lambda: felt(wrenches) < -0.99)

    def fail(_):
        raise ValueError("a bug")

    monkeypatch.setattr(node._rendering, "render", fail)
    bench.spin_until(lambda: felt(wrenches) == 0.0)
    bench.spin_until(lambda: node.failures["rendering"] == 1)
    assert node.last_failure == "rendering: ValueError: a bug"
    handle.press(0.005)
    bench.spin_until(lambda: felt(wrenches) < -0.99)


def test_from_the_tissue_to_the_hand(bench, scene):
    """Without friction and registration the hand feels the solver's own wrench."""
    bench.make(TissueDeformer, scene=str(scene))
    bench.make(HapticRenderer, scene=str(scene))
    felt_at_probe = bench.collect(WrenchStamped, "probe/wrench")
    wrenches = bench.collect(WrenchStamped, "haptic/wrench")
    handle = bench.publisher(PoseStamped, "haptic/pose")
    probe = bench.publisher(PoseStamped, "probe/pose")
    second = 0

    def press(depth):
        nonlocal second
        second += 1
        message = pose_at(depth, 0, frame="arm")
        message.header.stamp = Time(nanoseconds=1_000_000_000 + 5_000_000 * second).to_msg()
        handle.publish(message)
        message.header.frame_id = "patient"
        probe.publish(message)
        bench.spin_for(10)

    for depth in np.linspace(-0.002, 0.003, 40):
        press(depth)

    def agrees():
        press(0.003)
        expected = felt(felt_at_probe)
        return expected < -0.05 and felt(wrenches) == pytest.approx(expected, rel=1e-3)

    bench.spin_until(agrees)


def test_a_model_survives_its_message():
    random = np.random.default_rng(3)
    stiffness = random.normal(size=(6, 6))
    pose = Pose(random.normal(size=3), random.normal(size=4))
    model = ContactModel(
        1_234_567_890_123_456_789, pose, random.normal(size=6), stiffness + stiffness.T
    )
    message = contact_model_message(model)
    back = contact_model_from(message)
    assert back.stamp == model.stamp
    np.testing.assert_allclose(back.pose.matrix, pose.matrix, atol=1e-15)
    np.testing.assert_array_equal(back.wrench, model.wrench)
    np.testing.assert_array_equal(back.stiffness, model.stiffness)
    for wrong in (float("nan"), 1e300):
        message.data[20] = wrong
        with pytest.raises(TrackingError, match="51 numbers"):
            contact_model_from(message)


@pytest.mark.parametrize("frame", ["", "arm"])
def test_a_wrench_written_by_hand_is_the_message(frame):
    wrench = np.array([1.0, -2.0, 3.5, 1e-9, 0.0, -7.25])
    written = serialize_wrench(wrench, 1_234_567_890_123_456_789, frame)
    stamp = Time(nanoseconds=1_234_567_890_123_456_789).to_msg()
    message = wrench_message(wrench[:3], wrench[3:], stamp, frame)
    assert deserialize_message(written, WrenchStamped) == message
    assert len(written) == len(serialize_message(message))  # some leave anything in the padding


def run(thread, done):
    assert done.wait(20.0)
    thread.stop()


def test_a_hold_up_is_skipped_and_not_made_up_for():
    period, ticks, done = 0.005, [], threading.Event()

    def work(now):
        ticks.append(now)
        if len(ticks) == 20:
            time.sleep(20.5 * period)
        if len(ticks) == 60:
            done.set()

    thread = PeriodicThread(1 / period, work)
    run(thread, done)
    assert thread.skipped >= 19
    ways = [b - a for a, b in itertools.pairwise(ticks)]
    # On the whole as many periods passed as there were ticks and skipped ones: nothing drifts.
    assert abs((ticks[59] - ticks[0]) * 1e-9 / period - (59 + thread.skipped)) < 3
    # One tick may follow a late one soon, as on a busy machine; several in a row make up for it.
    short = [way < 0.2e9 * period for way in ways]
    assert sum(a and b for a, b in itertools.pairwise(short)) <= 3
    assert 0.0 < thread.jitter < 25 * period
    assert "periodic" not in {each.name for each in threading.enumerate()}
