"""Pictures of error against run time, and of cost against size."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FuncFormatter, NullFormatter

from us_sim.evaluation.tissue.points import Point

__all__ = ["exponent", "plot_errors", "plot_sizes"]

STYLES = {
    "fem": ("#0072B2", "o"),
    "fem_nonlinear": ("#D55E00", "D"),
    "fem_cg": ("#56B4E9", "s"),
    "msds": ("#009E73", "^"),
    "msds_implicit": ("#CC79A7", "v"),
}
"""A colour and a mark for each method, told apart in every common colour blindness."""
_PLACES = ((1, 0), (0, 1), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))
"""Where a name may stand beside its point: right, above, below, left, and the corners."""
_WORDS = {
    "stiffness=fitted": "fitted",
    "stiffness=algorithm_1": "Algorithm 1",
    "volume=True": "volume term",
    "volume=False": "no volume term",
}
"""Settings that change the equations, in a plot."""
_FRAME = 1000.0 / 30.0  # ms, of the paper's 30 frames a second


def plot_errors(panels: Mapping[str, Sequence[Point]], title: str, file: Path) -> None:
    """A panel each: relative error against ms a frame, both logarithmic.

    Full marks are defaults; a line joins a method's settings that solve the same equations.
    """
    columns = min(3, len(panels))
    rows = -(-len(panels) // columns)
    figure = _figure((4.6 * columns + 0.4, 4.0 * rows + 0.7))
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
    figure.suptitle(title, fontsize=13, x=0.01, ha="left")
    figure.draw_without_rendering()  # names are placed when the panels have their extents
    for panel, labels, shown in named:
        _label(panel, labels, shown)
    figure.savefig(file, dpi=figure.dpi)


def plot_sizes(points: Sequence[Point], title: str, file: Path) -> None:
    """Time a frame, and memory, against the number of nodes; with the fitted exponents."""
    figure = _figure((11.0, 4.8))
    time_panel, memory_panel = figure.subplots(1, 2)
    for panel, value, label in (
        (time_panel, lambda p: p.ms_median, "ms a frame (median)"),
        (memory_panel, lambda p: p.memory / 1e6, "MB held"),
    ):
        _sizes(panel, points, value)
        panel.set_ylabel(label)
        panel.set_xlabel("nodes")
    time_panel.axhline(_FRAME, color="0.75", lw=1, ls=":", zorder=0)
    figure.suptitle(title, fontsize=13, x=0.01, ha="left")
    figure.savefig(file, dpi=figure.dpi)


def exponent(points: Sequence[Point], value: Callable[[Point], float]) -> float:
    """k in value ~ nodes^k, by least squares of the logarithms; NaN with fewer than two sizes."""
    known = {p.nodes: value(p) for p in points if np.isfinite(value(p)) and value(p) > 0}
    if len(known) < 2:
        return float("nan")
    return float(np.polyfit(np.log(list(known)), np.log(list(known.values())), 1)[0])


def _figure(size: tuple[float, float]) -> Figure:
    figure = Figure(figsize=size, dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _errors(axes, points: Sequence[Point]) -> list[tuple[float, float, str, str]]:  # type: ignore[no-untyped-def]
    """Draw one panel; returns where which names belong, in which colour."""
    labels = []
    for method, (colour, mark) in STYLES.items():
        mine = [p for p in points if p.method == method]
        for family in sorted({_family(p) for p in mine}):
            chain = sorted((p for p in mine if _family(p) == family), key=lambda p: p.ms_median)
            x, y = [p.ms_median for p in chain], [p.rel_l2_error for p in chain]
            axes.plot(x, y, color=colour, lw=1.2, alpha=0.8, zorder=2)
            for point in chain:
                full = colour if point.default else "white"
                axes.plot(
                    point.ms_median,
                    point.rel_l2_error,
                    mark,
                    mfc=full,
                    mec=colour,
                    ms=7 if point.default else 5,
                    zorder=3,
                )
            first = next((p for p in chain if p.default), chain[0])
            words = method + (f"\n{family}" if family else "")
            labels.append((first.ms_median, first.rel_l2_error, words, colour))
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.axvline(_FRAME, color="0.75", lw=1, ls=":", zorder=0)
    _ticks(axes)
    axes.margins(0.12)
    return labels


def _family(point: Point) -> str:
    """What tells a point's equations from those of the method's default, in a few words."""
    parts = [part for part in point.setting.split(", ") if part.startswith(("stiff", "vol"))]
    return ", ".join(_WORDS.get(part, part) for part in parts)


def _label(axes, labels: list[tuple[float, float, str, str]], points: Sequence[Point]) -> None:  # type: ignore[no-untyped-def]
    """Names beside their points, where they cover least of marks and of each other."""
    figure = axes.figure
    scale = 72.0 / figure.dpi
    marks = [(p.ms_median, p.rel_l2_error) for p in points]
    centres = axes.transData.transform(marks) * scale if marks else []
    taken = [(x - 4, y - 4, x + 4, y + 4) for x, y in centres]
    low_x, low_y = axes.transAxes.transform((0, 0)) * scale
    high_x, high_y = axes.transAxes.transform((1, 1)) * scale
    for x, y, words, colour in labels:
        at_x, at_y = axes.transData.transform((x, y)) * scale
        lines = words.split("\n")
        width, height = 4.6 * max(map(len, lines)), 10.0 * len(lines)
        best = None
        for dx, dy in _PLACES:
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


def _sizes(axes, points: Sequence[Point], value: Callable[[Point], float]) -> None:  # type: ignore[no-untyped-def]
    ends: list[tuple[int, float, str, str]] = []
    for method, (colour, mark) in STYLES.items():
        mine = sorted((p for p in points if p.method == method), key=lambda p: p.nodes)
        mine = [p for p in mine if np.isfinite(value(p)) and value(p) > 0]
        if not mine:
            continue
        axes.plot(
            [p.nodes for p in mine],
            [value(p) for p in mine],
            mark + "-",
            color=colour,
            ms=6,
            lw=1.4,
        )
        power = exponent(mine, value)
        words = method + (f"  ~ n$^{{{power:.2f}}}$" if np.isfinite(power) else "")
        ends.append((mine[-1].nodes, value(mine[-1]), words, colour))
    axes.set_xscale("log")
    axes.set_yscale("log")
    sizes = sorted({p.nodes for p in points})
    axes.set_xticks(sizes, [f"{n:,}" for n in sizes])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    axes.grid(True, which="major", color="0.93")
    axes.spines[["top", "right"]].set_visible(False)
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
    axes.tick_params(labelsize=8)


def _percent(value: float, _: int) -> str:
    if value >= 1e-5:
        return f"{100 * value:g} %"
    return f"$10^{{{np.log10(100 * value):.0f}}}$ %"


def _ticks(axes) -> None:  # type: ignore[no-untyped-def]
    axes.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    axes.yaxis.set_major_formatter(FuncFormatter(_percent))
    axes.grid(True, which="major", color="0.93")
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8.5)
