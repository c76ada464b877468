"""The companion of an image topic that image_transport's plugin ``compressed`` would make.

Names, parameters and the text of ``format`` are those of compressed_image_transport, so that its
subscribers, RViz and rqt take the images as they take a camera's.
"""

from __future__ import annotations

import threading
from typing import Any

import cv2
import numpy as np
from sensor_msgs.msg import CompressedImage, Image

from us_sim.nodes.parameters import Group, LiveSettings
from us_sim.nodes.scene_node import SceneNode
from us_sim.nodes.settings import COMPRESSED, CompressedSettings
from us_sim.recording.decoding import colour_pixels_from, pixels_from


class Compressed:
    """``TOPIC/compressed``: a topic of images as JPEG or PNG, while somebody subscribes.

    A thread encodes the newest image after the image itself was sent; of those that come meanwhile
    the newest is kept. In lockstep each is encoded at once.

    Args:
        node: that publishes it, and gets the parameters.
        topic: the image's.
    """

    def __init__(self, node: SceneNode, topic: str) -> None:
        self._node, self.topic = node, f"{topic}/compressed"
        self._settings = LiveSettings(node, {"set": Group(CompressedSettings(), COMPRESSED[topic])})
        self._publisher = node.stream(CompressedImage, self.topic)
        self._publish = node.guarded(self.topic, self._encode_and_publish)
        self._waiting: Image | None = None
        self._came = threading.Condition()
        self._thread: threading.Thread | None = None

    @property
    def is_wanted(self) -> bool:
        """Whether somebody subscribes."""
        return bool(self._publisher.get_subscription_count() > 0)

    def send(self, image: Image) -> None:
        """Publish the image, soon, if that is wanted."""
        if not self.is_wanted:
            return
        if self._node.lockstep:
            self._publish(image)
            return
        with self._came:
            self._waiting = image
            self._came.notify()
        if self._thread is None:  # begun late, it does not go before ordinary ones as the node may
            self._thread = threading.Thread(target=self._run, name=self.topic, daemon=True)
            self._thread.start()

    def _run(self) -> None:
        while True:
            with self._came:
                self._came.wait_for(lambda: self._waiting is not None)
                image, self._waiting = self._waiting, None
            if not self._node.context.ok():
                return
            self._publish(image)

    def _encode_and_publish(self, image: Image) -> None:
        self._publisher.publish(compressed(image, self._settings.values["set"]))
        self._node.health.published(self.topic)


def compressed(image: Image, settings: CompressedSettings) -> CompressedImage:
    """A ``mono8`` or ``rgb8`` image, encoded; the format says how, as the plugin says it."""
    is_colour = image.encoding == "rgb8"
    if is_colour:
        pixels = np.ascontiguousarray(colour_pixels_from(image)[..., ::-1])
    else:
        pixels = pixels_from(image)
    target = "bgr8" if is_colour else "mono8"
    options: list[Any]
    if settings.format == "png":
        target = target if is_colour else ""  # as the plugin has it
        options = [cv2.IMWRITE_PNG_COMPRESSION, settings.png_level]
    else:
        options = [cv2.IMWRITE_JPEG_QUALITY, settings.jpeg_quality]
    suffix = {"png": ".png", "jpeg": ".jpg"}[settings.format]
    _, data = cv2.imencode(suffix, pixels, options)
    return CompressedImage(
        header=image.header,
        format=f"{image.encoding}; {settings.format} compressed {target}",
        data=data.tobytes(),
    )
