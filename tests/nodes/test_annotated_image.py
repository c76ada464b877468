"""The annotated image: drawn for those who subscribe, frozen and marked when no pose comes."""

from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np
import pytest
from bench import pose_at
from builtin_interfaces.msg import Time as TimeMessage
from rclpy.parameter import Parameter
from sensor_msgs.msg import Image

from us_sim.errors import MeshError, SettingsError
from us_sim.nodes.scene_node import SceneNode
from us_sim.nodes.streams.annotated_image import AnnotatedImage
from us_sim.scene.building import build_probe
from us_sim.slicing.cutting.resampling import LocatedPixels
from us_sim.slicing.drawing.overlay import ColourScale, Overlay
from us_sim.volume.volume import Volume

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


@dataclass
class Shown:
    """The part of a frame that an annotated image uses."""

    pixels: np.ndarray
    labels: np.ndarray | None = None

    @property
    def volume(self):
        layer = self.labels[..., None]
        return Volume(layer, np.eye(4), layer, {})

    @property
    def placed(self):
        pixels = np.array([[[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]]])
        return LocatedPixels(np.zeros(self.labels.shape, np.int32), pixels, np.empty(0, np.intp))


class Asked:
    """A frame that cannot be shown, and knows what it was asked for."""

    called: ClassVar[list[str]] = []

    @property
    def pixels(self):
        self.called.append("pixels")
        raise MeshError("no slice can be cut")

    labels = pixels


class Reds:
    topic = "ultrasound/strain"
    is_wanted = False

    def overlay(self, frame):
        values = np.full(frame.pixels.shape, np.nan)
        values[:, 80:] = 1.0
        return Overlay(values, ColourScale("all", 0.0, 1.0, "", colours=((0, 0, 0), (255, 0, 0))))


class Broken(Reds):
    """Colours that cannot be made."""

    def overlay(self, _):
        raise MeshError("there is no tissue")


class Show(SceneNode):
    """A node with nothing but an annotated image."""

    def __init__(self, streams=(), **kwargs):
        super().__init__("show", **kwargs)
        self.annotated = AnnotatedImage(self, build_probe(self.scene), LABELS, streams)

    def stamp(self, age=0.0):
        now = self.get_clock().now().nanoseconds - round(1e9 * age)
        return TimeMessage(sec=now // 10**9, nanosec=now % 10**9)


@pytest.fixture
def show(bench, tmp_path):
    file = tmp_path / "bare.yaml"
    file.write_text(SCENE)

    def make(streams=(), **parameters):
        return bench.make(partial(Show, streams), scene=str(file), **parameters)

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
    node.annotated.on_usable_pose()
    node.annotated.publish_frame(Shown(GREY_IMAGE, labels), stamp)
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
    node.annotated.on_usable_pose()
    node.annotated.publish_frame(Asked(), node.stamp())
    bench.spin_for(40)
    assert not Asked.called


def test_colours_are_laid_over_the_image_and_others_are_refused(bench, show):
    node = show(lockstep=True, streams=[Reds()])
    pictures = subscribed(bench, node)
    assert node.set_parameters([Parameter("overlay", value="strain")])[0].successful
    node.annotated.publish_frame(Shown(GREY_IMAGE), node.stamp())
    assert node.set_parameters([Parameter("overlay", value="none")])[0].successful
    node.annotated.publish_frame(Shown(GREY_IMAGE), node.stamp())
    bench.spin_until(lambda: len(pictures) == 2)
    assert picture(pictures[0])[90, 100].tolist() == [172, 45, 45]
    assert picture(pictures[0])[90, 20].tolist() == [90, 90, 90]
    assert picture(pictures[1])[90, 100].tolist() == [90, 90, 90]


def test_flipped_and_beside_the_plain_image_while_it_runs(bench, show):
    node = show(lockstep=True, streams=[Reds()], overlay="strain")
    pictures = subscribed(bench, node)
    plain = np.tile(np.arange(160, dtype=np.uint8), (120, 1))
    for name in ("flip", "beside"):
        assert node.set_parameters([Parameter(name, value=True)])[0].successful
        node.annotated.publish_frame(Shown(plain), node.stamp())
    bench.spin_until(lambda: len(pictures) == 2)
    flipped, both = map(picture, pictures)
    assert flipped[60, 159 - 60].tolist() == [60, 60, 60]
    assert flipped[90, 159 - 100, 0] > 150  # red
    np.testing.assert_array_equal(both[:, 160:], flipped)
    np.testing.assert_array_equal(both[:, :160, 1], plain[:, ::-1])


def test_colours_that_the_scene_cannot_provide_are_refused(show):
    node = show()
    result = node.set_parameters([Parameter("overlay", value="strain")])[0]
    assert not result.successful
    assert "bare has nothing for 'strain'; it has none" in result.reason
    with pytest.raises(SettingsError, match="bare has nothing for 'strain'"):
        show(overlay="strain")


def test_colours_that_cannot_be_made_are_said_and_the_image_is_shown(bench, show):
    node = show(lockstep=True, streams=[Broken()], overlay="strain")
    pictures = subscribed(bench, node)
    node.annotated.publish_frame(Shown(GREY_IMAGE), node.stamp())
    bench.spin_until(lambda: pictures)
    assert node.health.problems["overlay"] == 1
    assert picture(pictures[0])[90, 100].tolist() == [90, 90, 90]


def test_without_new_poses_the_last_image_is_frozen_marked_and_keeps_its_stamp(bench, show):
    node = show(stale_after=0.3, lost_after=0.8)
    pictures = subscribed(bench, node)
    stamp = node.stamp()
    node.annotated.on_usable_pose()
    node.annotated.publish_frame(Shown(GREY_IMAGE), stamp)
    bench.spin_until(lambda: pictures and frame(pictures[-1]) == AMBER)
    assert node.annotated.state == "stale"
    bench.spin_until(lambda: frame(pictures[-1]) == RED)
    assert node.annotated.state == "lost"
    marked = [message for message in pictures if frame(message) in (AMBER, RED)]
    assert all(message.header.stamp == stamp for message in marked)
    assert all((picture(message)[60, 20:100] == 90).all() for message in marked)
    fresh = node.stamp()
    node.annotated.on_usable_pose()
    node.annotated.publish_frame(Shown(GREY_IMAGE), fresh)
    bench.spin_until(lambda: pictures[-1].header.stamp == fresh)
    assert frame(pictures[-1]) == [90, 90, 90]
    assert node.annotated.state == "live"


def test_diagnostics_say_once_that_poses_stay_away_and_that_they_are_back(bench, show):
    node = show(stale_after=1.0, lost_after=1.5)  # looked at five times a second
    bench.spin_until(lambda: node.health.values.get("probe_pose") == "waiting")
    assert node.health.problems["pose age"] == 0
    for times in (1, 2):
        node.annotated.on_usable_pose()
        bench.spin_until(lambda: node.health.values["probe_pose"] == "live")
        bench.spin_until(lambda: node.health.values["probe_pose"] == "lost")
        assert node.health.problems["pose age"] == times


@pytest.mark.parametrize("age", [95_332_936.7, -3600.0])  # a path of years ago, a clock ahead
def test_poses_of_another_clock_are_live_when_they_come_and_missed_when_they_do_not(
    bench, show, age
):
    node = show(stale_after=0.5, lost_after=60.0)
    pictures = subscribed(bench, node)
    stamp = node.stamp(age)
    node.annotated.on_usable_pose()
    node.annotated.publish_frame(Shown(GREY_IMAGE), stamp)
    assert node.annotated.state == "live"
    bench.spin_until(lambda: pictures and pictures[-1].header.stamp == stamp)
    assert frame(next(p for p in pictures if p.header.stamp == stamp)) == [90, 90, 90]
    bench.spin_until(lambda: pictures and frame(pictures[-1]) == AMBER)


def test_setting_the_clock_makes_no_pose_old(show):
    node = show(stale_after=10.0)
    for simulated in (True, False):  # to 1970, and back to the present
        node.annotated.on_usable_pose()
        assert node.set_parameters([Parameter("use_sim_time", value=simulated)])[0].successful
        assert node.annotated.state == "live"


def test_an_image_that_lags_behind_live_poses_is_marked(bench, show):
    node = show(stale_after=0.5, lost_after=60.0)
    pictures = subscribed(bench, node)
    first = node.stamp()
    node.annotated.on_usable_pose()
    node.annotated.publish_frame(Shown(GREY_IMAGE), first)

    def is_marked():
        node.annotated.on_usable_pose()
        return pictures and frame(pictures[-1]) == AMBER

    bench.spin_until(is_marked)
    assert pictures[-1].header.stamp == first
    assert node.annotated.state == "live"


def test_the_limits_change_while_running(bench, show):
    node = show(stale_after=30.0)
    node.annotated.on_usable_pose()
    assert node.annotated.state == "live"
    assert node.set_parameters([Parameter("stale_after", value=0.01)])[0].successful
    bench.spin_until(lambda: node.annotated.state == "stale")
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
        node.annotated.on_usable_pose()
        node.annotated.publish_frame(Shown(GREY_IMAGE), stamp)
    bench.spin_until(lambda: len(pictures) == 2)
    bench.spin_for(40)
    assert [message.header.stamp.sec for message in pictures] == [1, 2]
    assert frame(pictures[1]) == [90, 90, 90]
    assert node.annotated.state == "live"
