"""The reconstructing node: images at poses of the same stamps, saved and cleared by services."""

import time

import numpy as np
import pytest
from bench import pose_at
from geometry_msgs.msg import PoseStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

from us_sim.errors import VolumeError
from us_sim.nodes.messages import affine_message, image_message
from us_sim.nodes.volume_reconstructor import VolumeReconstructor
from us_sim.volume.files.readers import read_volume

BOX = {"lower": [0.0, 0.0, 0.0], "upper": [0.009, 0.005, 0.007], "spacing": 1e-3}
BLOCK = np.random.Generator(np.random.PCG64(8)).integers(1, 255, (6, 8, 10), dtype=np.uint8)


@pytest.fixture
def node(bench, tmp_path):
    pixels = {"pixel_size": [1e-3, 1e-3]}
    file = str(tmp_path / "volume.nrrd")
    return bench.make(VolumeReconstructor, file=file, **pixels, **BOX)


@pytest.fixture
def scanner(bench, node):  # noqa: ARG001 - publishers look for it
    """Sends the pose of a slice, and its image."""
    poses = bench.publisher(PoseStamped, "probe/pose")
    images = bench.publisher(Image, "ultrasound/image")

    def send(k, *, image_first=False, stamp=None):
        pose = pose_at(0.0, k + 1)
        pose.pose.position.y = 1e-3 * k
        image = image_message(BLOCK[k], pose_at(0.0, stamp or k + 1).header.stamp, "probe")
        sent = [(poses, pose), (images, image)]
        for publisher, message in reversed(sent) if image_first else sent:
            publisher.publish(message)

    return send


def call(bench, service):
    client = bench.peer.create_client(Trigger, f"volume_reconstructor/{service}")
    bench.spin_until(client.service_is_ready)
    future = client.call_async(Trigger.Request())
    bench.spin_until(future.done)
    return future.result()


def test_what_is_saved_is_what_was_scanned(bench, node, scanner, tmp_path):
    for k in range(6):
        scanner(k, image_first=k % 2 == 1)
    bench.spin_until(lambda: node.frames == 6)
    answer = call(bench, "save")
    assert answer.success, answer.message
    assert answer.message == f"{tmp_path / 'volume.nrrd'}: 10 × 6 × 8 voxels from 6 images"
    volume = read_volume(tmp_path / "volume.nrrd")
    np.testing.assert_array_equal(volume.intensities, BLOCK.transpose(2, 0, 1))
    np.testing.assert_allclose(volume.index_to_patient, np.diag([1e-3, 1e-3, 1e-3, 1.0]))
    assert call(bench, "save").message.startswith(f"{tmp_path / 'volume_1.nrrd'}: ")


def test_an_image_without_its_pose_is_not_inserted(bench, node, scanner):
    scanner(0, stamp=77)
    scanner(1)
    bench.spin_until(lambda: node.frames == 1)
    bench.spin_for(5)
    assert node.frames == 1


def test_after_clear_there_is_nothing_to_save(bench, node, scanner, tmp_path):
    scanner(2)
    bench.spin_until(lambda: node.frames == 1)
    answer = call(bench, "clear")
    assert (answer.success, answer.message) == (True, "1 images are forgotten")
    answer = call(bench, "save")
    assert not answer.success
    assert "nothing of the 0 images lies in the box" in answer.message
    assert not list(tmp_path.iterdir())


def test_where_pixels_lie_may_be_told_by_the_scanner(bench, node, scanner, tmp_path):
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    matrix = np.zeros((4, 4))
    matrix[0, 0] = matrix[1, 2] = matrix[2, 1] = 1e-3
    matrix[3, 3], matrix[0, 3] = 1.0, 4e-3
    places = bench.peer.create_publisher(Float64MultiArray, "ultrasound/image_to_probe", latched)
    places.publish(affine_message(matrix))
    bench.spin_until(lambda: places.get_subscription_count() > 0)
    bench.spin_for(10)
    scanner(0)
    bench.spin_until(lambda: node.frames == 1)
    assert call(bench, "save").success
    volume = read_volume(tmp_path / "volume.nrrd")
    np.testing.assert_array_equal(volume.intensities[4:, 0, :], BLOCK[0].T[:6])


def test_images_and_poses_that_cannot_be_used_are_refused(bench, node, scanner):
    images = bench.publisher(Image, "ultrasound/image")
    wrong = image_message(BLOCK[0], pose_at(0.0, 1).header.stamp, "probe")
    wrong.encoding = "rgb8"
    images.publish(wrong)
    bench.publisher(PoseStamped, "probe/pose").publish(pose_at(0.0, 1, frame="map"))
    bench.spin_until(lambda: node.health.problems("volume") + node.health.problems("message") == 2)
    scanner(3)
    bench.spin_until(lambda: node.frames == 1)


@pytest.mark.parametrize(
    ("given", "fact"),
    [
        ({"file": "volume.txt"}, r"volume\.txt"),
        ({"upper": [0.0, 1.0, 1.0]}, "`lower`"),
        ({"spacing": 1e-5, "upper": [0.1, 0.1, 0.1]}, "--spacing"),
    ],
)
def test_a_box_that_cannot_be_is_refused_at_the_start(bench, tmp_path, given, fact):
    with pytest.raises(VolumeError, match=fact):
        bench.make(VolumeReconstructor, **{"file": str(tmp_path / "v.nrrd"), **BOX, **given})


def test_sixty_images_a_second_are_inserted(bench, tmp_path):
    node = bench.make(VolumeReconstructor, file=str(tmp_path / "v.nrrd"))
    image = np.full((512, 512), 90, np.uint8)
    messages = [pose_at(0.0, k + 1) for k in range(61)]
    images = [image_message(image, pose.header.stamp, "probe") for pose in messages]
    node._take_pose(messages[0])
    node._take_image(images[0])  # compiles
    begun = time.process_time()
    for k in range(1, 61):
        node._take_pose(messages[k])
        node._take_image(images[k])
    assert node.frames == 61
    assert time.process_time() - begun < 1.0
