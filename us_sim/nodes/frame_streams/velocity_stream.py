"""How fast the blood at each pixel moves along the beam, for those who judge estimates of it."""

from __future__ import annotations

from builtin_interfaces.msg import Time
from sensor_msgs.msg import Image

from us_sim.nodes.conversions import field_message
from us_sim.nodes.frame_streams.colour_stream import ColourStream
from us_sim.nodes.frame_streams.stream import FrameStream
from us_sim.nodes.scene_node import SceneNode
from us_sim.slicing.frame import Frame


class VelocityStream(FrameStream):
    """``ultrasound/velocity``: exact, along the beams of colour Doppler, in the whole image."""

    topic = "ultrasound/velocity"

    def __init__(self, node: SceneNode, colour: ColourStream) -> None:
        super().__init__(node)
        self._colour = colour

    def _message(self, frame: Frame, stamp: Time) -> Image:
        return field_message(self._colour.velocity(frame), stamp, "probe")
