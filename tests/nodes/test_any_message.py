"""What is read of any message is sound, and no message ends the tracker or the slicing."""

import functools
import math
import warnings
from array import array
from functools import partial

import numpy as np
import pytest
from any_message import any_of, nearly
from bench import pose_at
from builtin_interfaces.msg import Time
from geometry_msgs.msg import (
    PoseArray,
    PoseStamped,
    TransformStamped,
    Twist,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Joy, PointCloud2
from std_msgs.msg import Bool

from us_sim.errors import UsSimError
from us_sim.geometry.pose import Pose
from us_sim.nodes import messages
from us_sim.nodes.image_writer import ImageWriter
from us_sim.nodes.messages import TFMessage
from us_sim.nodes.probe_tracker import ProbeTracker
from us_sim.nodes.slice_interpolator import SliceInterpolator
from us_sim.nodes.tracker_inputs.camera_input import camera_model_from
from us_sim.recording import decoding
from us_sim.scene.building import build_tissue_model, load_volume
from us_sim.scene.reading import load_scene
from us_sim.tracking.camera.encodings import decode_image, decompress_image
from us_sim.tracking.haptic import ContactModel

CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])


def transforms(parent, child, second):
    message = TransformStamped(child_frame_id=child)
    message.header.frame_id, message.header.stamp = parent, Time(sec=second)
    message.transform.rotation.w = 1.0
    return TFMessage(transforms=[message])


def joy(second=3):
    message = Joy(axes=[0.1] * 6, buttons=[0, 1])
    message.header.stamp = Time(sec=second)
    return message


def camera_info():
    message = CameraInfo(width=8, height=6, distortion_model="plumb_bob", d=[0.0] * 5)
    message.k = [9.0, 0.0, 4.0, 0.0, 9.0, 3.0, 0.0, 0.0, 1.0]
    return message


def grey(second=3):
    pixels = np.arange(48, dtype=np.uint8).reshape(6, 8)
    return messages.image_message(pixels, Time(sec=second), "probe")


def contact_model():
    stiffness = np.diag([1.0, 2, 3, 4, 5, 6])
    return messages.contact_model_message(
        ContactModel(3_000_000_000, Pose(), np.arange(6.0), stiffness)
    )


def cloud(points=CORNERS, second=3):
    columns = dict(zip("xyz", np.asarray(points).T, strict=True))
    return messages.cloud_message(columns, Time(sec=second), "patient")


def poses_of(second=3):
    message = PoseArray(poses=[pose_at(0.001, second).pose] * 2)
    message.header = pose_at(0.0, second).header
    return message


GOOD = [
    (decoding.pose_from, pose_at(0.001, 3)),
    (decoding.vectors_from, cloud()),
    (decoding.pixels_from, grey()),
    (decoding.tetrahedra_from, messages.tetrahedra_message(np.array([[0, 1, 2, 3]]))),
    (decoding.affine_from, messages.affine_message(np.eye(4))),
    (messages.contact_model_from, contact_model()),
    (partial(decode_image, colours="GRAY"), grey()),
    (
        partial(decompress_image, colours="GRAY"),
        CompressedImage(format="png", data=array("B", b"\x89PNG\r\n")),
    ),
    (camera_model_from, camera_info()),
]


def numbers_of(value):
    if isinstance(value, np.ndarray):
        return value.astype(np.float64).ravel()
    parts = [part for part in vars(value).values() if isinstance(part, np.ndarray | Pose)]
    return np.concatenate([numbers_of(part) for part in parts])


@pytest.mark.parametrize(("convert", "good"), GOOD, ids=lambda case: getattr(case, "__name__", ""))
def test_what_a_conversion_makes_of_any_message_is_finite_or_it_says_why_not(convert, good):
    @settings(max_examples=100, deadline=None)
    @given(nearly(good) | any_of(type(good)))
    def check(message):
        try:
            made = convert(message)
        except UsSimError:
            return
        numbers = numbers_of(made)
        assert np.isfinite(numbers).all()
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert math.isfinite(float(numbers @ numbers))  # nor do their products overflow

    check()


def send(node, topic, message):
    """Call back as the executor does when a message has come."""
    (subscription,) = (s for s in node.subscriptions if s.topic_name == f"/{topic}")
    subscription.callback(serialize_message(message) if subscription.raw else message)


def attack(bench, node, inputs, count):
    """Send any messages; what failed, but was not refused, is said."""

    @functools.cache
    def anything(topic, second):
        good = inputs[topic](second)
        return nearly(good) | any_of(type(good)) | st.just(good)

    @settings(
        max_examples=count,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.data())
    def once(data):
        topic = data.draw(st.sampled_from(sorted(inputs)))
        send(node, topic, data.draw(anything(topic, data.draw(st.integers(1, 4)))))
        for _ in range(3):  # where the newest is worked on, not at once
            bench.executor.spin_once(timeout_sec=0.0)

    once()
    assert not node.failures, node.last_failure


def is_finite(message):
    if isinstance(message, PointCloud2):
        return bool(np.isfinite(np.frombuffer(message.data, "<f4")).all())
    for name, kind in type(message).get_fields_and_field_types().items():
        value = getattr(message, name)
        values = value if isinstance(value, list) else [value]
        if "/" in kind and not all(map(is_finite, values)):
            return False
        if kind.startswith(("float", "double", "sequence<float", "sequence<double")) and not (
            np.isfinite(np.array(value, np.float64)).all()
        ):
            return False
    return True


def answers(bench, send_good, outputs):
    """Good messages until there is an answer to one of them; all that came is finite."""
    count, second = len(outputs), 100_000

    def came():
        nonlocal second
        second += 1
        send_good(second)
        bench.spin_for(3)
        return any(message.header.stamp.sec > 100_000 for message in outputs[count:])

    bench.spin_until(came)
    assert all(map(is_finite, outputs))


def pose(second):
    return pose_at(0.001, second)


SOURCES = {
    "{source: pose}": {"tracker/pose": pose},
    "{source: pose_array, entry: 1}": {"tracker/poses": poses_of},
    "{source: six_dof_mouse}": {"spacenav/twist": lambda _: Twist(), "spacenav/joy": joy},
    "{source: haptic}": {"haptic/clutch": lambda _: Bool(), "haptic/pose": pose},
}
if TFMessage is not None:
    SOURCES["{source: tf, frame: tracker, body: marker}"] = {
        "tf_static": lambda second: transforms("arm", "marker", second),
        "tf": lambda second: transforms("tracker", "arm", second),
    }


@pytest.mark.parametrize(("section", "inputs"), SOURCES.items())
def test_no_message_of_any_source_ends_the_tracker(bench, small_scene, tmp_path, section, inputs):
    scene = tmp_path / "scene.yaml"
    scene.write_text(f"{small_scene.read_text()}\ntracker: {section}\n")
    node = bench.make(ProbeTracker, scene=str(scene), lockstep=True)
    poses = bench.collect(PoseStamped, "probe/pose")
    attack(bench, node, inputs, 60)

    def good(second):
        for topic, make in inputs.items():
            send(node, topic, make(second))

    answers(bench, good, poses)


def test_no_mesh_and_no_pose_end_the_slicing(bench, small_scene):
    scene = load_scene(small_scene)
    mesh = build_tissue_model(scene, load_volume(scene)).mesh
    node = bench.make(SliceInterpolator, scene=str(small_scene))
    images = bench.collect(Image, "ultrasound/image")
    bench.collect(Image, "ultrasound/image_annotated")
    bench.spin_until(lambda: node._streams[0].is_wanted)
    tetrahedra = messages.tetrahedra_message(mesh.tetrahedra)
    inputs = {
        "probe/pose": pose,
        "tissue/rest": lambda second: cloud(mesh.nodes, second),
        "tissue/tetrahedra": lambda _: tetrahedra,
        "tissue/nodes": lambda second: cloud(mesh.nodes, second),
    }
    attack(bench, node, inputs, 80)

    def good(second):
        for topic, make in inputs.items():
            send(node, topic, make(second))

    answers(bench, good, images)


def test_a_folder_for_images_that_cannot_be_made_is_refused(bench, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UsSimError, match=r"the folder .*images cannot be made: Not a directory"):
        bench.make(ImageWriter, folder=str(tmp_path / "file" / "images"))
