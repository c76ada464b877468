"""How far the tissue of each pixel has moved, for those who measure motion in images."""

from __future__ import annotations

from builtin_interfaces.msg import Time
from sensor_msgs.msg import Image

from us_sim.nodes.conversions import field_message
from us_sim.nodes.frame_streams.stream import FrameStream
from us_sim.slicing.frame import Frame
from us_sim.slicing.strain import displacement


class DisplacementStream(FrameStream):
    """``ultrasound/displacement``: lateral and axial, m, of each pixel's tissue since rest."""

    topic = "ultrasound/displacement"

    def _message(self, frame: Frame, stamp: Time) -> Image:
        return field_message(displacement(frame), stamp, "probe")
