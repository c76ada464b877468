"""Poses from a camera that sees the markers on the probe's grip, in any usual encoding."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_msgs.msg import Header

from us_sim.nodes.qos import FOREIGN
from us_sim.nodes.tracker_inputs.device import TrackerInput, TrackerNode
from us_sim.scene.building import load_camera_body
from us_sim.tracking.camera.encodings import decode_image, decompress_image
from us_sim.tracking.camera.model import CameraModel
from us_sim.tracking.camera.source import CameraSource, practise_tracking
from us_sim.tracking.settings import CameraSettings

Decoder = Callable[[Any, str], NDArray[np.uint8]]


def camera_model_from(message: CameraInfo) -> CameraModel:
    """Return the camera that a driver describes; one that is not calibrated is refused."""
    return CameraModel(
        message.width,
        message.height,
        np.array(message.k, dtype=np.float64).reshape(3, 3),
        np.array(message.d, dtype=np.float64),
        message.distortion_model,
    )


class CameraInput(TrackerInput):
    """``camera/image_raw``, or ``camera/image_raw/compressed``, with ``camera/camera_info``."""

    def __init__(self, device: TrackerNode, settings: CameraSettings) -> None:
        super().__init__(device, settings)
        self._body = load_camera_body(device.scene)
        practise_tracking(self._body)
        self._source: CameraSource | None = None
        self._described: CameraInfo | None = None
        device.subscribe(
            CameraInfo, "camera/camera_info", self._on_description, FOREIGN, newest=True
        )
        for message_type, topic, decode in (
            (Image, "camera/image_raw", decode_image),
            (CompressedImage, "camera/image_raw/compressed", decompress_image),
        ):
            callback = partial(self._on_image, topic, decode)
            device.subscribe(message_type, topic, callback, FOREIGN, newest=True)

    def reset(self) -> None:
        """Forget the probe's last pose; the camera stays."""
        if self._source is not None:
            self._source.reset()

    def _on_description(self, message: CameraInfo) -> None:
        message.header = Header()  # it differs from image to image
        if message != self._described:
            self._described, self._source = message, None
            self._source = CameraSource(camera_model_from(message), self._body, self._settings)

    def _on_image(self, topic: str, decode: Decoder, message: Image | CompressedImage) -> None:
        if self._source is None:
            if self._described is None:
                self._device.refuse_measurement(
                    "camera",
                    "no camera/camera_info has come, so no pose can be measured: calibrate the "
                    "camera (us-sim calibrate camera) and give its driver the file",
                )
            return
        stamp = self._device.stamp_of(message.header, topic)
        measurement = self._source.measure_pose(decode(message, "GRAY"), stamp)
        if measurement is None:
            self._device.refuse_measurement("markers", f"{topic}: {self._source.last_problem}")
            return
        left_out = self._source.last_problem
        self._device.health.values["markers"] = left_out or "all that are seen are used"
        self._device.take_measurement(measurement)
