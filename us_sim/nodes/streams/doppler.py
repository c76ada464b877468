"""Topics of moving blood: its exact velocity, colour Doppler and pulsed-wave Doppler."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.parameter import Parameter

from us_sim.nodes.parameters import Group, LiveSettings
from us_sim.nodes.scene_node import SceneNode
from us_sim.nodes.streams.stream import FrameStream, SettableStream
from us_sim.scene.building import blood_of
from us_sim.slicing.drawing.overlay import Overlay
from us_sim.slicing.flow.blood import Blood
from us_sim.slicing.flow.doppler import ColourDoppler, Spectrum, nearest_vessel, warm_up
from us_sim.slicing.frame import Frame
from us_sim.slicing.settings import DopplerSettings
from us_sim.volume.volume import Volume

EVERY_S = 0.2  # between two searches for the vessel; of the frames' time


class Following:
    """Keeps ``PREFIX.lateral`` and ``PREFIX.depth`` on a vessel where ``PREFIX.follow`` is set.

    Args:
        node: whose parameters they are.
        prefix: of them, with its dot.
        blood: in the vessels.
    """

    def __init__(self, node: SceneNode, prefix: str, blood: Blood) -> None:
        self._node, self._prefix, self._blood = node, prefix, blood
        self._updated = 0.0  # s, of the frame's time

    def update(self, frame: Frame, settings: DopplerSettings, steering: float) -> None:
        """Move it, for the frames to come; ``steering`` (rad) is that of beams from the face on."""
        if not settings.follow or 0.0 <= frame.time - self._updated < EVERY_S:
            return
        self._updated = frame.time
        depth = 0.5 * frame.probe.depth if settings.depth is None else settings.depth
        place = nearest_vessel(self._blood, frame, settings.lateral, depth, steering)
        if place is None:
            return
        for name, value in zip(("lateral", "depth"), place, strict=True):
            self._node.set_parameters([Parameter(f"{self._prefix}{name}", value=value)])


_OPACITY = 0.9


class ColourStream(SettableStream[ColourDoppler]):
    """``ultrasound/velocity_estimate``, and the colours of the same; parameters ``colour.…``."""

    def __init__(self, node: SceneNode, blood: Blood) -> None:
        topic = "ultrasound/velocity_estimate"
        super().__init__(node, topic, self._estimate, ColourDoppler, node.scene.colour, "colour.")
        self._blood = blood
        self._following = Following(node, "colour.", blood)
        self._frame: Frame | None = None

    def velocity(self, frame: Frame) -> NDArray[np.float32]:
        """m/s towards the probe along the box's beams (rows, columns), exact; NaN outside blood."""
        return self.for_frame(frame).truth(self._blood, frame)

    def overlay(self, frame: Frame) -> Overlay:
        """The estimate in colours, and its box."""
        doppler = self.for_frame(frame)
        return Overlay(self._estimate(frame), doppler.scale, _OPACITY, outline=doppler.outline)

    def _estimate(self, frame: Frame) -> NDArray[np.float32]:
        """Made once, since frames before it count, too."""
        if frame is not self._frame:
            doppler = self.for_frame(frame)
            self._following.update(frame, doppler.settings, 0.0)
            self._shown = doppler.estimate(self._blood, frame)
            self._frame = frame
            why = doppler.absence(self._blood, frame, self._shown)
            self._node.health.values["no_colour"] = why.value
        return self._shown


class SpectrumStream(SettableStream[Spectrum]):
    """``ultrasound/spectrum``: velocities at the gate over time; parameters ``spectrum.…``."""

    def __init__(self, node: SceneNode, blood: Blood) -> None:
        topic = "ultrasound/spectrum"
        super().__init__(node, topic, self._picture, Spectrum, node.scene.spectrum, "spectrum.")
        self._blood = blood
        self._following = Following(node, "spectrum.", blood)

    @property
    def lines(self) -> Sequence[NDArray[np.float64]]:
        """The gate's ends and the angle that is set."""
        return self._made.lines if self._made else ()

    def _go_on(self, made: Spectrum, before: Spectrum) -> None:
        made.go_on(before)

    def _picture(self, frame: Frame) -> NDArray[np.uint8]:
        spectrum = self.for_frame(frame)
        self._following.update(frame, spectrum.settings, spectrum.settings.steering)
        picture = spectrum.show(self._blood, frame)
        self._node.health.values["no_spectrum"] = spectrum.absence(self._blood, frame).value
        return picture


def doppler_streams(node: SceneNode, volume: Volume) -> list[FrameStream]:
    """The velocity of blood, its colour Doppler and its spectrum; flows are parameters of the node.

    Raises:
        SceneError: a structure with a flow is no tube, or its flow leads across it.
    """
    warm_up()
    blood = blood_of(node.scene, volume)
    vessels = dict(zip(node.scene.flows, blood.vessels, strict=True))

    def require(wanted: dict[str, Any]) -> None:
        for name, settings in wanted.items():
            vessels[name].require(settings)

    def use(wanted: dict[str, Any]) -> None:
        for name, settings in wanted.items():
            if settings != vessels[name].settings:
                vessels[name].use(settings)

    given = {name: Group(flow, f"flow.{name}.") for name, flow in node.scene.flows.items()}
    flows = LiveSettings(node, given, require, use)
    use(flows.values)
    colour = ColourStream(node, blood)
    velocity = FrameStream(node, "ultrasound/velocity", colour.velocity)
    return [velocity, colour, SpectrumStream(node, blood)]
