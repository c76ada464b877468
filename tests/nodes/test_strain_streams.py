"""Strain on topics: what the domain computes, for those who subscribe, as parameters ask."""

import numpy as np
import pytest
from bench import pose_at
from geometry_msgs.msg import PoseStamped
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import Int32MultiArray

from us_sim.nodes.messages import cloud_message, tetrahedra_message
from us_sim.nodes.slice_interpolator import SliceInterpolator
from us_sim.recording.decoding import field_from, pose_from
from us_sim.scene.building import build_scanner, build_tissue_model, load_volume
from us_sim.scene.reading import load_scene
from us_sim.slicing.settings import StrainSettings
from us_sim.slicing.strain import AxialStrain
from us_sim.slicing.strain_estimate import estimate_strain

KEPT = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Pressed:
    """A slicing node with tissue, and frames of the same made without any ROS."""

    def __init__(self, bench, scene, **parameters):
        self.node = bench.make(SliceInterpolator, scene=str(scene), lockstep=True, **parameters)
        self.bench = bench
        loaded = load_scene(scene)
        volume = load_volume(loaded)
        self.rest = build_tissue_model(loaded, volume).mesh.nodes.astype(np.float32).astype(float)
        tetrahedra = build_tissue_model(loaded, volume).mesh.tetrahedra
        self.scanner = build_scanner(loaded, volume)
        self.scanner.attach_mesh(self.rest, tetrahedra)
        self._latched = [
            bench.peer.create_publisher(PointCloud2, "tissue/rest", KEPT),
            bench.peer.create_publisher(Int32MultiArray, "tissue/tetrahedra", KEPT),
        ]
        self._latched[0].publish(self._cloud(self.rest, pose_at(0.0, 1)))
        self._latched[1].publish(tetrahedra_message(tetrahedra))
        self._poses = bench.publisher(PoseStamped, "probe/pose")
        self._nodes = bench.publisher(PointCloud2, "tissue/nodes")

    def press(self, second):
        """By so many millimetres over 50 mm, on the floor; the frame that should be seen."""
        nodes = self.nodes_at(second)
        self._poses.publish(pose_at(1e-3 * second, second))
        self._nodes.publish(self._cloud(nodes, pose_at(0.0, second)))
        return self.frame(second)

    def nodes_at(self, second):
        nodes = self.rest * [1, 1, 1 - 0.02 * second] + [0, 0, 1e-3 * second]
        return nodes.astype(np.float32).astype(float)

    def frame(self, second):
        pose = pose_from(pose_at(1e-3 * second, second))
        return self.scanner.make_frame(pose, self.nodes_at(second))

    def _cloud(self, points, pose):
        return cloud_message(dict(zip("xyz", points.T, strict=True)), pose.header.stamp, "patient")


@pytest.fixture
def pressed(bench, small_scene):
    return lambda **parameters: Pressed(bench, small_scene, **parameters)


def test_strain_since_rest_and_since_an_image_before(bench, pressed):
    node = pressed(**{"strain.interval": 2})
    images = bench.collect(Image, "ultrasound/strain")
    bench.spin_until(lambda: bench.peer.count_publishers("ultrasound/strain") > 0)
    strain = AxialStrain.from_frame(node.press(1))
    bench.spin_until(lambda: len(images) == 1)
    assert (images[0].encoding, images[0].header.frame_id) == ("32FC1", "probe")
    assert images[0].header.stamp.sec == 1
    np.testing.assert_array_equal(field_from(images[0]), strain.compute_strain(node.frame(1)))
    assert np.nanmedian(field_from(images[0])) == pytest.approx(-0.02, abs=1e-4)
    result = node.node.set_parameters([Parameter("strain.since", value="image")])[0]
    assert result.successful
    node.press(2)  # nothing is known of two images before
    node.press(3)
    bench.spin_until(lambda: len(images) == 2)
    assert images[1].header.stamp.sec == 3
    expected = strain.compute_strain(node.frame(3), node.nodes_at(1))
    np.testing.assert_array_equal(field_from(images[1]), expected)
    assert np.nanmedian(expected) == pytest.approx(0.94 / 0.98 - 1, abs=1e-4)


def test_the_estimate_is_made_of_two_images_and_only_for_its_subscribers(bench, pressed):
    node = pressed(**{"strain.interval": 1, "strain.window": 0.006, "strain.search": 0.002})
    estimates = bench.collect(Image, "ultrasound/strain_estimate")
    bench.spin_until(lambda: bench.peer.count_publishers("ultrasound/strain_estimate") > 0)
    first, second = (node.press(number).pixels for number in (1, 2))
    bench.spin_until(lambda: estimates)
    assert len(estimates) == 1
    settings = StrainSettings(interval=1, window=0.006, search=0.002)
    expected = estimate_strain(first, second, node.scanner.probe, settings).strain
    np.testing.assert_array_equal(field_from(estimates[0]), expected)
    assert np.isfinite(expected).mean() > 0.5
    assert set(node.node.health._published) == {"ultrasound/strain_estimate"}


def test_a_window_that_the_image_does_not_hold_is_refused(pressed):
    result = pressed().node.set_parameters([Parameter("strain.window", value=0.021)])[0]
    assert not result.successful
    assert "21 mm" in result.reason


def test_without_tissue_there_is_no_strain(bench, tmp_path):
    file = tmp_path / "bare.yaml"
    probe = "{aperture: 40 mm, depth: 40 mm, image: [60, 50]}"
    file.write_text(
        f"name: bare\nvolume: {{phantom: upper_arm, voxel_size: 1 mm}}\nprobe: {probe}\n"
    )
    node = bench.make(SliceInterpolator, scene=str(file), lockstep=True)
    bench.spin_until(lambda: bench.peer.count_publishers("ultrasound/image") > 0)
    topics = {name.lstrip("/") for name, _ in bench.peer.get_topic_names_and_types()}
    assert not topics & {"ultrasound/strain", "ultrasound/strain_estimate"}
    assert not node.has_parameter("strain.since")
    result = node.set_parameters([Parameter("overlay", value="strain")])[0]
    assert "'strain'" in result.reason
