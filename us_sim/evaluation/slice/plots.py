"""Pictures of error against run time, and of run time against mesh and image size."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import LogFormatterMathtext, NullFormatter

from us_sim.evaluation.figure import key_beside, new_figure, plain, save
from us_sim.evaluation.slice.methods import OURS, SLICING_METHODS
from us_sim.evaluation.slice.points import Point

_FRAME = 1000.0 / 60.0  # ms, at 60 images a second
_TENTH = 0.1  # voxels
_SMALLEST = 1e-14  # voxels, drawn where a method is exact to the last bit


def plot_errors(panels: Mapping[str, Sequence[Point]], file: Path) -> None:
    """A panel each: the worst pixel's distance from its true place against ms an image."""
    title = "Error against run time (dotted: 60 images a second; dashed: a tenth of a voxel)"
    figure = new_figure(3.9 * len(panels) + 2.2, 4.4, title)
    axes = figure.subplots(1, len(panels), squeeze=False, sharex=True, sharey=True)[0]
    for panel, (title, points) in zip(axes, panels.items(), strict=True):
        for name, method in SLICING_METHODS.items():
            mine = [p for p in points if p.method == name and np.isfinite(p.ms_median)]
            mine.sort(key=lambda p: p.threads)
            x = [p.cpu_ms_median if p.threads == 1 else p.ms_median for p in mine]
            y = [max(p.max_voxel_error, _SMALLEST) for p in mine]
            panel.plot(x, y, "-", color=method.colour, lw=1.2, alpha=0.8)
            for at, error, point in zip(x, y, mine, strict=True):
                fill = method.colour if point.threads == 1 else "white"
                panel.plot(at, error, method.mark, mfc=fill, mec=method.colour, ms=8)
        panel.set_title(title, fontsize=11, loc="left")
        panel.set_xlabel("ms an image (median; one thread: processor time)", fontsize=9)
        panel.axvline(_FRAME, color="0.75", lw=1, ls=":", zorder=0)
        panel.set(xscale="log", yscale="log")
        panel.margins(0.08, 0.14)
        panel.axhline(_TENTH, color="0.75", lw=1, ls="--", zorder=0)
        plain(panel)
        panel.yaxis.set_major_formatter(LogFormatterMathtext())
    _keys(axes[-1], {p.method for points in panels.values() for p in points})
    axes[0].set_ylabel("worst pixel's error at rest, voxels")
    save(figure, file)


def plot_meshes(points: Sequence[Point], title: str, file: Path) -> None:
    """Processor time of an image against the mesh's nodes."""
    figure = new_figure(8.2, 5.0, title)
    panel = figure.subplots()
    _times(panel, points, lambda p: p.nodes)
    panel.set_xlabel("nodes of the mesh")
    panel.set_xticks(nodes := sorted({p.nodes for p in points}), [f"{n:,}" for n in nodes])
    panel.tick_params(labelsize=8)
    save(figure, file)


def plot_pixels(points: Sequence[Point], title: str, file: Path) -> None:
    """Processor time of an image against its pixels, with a line in proportion to them."""
    figure = new_figure(8.2, 5.0, title)
    panel = figure.subplots()
    _times(panel, points, lambda p: p.size**2)
    first = [p for p in points if p.method == OURS and p.threads == 1]
    if first:
        largest = max(first, key=lambda p: p.size)
        pixels = np.array([min(p.size for p in first), largest.size]) ** 2
        proportional = largest.cpu_ms_median * pixels / pixels[-1]
        panel.plot(pixels, proportional, "--", color="0.6", lw=1, zorder=0)
    sizes = sorted({p.size for p in points})
    panel.set_xticks([n**2 for n in sizes], [f"{n} × {n}" for n in sizes])
    panel.set_xlabel("pixels (dashed: in proportion)")
    save(figure, file)


def _times(panel: Axes, points: Sequence[Point], across: Callable[[Point], float]) -> None:
    for name, method in SLICING_METHODS.items():
        mine = [p for p in points if p.method == name and p.threads == 1]
        mine = sorted((p for p in mine if np.isfinite(p.cpu_ms_median)), key=across)
        x, y = [across(p) for p in mine], [p.cpu_ms_median for p in mine]
        panel.plot(x, y, method.mark + "-", color=method.colour, ms=6, lw=1.4)
    panel.set(xscale="log", yscale="log")
    panel.axhline(_FRAME, color="0.75", lw=1, ls=":", zorder=0)
    panel.set_ylabel("processor time of an image, ms (median, one thread)")
    plain(panel)
    panel.xaxis.set_minor_formatter(NullFormatter())
    _keys(panel, {p.method for p in points}, two_threads=False)


def _keys(panel: Axes, known: set[str], two_threads: bool = True) -> None:
    """What colours and marks mean, beside a panel."""
    keys = [
        Line2D([], [], color=method.colour, marker=method.mark, label=name)
        for name, method in SLICING_METHODS.items()
        if name in known
    ]
    if two_threads:
        words = "two threads, wall clock"
        keys.append(Line2D([], [], color="0.4", ls="", marker="o", mfc="white", label=words))
    key_beside(panel, keys)
