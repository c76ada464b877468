"""The tracker's poses in, the probe's poses out; what is no pose is refused and counted."""

import math

import pytest
from bench import pose_at
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from tf2_msgs.msg import TFMessage

from us_sim.nodes.probe_tracker import ProbeTracker


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
        (pose_at(math.inf, 8), "pose"),
        (pose_at(0.0, 8, w=0.0), "pose"),
        (pose_at(0.0, 8, w=math.nan), "pose"),
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
    assert node.health.problems(kind) == 1


def test_a_quaternion_that_is_not_of_unit_length_is_taken_and_said(bench, tracker):
    node, poses, publisher = tracker
    publisher.publish(pose_at(0.001, 7, w=1.004))
    publisher.publish(pose_at(0.001, 8, w=3.0))
    bench.spin_until(lambda: len(poses) == 2)
    assert poses[1].pose.orientation.w == 1.0
    assert node.health.problems("quaternion") == 1


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
    assert node.health.problems("stamp") == 1


def test_the_transform_is_sent_to_who_asks(bench, tracker):
    _, _, publisher = tracker
    transforms = bench.collect(TFMessage, "tf")
    bench.spin_until(lambda: bench.peer.count_publishers("tf") > 0)
    second = 10
    while not transforms:
        publisher.publish(pose_at(0.003, second))
        second += 1
        bench.spin_for(5)
        assert second < 200
    transform = transforms[0].transforms[0]
    assert (transform.header.frame_id, transform.child_frame_id) == ("patient", "probe")
    assert transform.transform.translation.z == 0.003


def test_diagnostics_say_what_was_refused(bench, tracker):
    node, _, publisher = tracker
    reports = bench.collect(DiagnosticArray, "diagnostics")
    publisher.publish(pose_at(math.nan, 8))
    publisher.publish(pose_at(0.002, 9))
    bench.spin_until(
        lambda: any(
            item.key == "rejected pose" and item.value == "1"
            for report in reports
            for item in report.status[0].values
        )
    )
    assert reports[0].status[0].name == node.get_fully_qualified_name()
