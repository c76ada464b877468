"""Every source that a scene may name moves the probe, and bad input of it is said and survived."""

import math
import struct
import zlib

import numpy as np
import pytest
from bench import pose_at
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseArray, PoseStamped, TransformStamped, Twist
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Joy

from us_sim.errors import SceneError, TrackingError, UsSimError
from us_sim.geometry.pose import Pose
from us_sim.nodes.messages import TFMessage
from us_sim.nodes.probe_tracker import ProbeTracker
from us_sim.tracking.camera.encodings import decompress_image
from us_sim.tracking.camera.model import CameraModel
from us_sim.tracking.camera.rendered_views import SHARP, RenderedView
from us_sim.tracking.camera.rigid_body import RigidBody

BARE = """
name: bare
volume: {phantom: upper_arm, voxel_size: 1 mm}
probe: {aperture: 40 mm, depth: 40 mm, image: [60, 50]}
tracker: """


@pytest.fixture
def tracker(bench, tmp_path):
    """Makes a tracker node of a scene with that `tracker:`; with it what collects its poses."""

    def make(section, **parameters):
        file = tmp_path / "bare.yaml"
        file.write_text(BARE + section)
        node = bench.make(ProbeTracker, scene=str(file), **{"lockstep": True, **parameters})
        return node, bench.collect(PoseStamped, "probe/pose")

    return make


ABOVE = """
  frame: ndi
  registration: {position: [0, 0, -0.5]}
  calibration: {position: [0, 0, 0.1]}
  time_offset: -0.5 s"""
"""A tracker that stands 0.5 m above the patient and looks down; the face is 0.1 m from the body."""


def place(message):
    p = message.pose.position
    return [p.x, p.y, p.z]


def test_a_scene_registers_the_device_and_calibrates_the_probe(bench, tracker):
    _, poses = tracker(ABOVE)
    publisher = bench.publisher(PoseStamped, "tracker/pose")
    publisher.publish(pose_at(0.41, 7, frame="ndi"))
    bench.spin_until(lambda: poses)
    np.testing.assert_allclose(place(poses[0]), [0, 0, 0.01], atol=1e-12)
    assert poses[0].header.frame_id == "patient"
    assert (poses[0].header.stamp.sec, poses[0].header.stamp.nanosec) == (6, 500_000_000)


def test_a_pose_in_patient_is_the_probes_own_where_the_device_has_another_frame(bench, tracker):
    _, poses = tracker(ABOVE)
    publisher = bench.publisher(PoseStamped, "tracker/pose")
    publisher.publish(pose_at(0.007, 7, frame="patient"))
    bench.spin_until(lambda: poses)
    np.testing.assert_allclose(place(poses[0]), [0, 0, 0.007], atol=1e-12)
    assert (poses[0].header.stamp.sec, poses[0].header.stamp.nanosec) == (7, 0)


def test_a_driver_that_publishes_best_effort_is_heard(bench, tracker):
    node, poses = tracker("{source: pose}", lockstep=False)
    weak = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    publisher = bench.peer.create_publisher(PoseStamped, "tracker/pose", weak)

    def heard():
        publisher.publish(pose_at(0.01, node.get_clock().now().nanoseconds // 1_000_000_000))
        return poses

    bench.spin_until(heard)


def test_one_body_of_several_in_a_message(bench, tracker):
    node, poses = tracker("{source: pose_array, entry: 1}")
    publisher = bench.publisher(PoseArray, "tracker/poses")
    for second, bodies in ((1, 1), (2, 3)):
        message = PoseArray()
        message.header.frame_id, message.header.stamp = "patient", Time(sec=second)
        message.poses = [pose_at(0.01 * (i + 1), 0).pose for i in range(bodies)]
        publisher.publish(message)
    bench.spin_until(lambda: poses)
    assert poses[0].header.stamp.sec == 2
    np.testing.assert_allclose(place(poses[0]), [0, 0, 0.02])
    assert node.health.problems["entry"] == 1


def transform(parent, child, z, second):
    message = TransformStamped()
    message.header.frame_id, message.header.stamp = parent, Time(sec=second)
    message.child_frame_id = child
    message.transform.translation.z = z
    message.transform.rotation.w = 1.0
    return TFMessage(transforms=[message])


@pytest.mark.skipif(TFMessage is None, reason="tf2_msgs is not installed")
def test_tf_leads_from_the_device_to_the_patient_and_to_the_probe(bench, tracker):
    turned = "{position: [0.1, 0.2, 0.3], orientation: [0, 0, 1, 0]}"
    node, poses = tracker(f"{{source: pose, frame: camera, registration: {turned}}}")
    static = bench.collect(TFMessage, "tf_static", latched=True)
    moving = bench.collect(TFMessage, "tf")
    publisher = bench.publisher(PoseStamped, "tracker/pose")
    bench.spin_until(lambda: static and node._transforms.get_subscription_count())
    publisher.publish(pose_at(0.05, 1, frame="camera", x=0.01))
    bench.spin_until(lambda: poses and moving)
    (device,), (probe,) = static[0].transforms, moving[0].transforms
    assert (device.header.frame_id, device.child_frame_id) == ("patient", "camera")
    assert (probe.header.frame_id, probe.child_frame_id) == ("patient", "probe")
    half_a_turn = np.diag([-1.0, -1.0, 1.0])
    np.testing.assert_allclose(
        place_of(device) + half_a_turn @ [0.01, 0, 0.05], place_of(probe), atol=1e-12
    )


def place_of(transform):
    p = transform.transform.translation
    return np.array([p.x, p.y, p.z])


@pytest.mark.skipif(TFMessage is None, reason="tf2_msgs is not installed")
def test_nothing_is_said_of_frames_that_a_tree_of_tf_may_hold(bench, tracker):
    tracker("{source: tf, frame: world, body: stylus, registration: {position: [0, 0, 1]}}")
    tracker("{source: pose}")
    static = bench.collect(TFMessage, "tf_static", latched=True)
    bench.spin_for(20)
    assert not static


@pytest.mark.skipif(TFMessage is None, reason="tf2_msgs is not installed")
def test_a_frame_of_tf_is_not_missed_among_those_of_others(bench, tracker):
    node, poses = tracker("{source: tf, frame: world, body: stylus}", lockstep=False)
    moving = bench.publisher(TFMessage, "tf")
    now = node.get_clock().now().nanoseconds // 1_000_000_000
    moving.publish(transform("world", "stylus", 0.004, now))
    for _ in range(30):
        moving.publish(transform("elsewhere", "other", 5.0, now))
    bench.spin_until(lambda: poses)


def test_a_pose_in_millimetres_is_not_believed(bench, tracker):
    node, poses = tracker("{source: pose}")
    publisher = bench.publisher(PoseStamped, "tracker/pose")
    publisher.publish(pose_at(412.0, 1))
    publisher.publish(pose_at(0.412, 2))
    bench.spin_until(lambda: poses)
    assert poses[0].header.stamp.sec == 2
    assert node.health.problems["far"] == 1


@pytest.mark.skipif(TFMessage is None, reason="tf2_msgs is not installed")
@pytest.mark.parametrize("body", ["", ", body: probe"])
def test_tf_needs_the_name_of_a_frame_that_is_not_its_own(tracker, body):
    with pytest.raises(SceneError, match=r"tracker\.body"):
        tracker(f"{{source: tf{body}}}")


@pytest.mark.skipif(TFMessage is not None, reason="tf2_msgs is installed")
def test_tf_without_tf2_msgs_is_refused(tracker):
    with pytest.raises(TrackingError, match="tf2_msgs"):
        tracker("{source: tf, frame: world, body: stylus}")


def joy(axes, second, buttons=(0, 0)):
    message = Joy(axes=[float(a) for a in axes], buttons=list(buttons))
    message.header.stamp = Time(sec=1, nanosec=int(1e9 * (second - 1)))
    return message


def test_a_mouse_moves_the_probe_and_bad_axes_do_not(bench, tracker):
    node, poses = tracker(
        "{source: six_dof_mouse, six_dof_mouse: {home: [0, 0, 0], dead_band: 0,"
        " speed: [50 mm/s, 50 mm/s, 50 mm/s], workspace_low: [-0.1, -0.1, -0.1]}}"
    )
    publisher = bench.publisher(Joy, "spacenav/joy")
    for axes, second in (
        ([0, 0, 1, 0, 0, 0], 1.0),
        ([0, 0, 1, 0, 0, 0], 1.1),
        ([math.nan] * 6, 1.12),
        ([0, 0], 1.14),
        ([0, 0, 0, 0, 0, 0], 1.2),
    ):
        publisher.publish(joy(axes, second))
    bench.spin_until(lambda: len(poses) == 3 and node.health.problems["axes"] == 2)
    assert np.linalg.norm(place(poses[1])) == pytest.approx(0.005, rel=1e-6)
    twists = bench.publisher(Twist, "spacenav/twist")
    twists.publish(Twist())  # the same mouse again
    bench.spin_for(10)
    assert len(poses) == 3


CAMERA = CameraModel(640, 480, [[600, 0, 319.5], [0, 600, 239.5], [0, 0, 1]], [-0.1, 0.02, 0, 0, 0])
SEEN = Pose([0.02, -0.01, 0.35], [math.sin(math.pi / 2 + 0.2), 0, 0, math.cos(math.pi / 2 + 0.2)])


def camera_info(camera=CAMERA):
    message = CameraInfo(width=camera.width, height=camera.height, distortion_model="plumb_bob")
    message.k = [float(v) for v in camera.matrix.ravel()]
    message.d = [float(v) for v in camera.distortion]
    return message


def image(pixels, encoding, second):
    message = Image(height=pixels.shape[0], width=pixels.shape[1], encoding=encoding)
    message.header.stamp = Time(sec=second)
    message.data = pixels.tobytes()
    message.step = len(message.data) // pixels.shape[0]
    return message


@pytest.fixture(scope="module")
def view():
    return RenderedView(CAMERA, RigidBody.create_single("6X6_250", 3, 0.04)).render(SEEN, SHARP)


SECTION = "{source: camera, camera: {dictionary: 6X6_250, marker: 3, size: 40 mm}}"


@pytest.mark.parametrize(
    ("encoding", "encode"),
    [
        ("mono8", lambda grey: grey),
        ("bayer_rggb16", lambda grey: grey.astype(np.uint16) << 8),
    ],
)
def test_a_marker_is_measured_in_an_image(bench, tracker, view, encoding, encode):
    _, poses = tracker(SECTION)
    infos = bench.publisher(CameraInfo, "camera/camera_info")
    images = bench.publisher(Image, "camera/image_raw")
    infos.publish(camera_info())
    bench.spin_for(5)
    images.publish(image(encode(view), encoding, 5))
    bench.spin_until(lambda: poses)
    assert poses[0].header.stamp.sec == 5
    np.testing.assert_allclose(place(poses[0]), SEEN.position, atol=5e-4)


def test_a_compressed_image_larger_than_can_be_decoded_is_refused():
    def chunk(kind, data):
        crc = struct.pack(">I", zlib.crc32(kind + data))
        return struct.pack(">I", len(data)) + kind + data + crc

    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 0, 0, 0, 0)
    png = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0"))
    with pytest.raises(TrackingError, match="cannot be decoded"):
        decompress_image(CompressedImage(format="png", data=png + chunk(b"IEND", b"")), "GRAY")


def test_a_recorded_path_comes_on_the_topic_of_poses(bench, tracker):
    _, poses = tracker("{source: path}")
    bench.publisher(PoseStamped, "tracker/pose").publish(pose_at(0.01, 7))
    bench.spin_until(lambda: poses)


def test_a_source_that_there_is_not_is_refused(tracker):
    with pytest.raises(UsSimError, match=r"probe_tracker\.source: 'moon' .*pose, pose_array"):
        tracker("{source: pose}", source="moon")
