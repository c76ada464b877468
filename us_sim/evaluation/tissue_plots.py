"""Pictures of error against run time, and of cost against size."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from us_sim.evaluation.tissue_points import Point

__all__ = ["exponent", "plot_errors", "plot_sizes"]

#: A colour and a mark for each method, told apart in every common colour blindness.
STYLES = {
    "fem": ("#0072B2", "o"),
    "fem_nonlinear": ("#D55E00", "D"),
    "fem_cg": ("#56B4E9", "s"),
    "msds": ("#009E73", "^"),
    "msds_implicit": ("#CC79A7", "v"),
}
_FRAME = 1000.0 / 30.0  # ms, of the paper's 30 frames a second


def plot_errors(panels: dict[str, Sequence[Point]], title: str, file: Path) -> None:
    """A panel each: relative error against ms a frame, both logarithmic.

    Full marks are defaults; a line joins a method's settings that solve the same equations.
    """
    columns = min(3, len(panels))
    rows = -(-len(panels) // columns)
    figure = _figure((4.6 * columns + 0.4, 4.0 * rows + 0.7))
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for number, (name, points) in enumerate(panels.items()):
        panel = axes[divmod(number, columns)]
        _errors(panel, [p for p in points if np.isfinite(p.ms_median * p.rel_l2_error)])
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
    figure.savefig(file, dpi=110)


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
    figure.savefig(file, dpi=110)


def exponent(points: Sequence[Point], value: Callable[[Point], float]) -> float:
    """k in value ~ nodes^k, by least squares of the logarithms; NaN with fewer than two sizes."""
    known = {p.nodes: value(p) for p in points if np.isfinite(value(p)) and value(p) > 0}
    if len(known) < 2:
        return float("nan")
    return float(np.polyfit(np.log(list(known)), np.log(list(known.values())), 1)[0])


def _figure(size: tuple[float, float]) -> Figure:
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _errors(axes, points: Sequence[Point]) -> None:  # type: ignore[no-untyped-def]
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
    axes.margins(0.14)
    _label(axes, labels)


def _family(point: Point) -> str:
    """What tells a point's equations from those of the method's default, in a few words."""
    parts = [part for part in point.setting.split(", ") if part.startswith(("stiff", "vol"))]
    return ", ".join(part.replace("stiffness=", "").replace("=", " ") for part in parts)


def _label(axes, labels: list[tuple[float, float, str, str]]) -> None:  # type: ignore[no-untyped-def]
    """Names beside their points, moved apart where they would touch."""
    last = -np.inf
    for x, y, words, colour in sorted(labels, key=lambda entry: entry[1]):
        height = np.log10(y)
        place = max(height, last + 0.16 * (1 + words.count("\n")))
        axes.annotate(
            words,
            (x, y),
            xytext=(9, 22 * (place - height) / 0.16 * 0.6),
            textcoords="offset points",
            color=colour,
            fontsize=8.5,
            va="center",
            linespacing=0.95,
            zorder=4,
        )
        last = place


def _sizes(axes, points: Sequence[Point], value: Callable[[Point], float]) -> None:  # type: ignore[no-untyped-def]
    ends = []
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
        words = method + (f"  n^{power:.2f}" if np.isfinite(power) else "")
        ends.append([mine[-1].nodes, value(mine[-1]), words, colour])
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


def _ticks(axes) -> None:  # type: ignore[no-untyped-def]
    axes.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    axes.grid(True, which="major", color="0.93")
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8.5)
