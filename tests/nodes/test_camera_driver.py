"""Images of a real video and of a camera that comes and goes, with the calibration beside them.

The camera is one of paper: an object in place of OpenCV's capture, since no hardware is here.
"""

import os

import cv2
import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, Image

from us_sim.errors import TrackingError, UsSimError
from us_sim.nodes.camera_driver import CameraDriver
from us_sim.nodes.tracker_inputs.camera_input import camera_model_from
from us_sim.tracking.camera.encodings import decode_image
from us_sim.tracking.camera.model import CameraModel, write_camera_info


@pytest.fixture
def video(shared_data):
    """Ten frames of 640 × 480 pixels, at 10 Hz."""
    return shared_data / "marker-sksurgery-aruco-video" / "output.avi"


@pytest.fixture
def calibration(tmp_path):
    file = tmp_path / "camera.yaml"
    matrix = [[600.0, 0, 320], [0, 610, 240], [0, 0, 1]]
    write_camera_info(file, CameraModel(640, 480, matrix, [-0.1, 0.02, 0, 0, 0]))
    return file


def nanoseconds(message):
    return Time.from_msg(message.header.stamp).nanoseconds


def frames_of(video):
    capture = cv2.VideoCapture(str(video))
    frames = []
    while (read := capture.read())[0]:
        frames.append(read[1])
    return frames


@pytest.mark.parametrize("encoding", ["mono8", "bgr8"])
def test_a_video_is_played_at_its_own_rate_with_its_calibration_and_ends(
    bench, video, calibration, encoding
):
    node = bench.make(
        CameraDriver, source=str(video), camera_info=str(calibration), encoding=encoding
    )
    infos = bench.collect(CameraInfo, "camera/camera_info")
    bench.spin_for(10)
    images = bench.collect(Image, "camera/image_raw")
    bench.spin_until(lambda: node.finished.done() and len(images) == len(infos) == 10)
    stamps = [nanoseconds(image) for image in images]
    assert [nanoseconds(info) for info in infos] == stamps
    assert {message.header.frame_id for message in images + infos} == {"camera_optical"}
    assert (stamps[-1] - stamps[0]) / 9 == pytest.approx(100e6, rel=0.1)
    for image, frame in zip(images, frames_of(video), strict=True):
        assert image.encoding == encoding
        expected = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
        np.testing.assert_array_equal(decode_image(image, "GRAY"), expected)
    camera = camera_model_from(infos[0])
    assert (camera.width, camera.height) == (640, 480)
    np.testing.assert_array_equal(camera.matrix, [[600, 0, 320], [0, 610, 240], [0, 0, 1]])
    np.testing.assert_array_equal(camera.distortion, [-0.1, 0.02, 0, 0, 0])
    np.testing.assert_array_equal(
        np.array(infos[0].p).reshape(3, 4)[:, :3], np.array(infos[0].k).reshape(3, 3)
    )


def test_a_looping_video_goes_on_and_the_latency_makes_stamps_earlier(bench, video):
    node = bench.make(CameraDriver, source=str(video), rate=200.0, loop=True, latency=5.0)
    images = bench.collect(Image, "camera/image_raw")
    infos = bench.collect(CameraInfo, "camera/camera_info")
    bench.spin_until(lambda: len(images) > 25)
    assert not node.finished.done()
    stamps = [nanoseconds(image) for image in images]
    assert all(np.diff(stamps) > 0)
    age = node.get_clock().now().nanoseconds - stamps[-1]
    assert 5.0e9 <= age < 10e9
    with pytest.raises(TrackingError, match="not calibrated"):
        camera_model_from(infos[0])


class PaperCamera:
    """A stand-in for `cv2.VideoCapture` of a camera that gives ``left`` grey images, then none."""

    left = 0
    opened = 0

    def __init__(self, number):
        assert number == 7
        PaperCamera.opened += 1

    def isOpened(self):
        return PaperCamera.left > 0

    def grab(self):
        PaperCamera.left -= 1
        return PaperCamera.left >= 0

    def retrieve(self):
        return True, np.full((48, 64, 3), PaperCamera.left, np.uint8)

    def set(self, *_):
        return True

    def getBackendName(self):
        return "PAPER"

    def release(self):
        pass


def test_a_camera_that_comes_and_goes_is_waited_for(bench, monkeypatch, calibration):
    monkeypatch.setattr("us_sim.tracking.camera.source.cv2.VideoCapture", PaperCamera)
    monkeypatch.setattr("us_sim.nodes.device_driver.RETRY_S", 0.02)
    PaperCamera.left = 0
    node = bench.make(CameraDriver, source=7, camera_info=str(calibration))
    images = bench.collect(Image, "camera/image_raw")
    reports = bench.collect(DiagnosticArray, "diagnostics")
    bench.spin_until(lambda: node.health.problems["camera"] > 1)
    for _ in range(2):
        images.clear()
        problems = node.health.problems["camera"]
        PaperCamera.left = 4
        bench.spin_until(lambda: images and images[-1].data[0] == 0)
        bench.spin_until(lambda before=problems: node.health.problems["camera"] > before)
    assert (images[-1].width, images[-1].height, images[-1].step) == (64, 48, 64)
    assert node.health.problems["size"] > 0
    bench.spin_until(lambda: any("camera 7" in report.status[0].message for report in reports))


@pytest.mark.parametrize(
    ("bad", "fact"),
    [
        ({"source": "nothing.avi"}, "no such file"),
        ({"source": "{pipe}"}, "no such file"),
        ({"source": "0", "encoding": "yuv"}, "encoding: 'yuv' .*mono8, bgr8"),
        ({"source": "0", "camera_info": "{text}"}, "camera info"),
    ],
)
def test_what_cannot_be_used_is_refused_in_a_sentence(bench, tmp_path, bad, fact):
    text = tmp_path / "text.avi"
    text.write_text("no video\n")
    os.mkfifo(tmp_path / "pipe.avi")
    bad = {k: v.format(text=text, pipe=tmp_path / "pipe.avi") for k, v in bad.items()}
    with pytest.raises(UsSimError, match=fact):
        bench.make(CameraDriver, **bad)
