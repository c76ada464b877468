"""A driver for cameras and videos: OpenCV's images with their calibration."""

from __future__ import annotations

import threading
from functools import partial
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time as TimeMessage
from numpy.typing import NDArray
from rclpy.task import Future
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Header

from us_sim.errors import TrackingError
from us_sim.nodes.guarded_node import GuardedNode, Health
from us_sim.nodes.messages import image_message, stamp_message
from us_sim.nodes.parameters import declare_settings
from us_sim.nodes.process import node_main
from us_sim.nodes.settings import CameraDriverSettings
from us_sim.share import full_path
from us_sim.tracking.camera.model import CameraModel, read_camera_info
from us_sim.tracking.camera.source import VideoSource

CHECK_S = 0.05  # from one look for a subscriber to the next
RETRY_S = 1.0  # until a camera that was not there is tried again
END_S = 1.0  # for which an image that is awaited may delay the node's end


class CameraDriver(GuardedNode):
    """``camera/image_raw`` and, with the same stamp, ``camera/camera_info`` of each image.

    Its parameters are those of `CameraDriverSettings`. A camera is asked for the size in its
    calibration; a stamp is ``latency`` before the image's arrival. A file begins when somebody
    subscribes.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("camera_driver", **kwargs)
        settings = declare_settings(self, CameraDriverSettings())
        source, info = settings.source, settings.camera_info
        self._frame, self._loop = settings.frame_id, settings.loop
        self._encoding = settings.encoding
        self._latency = round(1e9 * settings.latency)
        self._camera = read_camera_info(full_path(info)) if info else None
        size = (self._camera.width, self._camera.height) if self._camera else None
        self._video = VideoSource(source, size=size, rate=settings.rate)
        self.finished = Future()
        self.health = Health(self, source)
        self._images = self.create_stream_publisher(Image, "camera/image_raw")
        self._descriptions = self.create_stream_publisher(CameraInfo, "camera/camera_info")
        if self._camera is None:
            self.get_logger().warning(
                "images without a calibration: no pose can be measured in them; make one with "
                "us-sim calibrate camera and name it with the parameter camera_info"
            )
        self.health.state = "opening"
        self._hand_on = self.create_newest_handler(self._publish, "camera")
        self._ended = False
        self._closing = threading.Event()
        if self._video.is_file and not self._video.open():
            raise TrackingError(f"{source}: is no video that OpenCV can read; convert it to MP4")
        self._thread = threading.Thread(target=self._run, name="camera", daemon=True)
        self._thread.start()

    def destroy_node(self) -> None:
        """Close the camera."""
        self._closing.set()
        self._thread.join(END_S)
        if not self._thread.is_alive():  # a camera that hangs is left to the process's end
            self._video.close()
        super().destroy_node()

    # In the camera's thread.

    def _run(self) -> None:
        while not self._closing.is_set() and not self._ended:
            try:
                if self._video.is_file:
                    self._play()
                else:
                    self._follow()
            except Exception as error:  # so that the thread does not end silently
                self.report_failure("camera", error)
                self._video.close()
                self._closing.wait(RETRY_S)

    def _follow(self) -> None:
        while not self._closing.is_set():
            if self._video.open():
                while not self._closing.is_set():
                    age = self._video.grab_image()
                    now = self.get_clock().now().nanoseconds
                    if age is None or not self._decode_image(now - round(1e9 * age)):
                        break
            self._video.close()
            if not self._closing.is_set():
                problem = (
                    f"camera {self._video.name} gives no images: see that it is there and that "
                    f"nothing else uses it, or set the parameter source; it is tried again"
                )
                self.call_soon(partial(self._on_device_lost, problem))
                self._closing.wait(RETRY_S)

    def _play(self) -> None:
        """Play a file as fast as it was recorded."""
        self.health.state = "waiting for a subscriber"
        while not self._images.get_subscription_count():
            if self._closing.wait(CHECK_S):
                return
        begun, number, shown = self.get_clock().now().nanoseconds, 0, True
        while not self._closing.is_set():
            due = begun + round(1e9 * number * self._video.interval)
            now = self.get_clock().now().nanoseconds
            self.health.values = {"played": str(number)}
            if self._closing.wait(max(due - now, 0) * 1e-9):
                return
            # It was exposed when it was due, however long it takes to decode.
            if self._video.grab_image() is None or not (shown := self._decode_image(due)):
                # A file that holds nothing at all would be begun again without end.
                if not (self._loop and number and shown and self._video.open()):
                    break
                begun, number = due, 0
                continue
            number += 1
        self._ended = True
        self.call_soon(self._end)

    def _decode_image(self, arrived: int) -> bool:
        """Decode the image that arrived at ns, for the node's thread; return False if it fails."""
        stamp = arrived - self._latency
        pixels = self._video.retrieve_image(grey=self._encoding == "mono8")
        if pixels is None:
            return False
        self._hand_on((stamp, pixels))
        return True

    # In the node's thread.

    def _on_device_lost(self, problem: str) -> None:
        self.health.state, self.health.fault = "no camera", problem
        self.health.count_problem("camera", problem)

    def _end(self) -> None:
        self.health.state = "finished"
        self.get_logger().info("the video is at its end")
        self.finished.set_result(None)

    def _publish(self, image: tuple[int, NDArray[np.uint8]]) -> None:
        self.health.state, self.health.fault = "publishing", ""
        stamp, pixels = stamp_message(image[0]), image[1]
        rows, columns = pixels.shape[:2]
        camera = self._camera
        if camera is not None and (columns, rows) != (camera.width, camera.height):
            self.health.count_problem(
                "size",
                f"the images are {columns} × {rows} pixels, but the camera was calibrated at "
                f"{camera.width} × {camera.height}: calibrate it at the size it is used at",
            )
        self._descriptions.publish(_info(camera, (columns, rows), stamp, self._frame))
        self._images.publish(image_message(pixels, stamp, self._frame, self._encoding))
        self.health.count_published("camera/image_raw", stamp)


def _info(
    camera: CameraModel | None, size: tuple[int, int], stamp: TimeMessage, frame: str
) -> CameraInfo:
    message = CameraInfo(header=Header(stamp=stamp, frame_id=frame))
    message.width, message.height = size
    if camera is not None:
        message.width, message.height = camera.width, camera.height
        message.distortion_model = camera.distortion_model
        message.d = camera.distortion.tolist()
        message.k = camera.matrix.ravel().tolist()
        message.r = np.eye(3).ravel().tolist()
        message.p = np.hstack([camera.matrix, np.zeros((3, 1))]).ravel().tolist()
    return message


main = node_main(CameraDriver, __name__)
