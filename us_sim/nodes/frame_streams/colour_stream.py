"""Colour Doppler, for those who look at it or judge how velocities are estimated."""

from __future__ import annotations

import numpy as np
from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from us_sim.nodes.conversions import field_message
from us_sim.nodes.frame_streams.following import Following
from us_sim.nodes.frame_streams.settable_stream import SettableStream
from us_sim.nodes.scene_node import SceneNode
from us_sim.slicing.drawing.overlay import Overlay
from us_sim.slicing.flow.blood import Blood
from us_sim.slicing.flow.doppler import ColourDoppler
from us_sim.slicing.frame import Frame
from us_sim.slicing.probe.probe import Probe
from us_sim.slicing.settings import ColourSettings

_OPACITY = 0.9


class ColourStream(SettableStream[ColourDoppler]):
    """``ultrasound/velocity_estimate``, and the colours of the same; parameters ``colour.…``."""

    topic = "ultrasound/velocity_estimate"
    overlay_name = "velocity"

    def __init__(self, node: SceneNode, blood: Blood) -> None:
        super().__init__(node, node.scene.colour, "colour.")
        self._blood = blood
        self._following = Following(node, "colour.", blood)
        self._frame: Frame | None = None

    def _make(self, probe: Probe, settings: ColourSettings) -> ColourDoppler:
        return ColourDoppler(probe, settings)

    def velocity(self, frame: Frame) -> NDArray[np.float32]:
        """m/s towards the probe along the box's beams (rows, columns), exact; NaN outside blood."""
        return self.for_frame(frame).truth(self._blood, frame)

    def overlay(self, frame: Frame) -> Overlay:
        """The estimate in colours, and its box."""
        doppler = self.for_frame(frame)
        return Overlay(self._estimate(frame), doppler.scale, _OPACITY, outline=doppler.outline)

    def _message(self, frame: Frame, stamp: Time) -> Image:
        return field_message(self._estimate(frame), stamp, "probe")

    def _estimate(self, frame: Frame) -> NDArray[np.float32]:
        """Made once, since frames before it count, too."""
        if frame is not self._frame:
            doppler = self.for_frame(frame)
            self._following.look(frame, doppler.settings, 0.0)
            self._shown = doppler.estimate(self._blood, frame)
            self._frame = frame
            why = doppler.absence(self._blood, frame, self._shown)
            self._node.health.values["no_colour"] = why.value
        return self._shown
