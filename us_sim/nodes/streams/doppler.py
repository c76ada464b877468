"""Topics of moving blood: its exact velocity, colour Doppler and pulsed-wave Doppler."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.parameter import Parameter

from us_sim.nodes.parameters import LiveSettings
from us_sim.nodes.scene_node import SceneNode
from us_sim.nodes.streams.stream import AdjustableImager, FrameStream
from us_sim.scene.building import build_blood
from us_sim.slicing.drawing.overlay import Overlay
from us_sim.slicing.flow.blood import Blood
from us_sim.slicing.flow.doppler import ColourDoppler, Spectrum, find_nearest_vessel, warm_up
from us_sim.slicing.frame import Frame
from us_sim.slicing.settings import DopplerSettings
from us_sim.volume.volume import Volume

EVERY_S = 0.2  # of the frames' time, between two searches for the vessel
_OPACITY = 0.9


def create_doppler_streams(node: SceneNode, volume: Volume) -> list[FrameStream]:
    """Create the streams of blood: velocity, colour Doppler, spectrum; flows are parameters."""
    warm_up()
    blood = build_blood(node.scene, volume)
    given = {f"flow.{name}.": flow for name, flow in node.scene.flows.items()}
    vessels = dict(zip(given, blood.vessels, strict=True))

    def require(wanted: dict[str, Any]) -> None:
        for name, settings in wanted.items():
            vessels[name].find_flow_sign(settings)

    def use(wanted: dict[str, Any]) -> None:
        for name, settings in wanted.items():
            if settings != vessels[name].settings:
                vessels[name].apply_settings(settings)

    use(LiveSettings(node, given, require, use).values)
    return [*_colour_streams(node, blood), _spectrum_stream(node, blood)]


class VesselFollower:
    """Keeps a node's parameters ``lateral`` and ``depth`` on a vessel while ``follow`` is set."""

    def __init__(self, node: SceneNode, prefix: str, blood: Blood) -> None:
        self._node, self._prefix, self._blood = node, prefix, blood
        self._updated = 0.0  # s, of the frame's time

    def update(self, frame: Frame, settings: DopplerSettings, steering: float) -> None:
        """Set the place for the frames to come; the beams are steered by ``steering`` (rad)."""
        if not settings.follow or 0.0 <= frame.time - self._updated < EVERY_S:
            return
        self._updated = frame.time
        depth = 0.5 * frame.probe.depth if settings.depth is None else settings.depth
        place = find_nearest_vessel(self._blood, frame, settings.lateral, depth, steering)
        if place is None:
            return
        for name, value in zip(("lateral", "depth"), place, strict=True):
            self._node.set_parameters([Parameter(f"{self._prefix}{name}", value=value)])


def _colour_streams(node: SceneNode, blood: Blood) -> list[FrameStream]:
    """Create ``ultrasound/velocity``, exact along the beams, and its estimate, by ``colour.…``."""
    colour = AdjustableImager(node, ColourDoppler, node.scene.colour, "colour.")
    following = VesselFollower(node, "colour.", blood)

    @lru_cache(maxsize=1)  # frames before it count, too
    def estimate(frame: Frame) -> NDArray[np.float32]:
        doppler = colour.for_frame(frame)
        following.update(frame, doppler.settings, 0.0)
        shown = doppler.estimate_velocity(blood, frame)
        node.health.values["no_colour"] = doppler.explain_absence(blood, frame, shown).value
        return shown

    def overlay(frame: Frame) -> Overlay:
        doppler = colour.for_frame(frame)
        return Overlay(estimate(frame), doppler.scale, _OPACITY, outline=doppler.outline)

    def exact(frame: Frame) -> NDArray[np.float32]:
        return colour.for_frame(frame).compute_true_velocity(blood, frame)

    topic, prepare = "ultrasound/velocity_estimate", colour.prepare_for_probe
    return [
        FrameStream(node, "ultrasound/velocity", exact),
        FrameStream(node, topic, estimate, prepare=prepare, overlay=overlay),
    ]


def _spectrum_stream(node: SceneNode, blood: Blood) -> FrameStream:
    """Create ``ultrasound/spectrum``: velocities at the gate over time, by ``spectrum.…``."""
    spectra = AdjustableImager(
        node, Spectrum, node.scene.spectrum, "spectrum.", Spectrum.take_over_picture
    )
    following = VesselFollower(node, "spectrum.", blood)

    def draw(frame: Frame) -> NDArray[np.uint8]:
        spectrum = spectra.for_frame(frame)
        following.update(frame, spectrum.settings, spectrum.settings.steering)
        picture = spectrum.draw_sweep(blood, frame)
        node.health.values["no_spectrum"] = spectrum.explain_absence(blood, frame).value
        return picture

    return FrameStream(
        *(node, "ultrasound/spectrum", draw),
        prepare=spectra.prepare_for_probe,
        lines=lambda: spectra.made.lines if spectra.made else [],  # gate's ends, and the angle
    )
