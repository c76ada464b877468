"""A driver for cameras and videos: OpenCV's images with their calibration."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from us_sim.errors import TrackingError
from us_sim.nodes.device_driver import DeviceDriver
from us_sim.nodes.messages import image_message, stamp_message
from us_sim.nodes.parameters import declare_settings
from us_sim.nodes.process import node_main
from us_sim.nodes.settings import CameraDriverSettings
from us_sim.share import full_path
from us_sim.tracking.camera.model import read_camera_info
from us_sim.tracking.camera.source import VideoSource

CHECK_S = 0.05  # from one look for a subscriber to the next


class CameraDriver(DeviceDriver):
    """``camera/image_raw`` and, with the same stamp, ``camera/camera_info`` of each image.

    Its parameters are those of `CameraDriverSettings`. A camera is asked for the size in its
    calibration; a stamp is ``latency`` before the image's arrival. A file begins when somebody
    subscribes.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("camera_driver", "camera", **kwargs)
        settings = declare_settings(self, CameraDriverSettings())
        self._settings = settings
        source, info = settings.source, settings.camera_info
        self._camera = read_camera_info(full_path(info)) if info else None
        size = (self._camera.width, self._camera.height) if self._camera else None
        self._video = VideoSource(source, size=size, rate=settings.rate)
        self.finished = Future()
        self._images = self.create_stream_publisher(Image, "camera/image_raw")
        self._descriptions = self.create_stream_publisher(CameraInfo, "camera/camera_info")
        if self._camera is None:
            self.get_logger().warning(
                "images without a calibration: no pose can be measured in them; make one with "
                "us-sim calibrate camera and name it with the parameter camera_info"
            )
        self._hand_on = self.create_newest_handler(self._publish, "camera")
        if self._video.is_file and not self._video.open():
            raise TrackingError(f"{source}: is no video that OpenCV can read; convert it to MP4")
        self.start_reading(source)

    # In the camera's thread.

    def read_device(self) -> None:
        """Hand on the images of a camera, or of a file."""
        with contextlib.closing(self._video):
            if self._video.is_file:
                self._play()
            else:
                self._follow()

    def _follow(self) -> None:
        is_there = self._video.open()
        while is_there and not self.closing.is_set():
            age = self._video.grab_image()
            now = self.get_clock().now().nanoseconds
            is_there = age is not None and self._decode_image(now - round(1e9 * age))
        if not is_there:
            raise TrackingError(
                f"camera {self._video.name} gives no images: see that it is there and that "
                f"nothing else uses it, or set the parameter source"
            )

    def _play(self) -> None:
        """Play a file as fast as it was recorded."""
        self.health.state = "waiting for a subscriber"
        while not self._images.get_subscription_count():
            if self.closing.wait(CHECK_S):
                return
        begun, number, shown = self.get_clock().now().nanoseconds, 0, True
        while not self.closing.is_set():
            due = begun + round(1e9 * number * self._video.interval)
            now = self.get_clock().now().nanoseconds
            self.health.values = {"played": str(number)}
            if self.closing.wait(max(due - now, 0) * 1e-9):
                return
            # It was exposed when it was due, however long it takes to decode.
            if self._video.grab_image() is None or not (shown := self._decode_image(due)):
                # A file that holds nothing at all would be begun again without end.
                if not (self._settings.loop and number and shown and self._video.open()):
                    break
                begun, number = due, 0
                continue
            number += 1
        self.closing.set()
        self.call_soon(self._end)

    def _decode_image(self, arrived: int) -> bool:
        """Decode the image that arrived at ns, for the node's thread; return False if it fails."""
        pixels = self._video.retrieve_image(grey=self._settings.encoding == "mono8")
        if pixels is None:
            return False
        self._hand_on((arrived - round(1e9 * self._settings.latency), pixels))
        return True

    # In the node's thread.

    def _end(self) -> None:
        self.health.state = "finished"
        self.get_logger().info("the video is at its end")
        self.finished.set_result(None)

    def _publish(self, image: tuple[int, NDArray[np.uint8]]) -> None:
        self.health.state, self.health.fault = "publishing", ""
        stamp, pixels = stamp_message(image[0]), image[1]
        frame, camera = self._settings.frame_id, self._camera
        info = CameraInfo(header=Header(stamp=stamp, frame_id=frame))
        info.height, info.width = pixels.shape[:2]
        if camera is not None:
            if (info.width, info.height) != (camera.width, camera.height):
                self.health.count_problem(
                    "size",
                    f"the images are {info.width} × {info.height} pixels, but the camera was "
                    f"calibrated at {camera.width} × {camera.height}: calibrate it at the size it "
                    f"is used at",
                )
            info.width, info.height = camera.width, camera.height
            info.distortion_model = camera.distortion_model
            info.d = camera.distortion.tolist()
            info.k = camera.matrix.ravel().tolist()
            info.r = np.eye(3).ravel().tolist()
            info.p = np.hstack([camera.matrix, np.zeros((3, 1))]).ravel().tolist()
        self._descriptions.publish(info)
        self._images.publish(image_message(pixels, stamp, frame, self._settings.encoding))
        self.health.count_published("camera/image_raw", stamp)


main = node_main(CameraDriver, __name__)
