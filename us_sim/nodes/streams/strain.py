"""Strain along the beams: the tissue's own, and an estimate made of two images."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import ProbeError
from us_sim.nodes.parameters import LiveSettings
from us_sim.nodes.scene_node import SceneNode
from us_sim.nodes.streams.stream import FrameStream
from us_sim.slicing.drawing.overlay import Overlay
from us_sim.slicing.frame import Frame
from us_sim.slicing.probe.probe import Probe
from us_sim.slicing.settings import StrainSettings
from us_sim.slicing.strain import AdaptiveScale, AxialStrain, make_strain_scale, measure_compression
from us_sim.slicing.strain_estimate import (
    FrameHistory,
    estimate_strain,
    require_short_windows,
    warm_up,
)

Values = NDArray[np.float32]


def create_strain_streams(node: SceneNode) -> list[FrameStream]:
    """Create the streams of both strains; the scene's settings are parameters ``strain.…``."""
    probes: list[Probe] = []  # that images come of

    def check(wanted: dict[str, StrainSettings]) -> None:
        for probe in probes:
            require_short_windows(probe, wanted["strain."])

    def prepare(probe: Probe) -> None:
        warm_up()
        probes[:] = [probe]

    live = LiveSettings(node, {"strain.": node.scene.strain}, check)
    return [_tissue_strain(node, live), _strain_estimate(node, live, prepare)]


def _strain_stream(
    node: SceneNode,
    topic: str,
    live: LiveSettings,
    make: Callable[[Frame, StrainSettings], Values | None],
    note: Callable[[Values], str],
    prepare: Callable[[Probe], None],
) -> FrameStream:
    """Create a stream of the strain that ``make`` returns, None without an image to compare with.

    Its overlay is the strain as colours, with the line about it that ``note`` returns.
    """
    end = AdaptiveScale()
    make_once = lru_cache(maxsize=1)(make)

    def draw(frame: Frame) -> Values | None:
        return make_once(frame, live.values["strain."])

    def overlay(frame: Frame) -> Overlay | None:
        values = draw(frame)
        if values is None:
            return None
        most = live.values["strain."].colours or end.update_end(values)
        return Overlay(values, make_strain_scale(topic.rpartition("/")[2], most), note=note(values))

    return FrameStream(node, topic, draw, prepare=prepare, overlay=overlay)


def _tissue_strain(node: SceneNode, live: LiveSettings) -> FrameStream:
    """Create ``ultrasound/strain``: of the tissue itself, since rest or since an image before."""
    earlier = FrameHistory(lambda frame: frame.nodes)
    made: tuple[object, AxialStrain] | None = None  # the last mesh, and its strain

    def make(frame: Frame, settings: StrainSettings) -> Values | None:
        nonlocal made
        before = earlier.get_before(frame, settings.interval)
        if settings.since == "image" and before is None:
            return None
        if made is None or made[0] is not frame.mesh:
            made = frame.mesh, AxialStrain.from_frame(frame)
        return made[1].compute_strain(frame, before if settings.since == "image" else None)

    def note(values: Values) -> str:
        pressed = measure_compression(values)
        mean, quality = f"{100 * pressed.mean:.2g} %", f"{pressed.quality:.2f}"
        node.health.values |= {"strain_mean": mean, "compression_quality": quality}
        return f"mean {mean}, quality {quality}"

    return _strain_stream(*(node, "ultrasound/strain", live, make, note), lambda _: warm_up())


def _strain_estimate(
    node: SceneNode, live: LiveSettings, prepare: Callable[[Probe], None]
) -> FrameStream:
    """Create ``ultrasound/strain_estimate``: between two images, from their grey values alone."""
    earlier, correlation = FrameHistory(lambda frame: frame.pixels), 0.0

    def make(frame: Frame, settings: StrainSettings) -> Values | None:
        nonlocal correlation
        before = earlier.get_before(frame, settings.interval)
        if before is None:
            return None
        try:
            found = estimate_strain(before, frame.pixels, frame.probe, settings)
        except ProbeError as error:
            node.health.count_problem("strain estimate", f"{error}; no strain is estimated")
            return None
        correlation = found.correlation
        return found.strain

    def note(values: Values) -> str:
        mean, match = f"{100 * measure_compression(values).mean:.2g} %", f"{correlation:.2f}"
        node.health.values |= {"strain_estimate_mean": mean, "strain_correlation": match}
        return f"mean {mean}, correlation {match}"

    return _strain_stream(*(node, "ultrasound/strain_estimate", live, make, note), prepare)
