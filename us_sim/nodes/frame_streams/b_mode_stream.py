"""The B-mode picture, for all who look at it or learn from it."""

from __future__ import annotations

from builtin_interfaces.msg import Time
from sensor_msgs.msg import Image

from us_sim.nodes.conversions import image_message
from us_sim.nodes.frame_streams.stream import FrameStream
from us_sim.slicing.frame import Frame


class BModeStream(FrameStream):
    """``ultrasound/image``, whose age counts as the node's latency."""

    topic = "ultrasound/image"

    def show(self, frame: Frame, stamp: Time) -> None:
        """Send the picture, under the stamp of its pose."""
        self._publisher.publish(self._message(frame, stamp))
        self._node.health.published(self.topic, stamp)

    def _message(self, frame: Frame, stamp: Time) -> Image:
        return image_message(frame.pixels, stamp, "probe")
