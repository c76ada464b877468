"""Pictures of latency hop by hop, of where processor time goes, and of latency over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from us_sim.evaluation.figure import key_beside, new_figure, plain, save
from us_sim.evaluation.latency.cases import RATE
from us_sim.evaluation.latency.points import HAND, Point

_WAY = {"probe/pose": "#c6dbef", "tissue/nodes": "#6baed6", "ultrasound/image": "#08519c"}
"""The hops that an image waits for, one after another."""
_NODES = {
    "path_player": "0.75",
    "probe_tracker": "#c6dbef",
    "tissue_deformer": "#6baed6",
    "skin_deformer": "#fdae6b",
    "slice_interpolator": "#08519c",
    "session_recorder": "#74c476",
    "one process": "#9e9ac8",
}


def plot_hops(points: Sequence[Point], file: Path) -> None:
    """A bar a case: what each hop adds to the median, and the 99th percentile of the whole."""
    shown = [point for point in points if len(point.images)]
    figure, panel = _bars(shown, "From the tracker's pose to its image: bars median, dots p99")
    for place, point in enumerate(shown):
        left = 0.0
        for topic, colour in _WAY.items():
            right = point.latency(topic, 50)
            label = topic if place == 0 else None
            panel.barh(place, right - left, left=left, color=colour, height=0.7, label=label)
            left = right
        panel.plot(point.latency("ultrasound/image", 99), place, "o", color="#d62728", ms=5)
    panel.axvline(1e3 / RATE, color="0.5", lw=1, ls=":", label="16.7 ms: 60 Hz")
    panel.set_xlabel("ms from the pose")
    panel.set_xlim(left=0)
    ways = panel.secondary_xaxis("top", functions=(_as_way, _as_time))
    ways.set_xlabel("mm that a hand moves meanwhile, at 100 mm/s", fontsize=9)
    ways.tick_params(labelsize=8.5)
    _finish(figure, panel, file)


def plot_usage(points: Sequence[Point], file: Path) -> None:
    """A bar a case: cores that each node keeps busy."""
    shown = [point for point in points if point.usage]
    figure, panel = _bars(shown, "Cores kept busy, by node")
    seen: set[str] = set()
    for place, point in enumerate(shown):
        left = 0.0
        for node, use in point.usage.items():
            width = use.processor if np.isfinite(use.processor) else 0.0
            label = None if node in seen else node
            seen.add(node)
            colour = _NODES.get(node, "0.4")
            panel.barh(place, width, left=left, color=colour, height=0.7, label=label)
            left += width
    panel.set_xlabel("cores")
    _finish(figure, panel, file)


def plot_over_time(point: Point, file: Path) -> None:
    """The age of every image of one case, and the memory of its processes."""
    figure = new_figure(10, 5.6, str(point.case))
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    came = np.array([arrival for _, arrival in point.images], dtype=float)
    time = 1e-9 * (came - came[0]) if len(came) else came
    above.plot(time, point.ages("ultrasound/image"), ".", color="#08519c", ms=2)
    above.set_ylabel("ms from a pose to its image")
    above.set_ylim(bottom=0)
    for node, use in point.usage.items():
        memory = [1e-6 * each.memory for each in use.uses]
        below.plot(use.times, memory, color=_NODES.get(node, "0.4"), label=node)
    below.set_ylabel("memory, MB")
    below.set_ylim(bottom=0)
    below.set_xlabel("time, s")
    for panel in (above, below):
        plain(panel)
    key_beside(below)
    save(figure, file)


def _bars(points: Sequence[Point], title: str) -> tuple[Figure, Axes]:
    figure = new_figure(11, 1.6 + 0.34 * max(1, len(points)), title)
    panel: Axes = figure.subplots()
    panel.set_yticks(range(len(points)), [str(point.case) for point in points])
    panel.invert_yaxis()
    return figure, panel


def _finish(figure: Figure, panel: Axes, file: Path) -> None:
    names = panel.get_yticklabels()
    panel.grid(True, axis="x", color="0.93")
    panel.set_axisbelow(True)
    panel.spines[["top", "right"]].set_visible(False)
    panel.tick_params(labelsize=8.5)
    panel.set_yticks(panel.get_yticks(), [name.get_text() for name in names])
    key_beside(panel)
    save(figure, file)


def _as_way(milliseconds: ArrayLike) -> NDArray[np.float64]:
    """mm of a hand."""
    return HAND * np.asarray(milliseconds, dtype=np.float64)


def _as_time(millimetres: ArrayLike) -> NDArray[np.float64]:
    return np.asarray(millimetres, dtype=np.float64) / HAND
