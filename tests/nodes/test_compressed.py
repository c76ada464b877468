"""Compressed companions of images: what is decoded again, and the names of image_transport."""

import threading

import cv2
import numpy as np
import pytest
from bench import pose_at
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from rclpy.parameter import Parameter
from sensor_msgs.msg import CompressedImage, Image

from us_sim.nodes.settings import CompressedSettings
from us_sim.nodes.slice_interpolator import SliceInterpolator
from us_sim.nodes.streams.compressed import compressed
from us_sim.recording.decoding import pixels_from

IMAGE = "ultrasound/image"


@pytest.fixture
def imager(bench, tmp_path):
    """A function that makes the node for a bare scene, and waits for who publishes poses."""

    def make(**parameters):
        scene = tmp_path / "bare.yaml"
        scene.write_text(
            "{name: bare, volume: {phantom: upper_arm, voxel_size: 1 mm}, "
            "probe: {aperture: 40 mm, depth: 40 mm, image: [60, 50]}}"
        )
        node = bench.make(SliceInterpolator, scene=str(scene), **parameters)
        return node, bench.publisher(PoseStamped, "probe/pose")

    return make


def heard(bench, node, *topics):
    by_name = {publisher.topic_name: publisher for publisher in node.publishers}
    publishers = [by_name[f"/{topic}"] for topic in topics]
    bench.spin_until(lambda: all(each.get_subscription_count() for each in publishers))


def decoded(message):
    """By OpenCV, as the plugin's subscribers do it; colours as the image's encoding has them."""
    pixels = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_UNCHANGED)
    return pixels[..., ::-1] if message.format.startswith("rgb8") else pixels


def test_a_png_is_the_image_itself_and_a_jpeg_is_near(bench, imager) -> None:
    node, poses = imager(lockstep=True)
    topics = (IMAGE, f"{IMAGE}_annotated")
    images = [bench.collect(Image, topic) for topic in topics]
    companions = [bench.collect(CompressedImage, f"{topic}/compressed") for topic in topics]
    heard(bench, node, *topics, *(f"{topic}/compressed" for topic in topics))
    for second, form in enumerate(("jpeg", "png"), start=1):
        for topic in topics:
            name = f"{topic.replace('/', '.')}.compressed.format"
            assert node.set_parameters([Parameter(name, value=form)])[0].successful
        poses.publish(pose_at(0.0, second))
        bench.spin_until(lambda n=second: all(len(c) == n for c in companions + images))
        for (*_, image), (*_, companion) in zip(images, companions, strict=True):
            assert companion.header == image.header
            pixels = np.frombuffer(image.data, np.uint8)
            error = decoded(companion).astype(float).ravel() - pixels
            assert pixels.std() > 10
            assert np.sqrt(np.mean(error**2)) < (4 if form == "jpeg" else 1e-9)
    # As compressed_publisher.cpp of image_transport_plugins composes them.
    assert [each.format for each in companions[0]] == [
        "mono8; jpeg compressed mono8",
        "mono8; png compressed ",
    ]
    assert [each.format for each in companions[1]] == [
        "rgb8; jpeg compressed bgr8",
        "rgb8; png compressed bgr8",
    ]


def test_live_an_image_does_not_wait_for_its_companion(bench, imager, monkeypatch) -> None:
    from us_sim.nodes.streams import compressed as module

    may_encode = threading.Event()
    monkeypatch.setattr(
        module, "compressed", lambda *given: may_encode.wait(30) and compressed(*given)
    )
    node, poses = imager()
    images = bench.collect(Image, IMAGE)
    companions = bench.collect(CompressedImage, f"{IMAGE}/compressed")
    heard(bench, node, IMAGE, f"{IMAGE}/compressed")
    for second in range(1, 6):
        poses.publish(pose_at(0.0, second))
        bench.spin_until(lambda n=second: len(images) == n)
    assert not companions
    may_encode.set()
    bench.spin_until(lambda: companions and companions[-1].header == images[-1].header)
    assert len(companions) < len(images)
    assert np.array_equal(decoded(companions[-1]).shape, pixels_from(images[-1]).shape)


def test_it_is_made_only_for_subscribers_and_alone_is_enough(bench, imager) -> None:
    node, poses = imager(lockstep=True)
    companions = bench.collect(CompressedImage, f"{IMAGE}/compressed")
    heard(bench, node, f"{IMAGE}/compressed")
    poses.publish(pose_at(0.0, 1))
    bench.spin_until(lambda: len(companions) == 1)
    reports = bench.collect(DiagnosticArray, "diagnostics")
    bench.spin_until(lambda: reports)
    told = {value.key: value.value for value in reports[-1].status[0].values}
    assert told[f"published {IMAGE}/compressed"] == "1"
    assert f"published {IMAGE}_annotated" not in told
    assert f"published {IMAGE}_annotated/compressed" not in told


def test_quality_and_level_are_those_of_the_encoders() -> None:
    noise = np.random.default_rng(1).integers(0, 256, (64, 64), np.uint8)
    image = Image(height=64, width=64, step=64, encoding="mono8", data=noise.tobytes())
    for settings, suffix, options in (
        (CompressedSettings(jpeg_quality=30), ".jpg", [cv2.IMWRITE_JPEG_QUALITY, 30]),
        (CompressedSettings("png", png_level=9), ".png", [cv2.IMWRITE_PNG_COMPRESSION, 9]),
    ):
        data = bytes(compressed(image, settings).data)
        assert data == cv2.imencode(suffix, noise, options)[1].tobytes()
