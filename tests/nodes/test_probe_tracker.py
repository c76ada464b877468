"""The tracker's poses in, the probe's poses out; what is no pose is refused and counted."""

import math

import pytest
from bench import pose_at
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rclpy.parameter import Parameter
from visualization_msgs.msg import Marker, MarkerArray

from us_sim.nodes.probe_tracker import ProbeTracker
from us_sim.nodes.scene_node import NO_SENDER
from us_sim.settings.registry import PROBES


@pytest.fixture
def tracker(bench, small_scene):
    node = bench.make(ProbeTracker, scene=str(small_scene), lockstep=True)
    poses = bench.collect(PoseStamped, "probe/pose")
    publisher = bench.publisher(PoseStamped, "tracker/pose")
    return node, poses, publisher


def test_a_pose_is_forwarded_with_its_stamp_and_unit_quaternion(bench, tracker):
    _, poses, publisher = tracker
    publisher.publish(pose_at(0.01, 7, w=2.0))
    bench.spin_until(lambda: poses)
    assert poses[0].header.stamp.sec == 7
    assert poses[0].header.frame_id == "patient"
    assert poses[0].pose.position.z == 0.01
    assert poses[0].pose.orientation.w == 1.0


@pytest.mark.parametrize(
    ("bad", "kind"),
    [
        (pose_at(math.nan, 8), "pose"),
        (pose_at(0.0, 8, w=0.0), "pose"),
        (pose_at(0.0, 8, frame="moon"), "frame"),
        (pose_at(0.0, 7), "order"),
    ],
)
def test_what_is_no_pose_is_refused_counted_and_survived(bench, tracker, bad, kind):
    node, poses, publisher = tracker
    publisher.publish(pose_at(0.001, 7))
    publisher.publish(bad)
    publisher.publish(pose_at(0.002, 9))
    bench.spin_until(lambda: len(poses) == 2)
    assert [p.pose.position.z for p in poses] == [0.001, 0.002]
    assert node.health.problems[kind] == 1


def test_a_quaternion_that_is_not_of_unit_length_is_taken_and_said(bench, tracker):
    node, poses, publisher = tracker
    publisher.publish(pose_at(0.001, 7, w=1.004))
    publisher.publish(pose_at(0.001, 8, w=3.0))
    bench.spin_until(lambda: len(poses) == 2)
    assert poses[1].pose.orientation.w == 1.0
    assert node.health.problems["quaternion"] == 1


def test_a_source_that_starts_again_is_followed(bench, tracker):
    _, poses, publisher = tracker
    publisher.publish(pose_at(0.001, 100))
    publisher.publish(pose_at(0.002, 5))
    bench.spin_until(lambda: len(poses) == 2)
    assert poses[1].header.stamp.sec == 5


def test_an_unstamped_pose_gets_its_time_of_arrival(bench, tracker):
    node, poses, publisher = tracker
    publisher.publish(pose_at(0.001, 0))
    bench.spin_until(lambda: poses)
    now = node.get_clock().now().nanoseconds * 1e-9
    assert abs(now - poses[0].header.stamp.sec) < 60
    assert node.health.problems["stamp"] == 1


def test_the_filter_and_its_settings_may_change_while_poses_come(bench, tracker):
    node, poses, publisher = tracker
    bench.spin_until(lambda: bench.peer.count_publishers("probe/pose") > 0)

    def step(second: int, z: float) -> float:
        count = len(poses)
        publisher.publish(pose_at(z, second))
        bench.spin_until(lambda: len(poses) > count)
        return poses[-1].pose.position.z

    def put(**values: object) -> bool:
        given = [Parameter(name.replace("__", "."), value=v) for name, v in values.items()]
        return node.set_parameters_atomically(given).successful

    assert (step(1, 0.0), step(2, 0.001)) == (0.0, 0.001)  # as it is measured
    assert put(filter="one_euro", one_euro__speed_coefficient=0.0, one_euro__minimum_cutoff=0.001)
    assert step(3, 0.001) == 0.001  # the first that this filter gets
    # A low pass of 1 mHz with samples 1 s apart: 1 - 1 / (1 + 2 π · 0.001).
    assert step(4, 0.002) == pytest.approx(0.001 + 0.001 * 0.0062439, rel=1e-3)
    refused = node.set_parameters([Parameter("kalman.acceleration", value=-1.0)])[0]
    assert not refused.successful
    assert put(filter="none")
    assert step(5, 0.003) == 0.003


def test_the_transducer_is_there_for_who_comes_later(bench, tracker):
    markers = bench.collect(MarkerArray, "probe/marker", latched=True)
    bench.spin_until(lambda: markers)
    assert {marker.header.frame_id for marker in markers[0].markers} == {"probe"}
    *parts, outline = markers[0].markers
    assert [part.ns for part in parts] == ["face", "housing", "cable", "notch"]
    assert outline.type == Marker.LINE_STRIP
    image = tracker[0].scene.probe.array.resolve_settings(PROBES)
    width = max(point.x for point in outline.points) - min(point.x for point in outline.points)
    assert width == pytest.approx(image.aperture)
    assert max(point.z for point in outline.points) == pytest.approx(image.depth)
    assert max(point.z for part in parts for point in part.points) == pytest.approx(0.0, abs=1e-9)


def test_closing_the_last_page_is_no_fault_of_a_tracker(bench, small_scene):
    tracker = bench.make(ProbeTracker, scene=str(small_scene))
    viewer = bench.add(Node("viewer", context=bench.context))
    hand = viewer.create_publisher(PoseStamped, "tracker/pose", 10)
    bench.spin_until(lambda: hand.get_subscription_count() > 0)
    now = tracker.get_clock().now().to_msg()
    hand.publish(pose_at(0.001, now.sec))
    bench.spin_until(lambda: tracker.health.state == "lost")
    assert tracker.health.fault == "the probe is lost"  # it publishes, but nothing comes
    hand.publish(pose_at(0.001, now.sec + 1))
    bench.spin_until(lambda: tracker.health.state == "tracked")
    viewer.destroy_publisher(hand)
    bench.spin_until(lambda: tracker.health.state == "lost")
    assert tracker.health.warning.startswith("no page moves the probe")


def test_the_end_of_what_plays_a_path_is_no_fault_of_a_tracker(bench, small_scene):
    node = bench.make(ProbeTracker, scene=str(small_scene))
    publisher = bench.publisher(PoseStamped, "tracker/pose")
    publisher.publish(pose_at(0.001, node.get_clock().now().to_msg().sec))
    bench.spin_until(lambda: node.health.state == "tracked")
    bench.peer.destroy_publisher(publisher)
    bench.spin_until(lambda: node.health.state == "lost")
    assert node.health.warning == NO_SENDER
