"""The annotated image: drawn for those who subscribe, frozen and marked when no pose comes."""

import time

import numpy as np
import pytest
from bench import pose_at
from builtin_interfaces.msg import Time as TimeMessage
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image

from us_sim.nodes.annotated_image import AnnotatedImage
from us_sim.nodes.scene_node import SceneNode
from us_sim.scene.building import probe_of

TOPIC = "ultrasound/image_annotated"
LABELS = {5: "artery", 6: "vein"}
AMBER, RED, GREY = [255, 176, 0], [235, 45, 45], [150, 150, 150]
SCENE = """
name: bare
volume: {phantom: upper_arm, voxel_size: 1 mm}
probe: {aperture: 40 mm, depth: 40 mm, image: [160, 120],
        collider: {shape: sphere, radius: 2 cm}}
tissue:
  mesh: {lower: [-0.03, -0.03, 0], upper: [0.03, 0.03, 0.05], nodes: [3, 3, 3]}
  materials: {vein: {young_modulus: 1 kPa}, artery: {young_modulus: 1 kPa}}
structures: [vein, artery]
"""


class Show(SceneNode):
    """A node with nothing but an annotated image."""

    def __init__(self, **kwargs):
        super().__init__("show", **kwargs)
        self.annotated = AnnotatedImage(self, probe_of(self.scene), LABELS)

    def stamp(self, age=0.0):
        """Of a pose that is so many seconds old."""
        now = self.get_clock().now().nanoseconds - round(1e9 * age)
        return TimeMessage(sec=now // 10**9, nanosec=now % 10**9)


@pytest.fixture
def show(bench, tmp_path):
    file = tmp_path / "bare.yaml"
    file.write_text(SCENE)

    def make(**parameters):
        return bench.make(Show, scene=str(file), **parameters)

    return make


def subscribed(bench, node):
    pictures = bench.collect(Image, TOPIC)
    bench.spin_until(lambda: node.annotated.is_wanted)
    return pictures


def picture(message):
    return np.frombuffer(message.data, np.uint8).reshape(message.height, message.width, 3)


def frame(message):
    return picture(message)[60, 0].tolist()


GREY_IMAGE = np.full((120, 160), 90, np.uint8)


def test_a_fresh_image_is_sent_with_its_stamp_and_outlines(bench, show):
    node = show(stale_after=30.0, lost_after=60.0)
    pictures = subscribed(bench, node)
    stamp = node.stamp()
    labels = np.zeros((120, 160), np.uint8)
    labels[40:80, 40:100] = 6
    node.annotated.pose_came(stamp)
    node.annotated.show(GREY_IMAGE, stamp, lambda: labels)
    bench.spin_until(lambda: any(message.header.stamp.sec for message in pictures))
    message = pictures[-1]
    assert (message.encoding, message.step) == ("rgb8", 480)
    assert message.header.frame_id == "probe"
    assert message.header.stamp == stamp
    image = picture(message)
    assert image[60, 70].tolist() == [90, 90, 90]
    red, _, blue = image[60, 39].astype(int)  # on the vein's border
    assert blue > red + 50
    assert node.annotated.state == "live"


def test_nothing_is_drawn_and_no_label_is_cut_for_nobody(bench, show):
    node = show()
    node.annotated.pose_came(node.stamp())
    called = []
    node.annotated.show(GREY_IMAGE, node.stamp(), lambda: called.append(1) or GREY_IMAGE)
    bench.spin_for(40)
    assert not called


def test_before_the_first_pose_a_black_picture_says_so(bench, show):
    node = show()
    assert node.annotated.state == "waiting"
    pictures = subscribed(bench, node)
    bench.spin_until(lambda: pictures)
    assert frame(pictures[0]) == GREY
    assert pictures[0].header.stamp == TimeMessage()
    assert picture(pictures[0])[60, 80].tolist() == [0, 0, 0]


def test_without_new_poses_the_last_image_is_frozen_marked_and_keeps_its_stamp(bench, show):
    node = show(stale_after=0.3, lost_after=0.8)
    pictures = subscribed(bench, node)
    stamp = node.stamp()
    node.annotated.pose_came(stamp)
    node.annotated.show(GREY_IMAGE, stamp)
    bench.spin_until(lambda: pictures and frame(pictures[-1]) == AMBER)
    assert node.annotated.state == "stale"
    bench.spin_until(lambda: frame(pictures[-1]) == RED)
    assert node.annotated.state == "lost"
    marked = [message for message in pictures if frame(message) in (AMBER, RED)]
    assert all(message.header.stamp == stamp for message in marked)
    assert all((picture(message)[60, 20:100] == 90).all() for message in marked)
    fresh = node.stamp()
    node.annotated.pose_came(fresh)
    node.annotated.show(GREY_IMAGE, fresh)
    bench.spin_until(lambda: pictures[-1].header.stamp == fresh)
    assert frame(pictures[-1]) == [90, 90, 90]
    assert node.annotated.state == "live"


def test_diagnostics_say_once_that_poses_stay_away_and_that_they_are_back(bench, show):
    node = show(stale_after=1.0, lost_after=1.5)  # looked at five times a second
    bench.spin_until(lambda: node.health.values.get("probe_pose") == "waiting")
    assert node.health.problems("pose age") == 0
    for times in (1, 2):
        node.annotated.pose_came(node.stamp())
        bench.spin_until(lambda: node.health.values["probe_pose"] == "live")
        bench.spin_until(lambda: node.health.values["probe_pose"] == "lost")
        assert node.health.problems("pose age") == times


def test_diagnostics_warn_for_as_long_as_poses_stay_away(bench, show):
    node = show(stale_after=1.0, lost_after=60.0)
    reports = bench.collect(DiagnosticArray, "diagnostics")
    node.annotated.pose_came(node.stamp())
    warned = DiagnosticStatus.WARN, "the probe's pose is stale: the image is frozen"
    bench.spin_until(lambda: (reports and words(reports[-1])) == warned)
    count = len(reports)
    bench.spin_until(lambda: len(reports) == count + 2)
    assert words(reports[-1]) == warned
    node.annotated.pose_came(node.stamp())
    bench.spin_until(lambda: node.health.values["probe_pose"] == "live")
    assert node.health.warning == ""


def words(report):
    return report.status[0].level, report.status[0].message


@pytest.mark.parametrize("age", [95_332_936.7, -3600.0])  # a path of years ago, a clock ahead
def test_poses_of_another_clock_are_live_when_they_come_and_missed_when_they_do_not(
    bench, show, age
):
    node = show(stale_after=0.5, lost_after=60.0)
    pictures = subscribed(bench, node)
    stamp = node.stamp(age)
    node.annotated.pose_came(stamp)
    node.annotated.show(GREY_IMAGE, stamp)
    assert node.annotated.state == "live"
    bench.spin_until(lambda: pictures and pictures[-1].header.stamp == stamp)
    assert frame(next(p for p in pictures if p.header.stamp == stamp)) == [90, 90, 90]
    bench.spin_until(lambda: pictures and frame(pictures[-1]) == AMBER)


def test_setting_the_clock_makes_no_pose_old(show):
    node = show(stale_after=10.0)
    for simulated in (True, False):  # to 1970, and back to the present
        node.annotated.pose_came(node.stamp())
        assert node.set_parameters([Parameter("use_sim_time", value=simulated)])[0].successful
        assert node.annotated.state == "live"


def test_an_image_that_lags_behind_live_poses_is_marked(bench, show):
    node = show(stale_after=0.5, lost_after=60.0)
    pictures = subscribed(bench, node)
    first = node.stamp()
    node.annotated.pose_came(first)
    node.annotated.show(GREY_IMAGE, first)

    def is_marked():
        node.annotated.pose_came(node.stamp())
        return pictures and frame(pictures[-1]) == AMBER

    bench.spin_until(is_marked)
    assert pictures[-1].header.stamp == first
    assert node.annotated.state == "live"


def test_the_limits_change_while_running(show):
    node = show(stale_after=30.0)
    node.annotated.pose_came(node.stamp())
    assert node.annotated.state == "live"
    assert node.set_parameters([Parameter("stale_after", value=0.01)])[0].successful
    time.sleep(0.02)
    assert node.annotated.state == "stale"
    assert node.set_parameters([Parameter("lost_after", value=0.01)])[0].successful
    assert node.annotated.state == "lost"
    assert not node.set_parameters([Parameter("lost_after", value=-1.0)])[0].successful


def test_in_lockstep_nothing_ages(bench, show):
    node = show(lockstep=True)
    pictures = subscribed(bench, node)
    bench.spin_for(40)
    assert not pictures
    for second in (1, 2):  # 1970
        stamp = pose_at(0.0, second).header.stamp
        node.annotated.pose_came(stamp)
        node.annotated.show(GREY_IMAGE, stamp)
    bench.spin_until(lambda: len(pictures) == 2)
    bench.spin_for(40)
    assert [message.header.stamp.sec for message in pictures] == [1, 2]
    assert frame(pictures[1]) == [90, 90, 90]
    assert node.annotated.state == "live"
