"""Strain along the beams: the tissue's own, and an estimate made of two images."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import ProbeError
from us_sim.nodes.parameters import Group, LiveSettings
from us_sim.nodes.scene_node import SceneNode
from us_sim.nodes.streams.stream import FrameStream
from us_sim.slicing.drawing.overlay import Overlay
from us_sim.slicing.frame import Frame
from us_sim.slicing.probe.probe import Probe
from us_sim.slicing.settings import Strain
from us_sim.slicing.strain import AxialStrain, FollowingEnd, compression, strain_scale
from us_sim.slicing.strain_estimate import (
    Earlier,
    Estimate,
    estimate_strain,
    require_short_windows,
    warm_up,
)


def strain_streams(node: SceneNode) -> list[FrameStream]:
    """Both, with the scene's settings as parameters ``strain.…`` that may change while running."""
    probes: list[Probe] = []

    def check(wanted: dict[str, Strain]) -> None:
        for probe in probes:
            require_short_windows(probe, wanted["strain"])

    parameters = LiveSettings(node, {"strain": Group(node.scene.strain, prefix="strain.")}, check)
    return [StrainStream(node, parameters), StrainEstimateStream(node, parameters, probes)]


class _StrainImages(FrameStream):
    """Base of both: values as such, or as colours with a note."""

    def __init__(self, node: SceneNode, topic: str, parameters: LiveSettings) -> None:
        super().__init__(node, topic, self._of)
        self._parameters = parameters
        self._end = FollowingEnd()
        self._latest: tuple[Frame, Strain, NDArray[np.float32] | None] | None = None

    @property
    def _settings(self) -> Strain:
        settings: Strain = self._parameters.values["strain"]
        return settings

    def overlay(self, frame: Frame) -> Overlay | None:
        """The strain in colours, and the quality of the compression."""
        values = self._of(frame)
        if values is None:
            return None
        most = self._settings.colours or self._end.of(values)
        scale = strain_scale(self.topic.rpartition("/")[2], most)
        return Overlay(values, scale, note=self._note(values))

    def _of(self, frame: Frame) -> NDArray[np.float32] | None:
        """The strain of a frame, once; None where there is nothing to compare it with."""
        settings = self._settings
        if self._latest is None or self._latest[:2] != (frame, settings):
            self._latest = frame, settings, self._made(frame, settings)
        return self._latest[2]

    @abstractmethod
    def _made(self, frame: Frame, settings: Strain) -> NDArray[np.float32] | None:
        """The strain of a frame."""

    @abstractmethod
    def _note(self, values: NDArray[np.float32]) -> str:
        """A line about it."""


class StrainStream(_StrainImages):
    """``ultrasound/strain``: of the tissue itself, since rest or since an image before."""

    def __init__(self, node: SceneNode, parameters: LiveSettings) -> None:
        super().__init__(node, "ultrasound/strain", parameters)
        self._strain: AxialStrain | None = None
        self._made_for: tuple[object, str] = (None, "")
        self._earlier = Earlier(lambda frame: frame.nodes)

    def prepare(self, probe: Probe) -> None:
        """Compile the kernels of strain, or load them."""
        super().prepare(probe)
        warm_up()

    def _made(self, frame: Frame, settings: Strain) -> NDArray[np.float32] | None:
        before = self._earlier.before(frame, settings.interval)
        if settings.since == "image" and before is None:
            return None
        mesh, borders = self._made_for
        if self._strain is None or mesh is not frame.mesh or borders != settings.borders:
            self._made_for = frame.mesh, settings.borders
            self._strain = AxialStrain.of(frame, sharp=settings.borders == "sharp")
        return self._strain.image(frame, before if settings.since == "image" else None)

    def _note(self, values: NDArray[np.float32]) -> str:
        pressed = compression(values)
        mean, quality = f"{100 * pressed.mean:.2g} %", f"{pressed.quality:.2f}"
        self._node.health.values |= {"strain_mean": mean, "compression_quality": quality}
        return f"mean {mean}, quality {quality}"


class StrainEstimateStream(_StrainImages):
    """``ultrasound/strain_estimate``: between two images, from their grey values alone.

    Args:
        probes: where the probe that images come of is put, for checks of parameters.
    """

    def __init__(self, node: SceneNode, parameters: LiveSettings, probes: list[Probe]) -> None:
        super().__init__(node, "ultrasound/strain_estimate", parameters)
        self._probes = probes
        self._earlier = Earlier(lambda frame: frame.pixels)
        self._correlation = 0.0

    def prepare(self, probe: Probe) -> None:
        """Compile the kernels of estimates, or load them."""
        warm_up()
        self._probes[:] = [probe]

    def _made(self, frame: Frame, settings: Strain) -> NDArray[np.float32] | None:
        before = self._earlier.before(frame, settings.interval)
        if before is None:
            return None
        try:
            found: Estimate = estimate_strain(before, frame.pixels, frame.probe, settings)
        except ProbeError as error:
            self._node.health.problem("strain estimate", f"{error}; no strain is estimated")
            return None
        self._correlation = found.correlation
        return found.strain

    def _note(self, values: NDArray[np.float32]) -> str:
        mean, correlation = f"{100 * compression(values).mean:.2g} %", f"{self._correlation:.2f}"
        self._node.health.values |= {
            "strain_estimate_mean": mean,
            "strain_correlation": correlation,
        }
        return f"mean {mean}, correlation {correlation}"
