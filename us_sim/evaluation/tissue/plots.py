"""Pictures of error against run time, and of cost against size."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, NullFormatter

from us_sim.evaluation.figure import new_figure, plain, save
from us_sim.evaluation.power_law import exponent
from us_sim.evaluation.tissue.points import Point
from us_sim.evaluation.tissue_methods import TISSUE_METHODS

__all__ = ["plot_errors", "plot_sizes"]

_DIRECTIONS = ((1, 0), (0, 1), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))
"""Where a name may stand beside its point: right, above, below, left, and the corners."""

_FRAME = 1000.0 / 30.0  # ms, at the paper's 30 frames a second


def plot_errors(panels: Mapping[str, Sequence[Point]], title: str, file: Path) -> None:
    """A panel each: relative error against ms a frame, both logarithmic.

    Full marks are defaults; a line joins a method's settings that solve the same equations.
    """
    columns = min(3, len(panels))
    rows = -(-len(panels) // columns)
    figure = new_figure(4.6 * columns + 0.4, 4.0 * rows + 0.7, title)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    named = []
    for number, (name, points) in enumerate(panels.items()):
        panel = axes[divmod(number, columns)]
        shown = [p for p in points if np.isfinite(p.ms_median * p.rel_l2_error)]
        named.append((panel, _errors(panel, shown), shown))
        panel.set_title(name, fontsize=11, loc="left")
    for panel in axes.flat[len(panels) :]:
        panel.set_visible(False)
    for panel in axes[:, 0]:
        panel.set_ylabel("relative L2 error of the nodes")
    for column in range(columns):
        lowest = max(row for row in range(rows) if axes[row, column].get_visible())
        axes[lowest, column].set_xlabel("ms a frame (median)")
        axes[lowest, column].tick_params(labelbottom=True)
    figure.draw_without_rendering()  # names are placed when the panels have their extents
    for panel, labels, shown in named:
        _label(panel, labels, shown)
    save(figure, file)


def plot_sizes(points: Sequence[Point], title: str, file: Path) -> None:
    """Time a frame, and memory, against the number of nodes; with the fitted exponents."""
    figure = new_figure(11.0, 4.8, title)
    time_panel, memory_panel = figure.subplots(1, 2)
    for panel, value, label in (
        (time_panel, lambda p: p.ms_median, "ms a frame (median)"),
        (memory_panel, lambda p: p.memory / 1e6, "MB held"),
    ):
        _sizes(panel, points, value)
        panel.set_ylabel(label)
        panel.set_xlabel("nodes")
    time_panel.axhline(_FRAME, color="0.75", lw=1, ls=":", zorder=0)
    save(figure, file)


def _errors(axes: Axes, points: Sequence[Point]) -> list[tuple[float, float, str, str]]:
    """Draw one panel; returns where which names belong, in which colour."""
    labels = []
    for name, method in TISSUE_METHODS.items():
        families: dict[str, list[Point]] = {}
        for point in sorted(points, key=lambda p: p.ms_median):
            if point.method == name:
                families.setdefault(method.family(point.setting), []).append(point)
        for family, chain in sorted(families.items()):
            x, y = [p.ms_median for p in chain], [p.rel_l2_error for p in chain]
            axes.plot(x, y, color=method.colour, lw=1.2, alpha=0.8, zorder=2)
            for point in chain:
                axes.plot(
                    point.ms_median,
                    point.rel_l2_error,
                    method.mark,
                    mfc=method.colour if point.default else "white",
                    mec=method.colour,
                    ms=7 if point.default else 5,
                    zorder=3,
                )
            first = next((p for p in chain if p.default), chain[0])
            words = name + (f"\n{family}" if family else "")
            labels.append((first.ms_median, first.rel_l2_error, words, method.colour))
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.axvline(_FRAME, color="0.75", lw=1, ls=":", zorder=0)
    plain(axes)
    axes.yaxis.set_major_formatter(FuncFormatter(_percent))
    axes.margins(0.12)
    return labels


def _label(
    axes: Axes, labels: list[tuple[float, float, str, str]], points: Sequence[Point]
) -> None:
    """Names beside their points, where they cover least of marks and of each other."""
    figure = axes.figure
    scale = 72.0 / figure.dpi
    marks = [(p.ms_median, p.rel_l2_error) for p in points]
    centres: Any = axes.transData.transform(marks) * scale if marks else []
    taken = [(x - 4, y - 4, x + 4, y + 4) for x, y in centres]
    low_x, low_y = axes.transAxes.transform((0, 0)) * scale
    high_x, high_y = axes.transAxes.transform((1, 1)) * scale
    for x, y, words, colour in labels:
        at_x, at_y = axes.transData.transform((x, y)) * scale
        lines = words.split("\n")
        width, height = 4.6 * max(map(len, lines)), 10.0 * len(lines)
        best = None
        for dx, dy in _DIRECTIONS:
            left = at_x + (9 if dx > 0 else -9 - width if dx < 0 else -width / 2)
            bottom = at_y - height / 2 + dy * (height / 2 + 8)
            box = (left, bottom, left + width, bottom + height)
            cost = sum(_overlap(box, other) for other in taken)
            inside = _overlap(box, (low_x, low_y, high_x, high_y))
            cost += 3.0 * (width * height - inside)
            if best is None or cost < best[0]:
                best = (cost, box)
        assert best is not None
        box = best[1]
        taken.append(box)
        axes.annotate(
            words,
            (x, y),
            xytext=(box[0] - at_x, (box[1] + box[3]) / 2 - at_y),
            textcoords="offset points",
            color=colour,
            fontsize=8.5,
            va="center",
            linespacing=0.95,
            zorder=4,
            path_effects=[withStroke(linewidth=2.5, foreground="white")],
        )


def _overlap(one: Sequence[float], other: Sequence[float]) -> float:
    """Area that two boxes (left, bottom, right, top) share."""
    width = min(one[2], other[2]) - max(one[0], other[0])
    height = min(one[3], other[3]) - max(one[1], other[1])
    return max(width, 0.0) * max(height, 0.0)


def _sizes(axes: Axes, points: Sequence[Point], value: Callable[[Point], float]) -> None:
    ends: list[tuple[int, float, str, str]] = []
    for name, method in TISSUE_METHODS.items():
        mine = sorted((p for p in points if p.method == name), key=lambda p: p.nodes)
        mine = [p for p in mine if np.isfinite(value(p)) and value(p) > 0]
        if not mine:
            continue
        axes.plot(
            [p.nodes for p in mine],
            [value(p) for p in mine],
            method.mark + "-",
            color=method.colour,
            ms=6,
            lw=1.4,
        )
        power = exponent({p.nodes: value(p) for p in mine})
        words = name + (f"  ~ n$^{{{power:.2f}}}$" if np.isfinite(power) else "")
        ends.append((mine[-1].nodes, value(mine[-1]), words, method.colour))
    axes.set_xscale("log")
    axes.set_yscale("log")
    plain(axes)
    sizes = sorted({p.nodes for p in points})
    axes.set_xticks(sizes, [f"{n:,}" for n in sizes])
    axes.xaxis.set_minor_formatter(NullFormatter())
    low, high = np.log10(axes.get_ylim())
    gap, last = 0.055 * (high - low), -np.inf
    for nodes, at, words, colour in sorted(ends, key=lambda end: end[1]):
        place = max(np.log10(at), last + gap)
        axes.annotate(
            words,
            (nodes, 10**place),
            xytext=(8, 0),
            textcoords="offset points",
            color=colour,
            fontsize=9,
            va="center",
            annotation_clip=False,
        )
        last = place


def _percent(value: float, _: int) -> str:
    if value >= 1e-5:
        return f"{100 * value:g} %"
    return f"$10^{{{np.log10(100 * value):.0f}}}$ %"
