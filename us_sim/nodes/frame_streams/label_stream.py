"""What each pixel of the image is, for those who learn from images."""

from __future__ import annotations

from builtin_interfaces.msg import Time
from sensor_msgs.msg import Image

from us_sim.nodes.conversions import image_message
from us_sim.nodes.frame_streams.stream import FrameStream
from us_sim.slicing.frame import Frame


class LabelStream(FrameStream):
    """``ultrasound/labels``: the number of the volume's label at each pixel, 0 for nothing."""

    topic = "ultrasound/labels"

    def _message(self, frame: Frame, stamp: Time) -> Image:
        return image_message(frame.labels, stamp, "probe")
