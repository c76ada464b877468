"""Pulsed-wave Doppler, for the eye."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from builtin_interfaces.msg import Time
from numpy.typing import NDArray
from sensor_msgs.msg import Image

from us_sim.nodes.conversions import colour_image_message
from us_sim.nodes.frame_streams.following import Following
from us_sim.nodes.frame_streams.settable_stream import SettableStream
from us_sim.nodes.scene_node import SceneNode
from us_sim.slicing.flow.blood import Blood
from us_sim.slicing.flow.doppler import Spectrum
from us_sim.slicing.frame import Frame
from us_sim.slicing.probe.probe import Probe
from us_sim.slicing.settings import SpectrumSettings


class SpectrumStream(SettableStream[Spectrum]):
    """``ultrasound/spectrum``: velocities at the gate over time; parameters ``spectrum.…``."""

    topic = "ultrasound/spectrum"

    def __init__(self, node: SceneNode, blood: Blood) -> None:
        super().__init__(node, node.scene.spectrum, "spectrum.")
        self._blood = blood
        self._following = Following(node, "spectrum.", blood)

    @property
    def lines(self) -> Sequence[NDArray[np.float64]]:
        """The gate's ends and the angle that is set."""
        return self._made.lines if self._made else ()

    def _make(self, probe: Probe, settings: SpectrumSettings) -> Spectrum:
        return Spectrum(probe, settings)

    def _go_on(self, made: Spectrum, before: Spectrum) -> None:
        made.go_on(before)

    def _message(self, frame: Frame, stamp: Time) -> Image:
        spectrum = self.for_frame(frame)
        self._following.look(frame, spectrum.settings, spectrum.settings.steering)
        picture = spectrum.show(self._blood, frame)
        self._node.health.values["no_spectrum"] = spectrum.absence(self._blood, frame).value
        return colour_image_message(picture, stamp, "probe")
