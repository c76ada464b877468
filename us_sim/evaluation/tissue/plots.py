"""Pictures of error against run time, and of cost against size."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, NullFormatter

from us_sim.evaluation.figure import key_beside, new_figure, plain, save
from us_sim.evaluation.power_law import exponent
from us_sim.evaluation.tissue.points import Point
from us_sim.evaluation.tissue_methods import TISSUE_METHODS

_LINES = ("-", "--", "-.", ":")  # of a method's settings that solve the same equations
_FRAME = 1000.0 / 30.0  # ms, at the paper's 30 frames a second


def plot_errors(panels: Mapping[str, Sequence[Point]], title: str, file: Path) -> None:
    """A panel each: relative error against ms a frame, both logarithmic.

    Full marks are defaults; a line joins a method's settings that solve the same equations.
    """
    columns = min(3, len(panels))
    rows = -(-len(panels) // columns)
    figure = new_figure(4.6 * columns + 0.4, 4.0 * rows + 0.7, title)
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
    keys: dict[str, Any] = {}
    for panel in axes.flat:
        handles, labels = panel.get_legend_handles_labels()
        keys |= dict(zip(labels, handles, strict=True))
    figure.legend(keys.values(), keys, loc="outside right upper", fontsize=8, frameon=False)
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
        panel.set(xlabel="nodes", ylabel=label)
    time_panel.axhline(_FRAME, color="0.75", lw=1, ls=":", zorder=0)
    save(figure, file)


def _errors(axes: Axes, points: Sequence[Point]) -> None:
    for name, method in TISSUE_METHODS.items():
        families: dict[str, list[Point]] = {}
        for point in sorted(points, key=lambda p: p.ms_median):
            if point.method == name:
                families.setdefault(method.family(point.setting), []).append(point)
        for number, (family, chain) in enumerate(sorted(families.items())):
            x, y = [p.ms_median for p in chain], [p.rel_l2_error for p in chain]
            look: Any = {"color": method.colour, "label": f"{name}, {family}" if family else name}
            axes.plot(x, y, _LINES[number] + method.mark, mfc="white", ms=5, lw=1.2, **look)
            for p in (p for p in chain if p.default):
                axes.plot(p.ms_median, p.rel_l2_error, method.mark, color=method.colour, ms=7)
    axes.set(xscale="log", yscale="log")
    axes.axvline(_FRAME, color="0.75", lw=1, ls=":", zorder=0)
    plain(axes)
    axes.yaxis.set_major_formatter(FuncFormatter(_percent))
    axes.margins(0.12)


def _sizes(axes: Axes, points: Sequence[Point], value: Callable[[Point], float]) -> None:
    for name, method in TISSUE_METHODS.items():
        mine = sorted((p for p in points if p.method == name), key=lambda p: p.nodes)
        mine = [p for p in mine if np.isfinite(value(p)) and value(p) > 0]
        if not mine:
            continue
        costs: dict[float, float] = {p.nodes: value(p) for p in mine}
        power = exponent(costs)
        label = name + (f"  ~ n$^{{{power:.2f}}}$" if np.isfinite(power) else "")
        look: Any = {"color": method.colour, "label": label}
        axes.plot(list(costs), list(costs.values()), method.mark + "-", ms=6, lw=1.4, **look)
    axes.set(xscale="log", yscale="log")
    plain(axes)
    sizes = sorted({p.nodes for p in points})
    axes.set_xticks(sizes, [f"{n:,}" for n in sizes])
    axes.tick_params(labelsize=7.5)
    axes.xaxis.set_minor_formatter(NullFormatter())
    key_beside(axes)


def _percent(value: float, _: int) -> str:
    if value >= 1e-5:
        return f"{100 * value:g} %"
    return f"$10^{{{np.log10(100 * value):.0f}}}$ %"
