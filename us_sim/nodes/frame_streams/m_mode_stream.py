"""M-mode, for the eye."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from us_sim.nodes.conversions import colour_image_message
from us_sim.nodes.frame_streams.settable_stream import SettableStream
from us_sim.nodes.scene_node import SceneNode
from us_sim.slicing.frame import Frame
from us_sim.slicing.m_mode import MMode
from us_sim.slicing.probe.probe import Probe
from us_sim.slicing.settings import MModeSettings


class MModeStream(SettableStream[MMode]):
    """``ultrasound/m_mode``: the image along a line over time; parameters ``m_mode.…``."""

    topic = "ultrasound/m_mode"

    def __init__(self, node: SceneNode) -> None:
        super().__init__(node, node.scene.m_mode, "m_mode.")

    @property
    def lines(self) -> Sequence[NDArray[np.float64]]:
        """The line in the image."""
        return [self._made.places] if self._made else ()

    def _make(self, probe: Probe, settings: MModeSettings) -> MMode:
        return MMode(probe, settings)

    def _go_on(self, made: MMode, before: MMode) -> None:
        made.go_on(before)

    def _message(self, frame: Frame, stamp: Time) -> Image:
        picture = self.for_frame(frame).show(frame.pixels, frame.time)
        return colour_image_message(picture, stamp, "probe")
