"""The picture of a score: the probe's way over the skin; force and areas over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np

from us_sim.scoring.exercise import Step
from us_sim.scoring.metrics import Scan
from us_sim.volume.structure_names import choose_colour

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MM = 1e3


def draw_score(file: Path | IO[bytes], title: str, scan: Scan, steps: Sequence[Step] = ()) -> None:
    """Write a PNG of the way over the skin, and of force and areas over time.

    A scan with neither has the speed over time.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 5.2), dpi=110, layout="constrained")
    figure.suptitle(title, fontsize=12, x=0.01, ha="left")
    is_measured = any(np.isfinite(each.fraction).any() for each in scan.sections.values())
    over_time = [_draw_force] * (scan.force is not None) + [_draw_areas] * is_measured
    over_time = over_time or [_draw_speed]
    grid = figure.add_gridspec(len(over_time), 2, width_ratios=(1, 1.4))
    _draw_way(figure.add_subplot(grid[:, 0]), scan, steps)
    shared: Axes | None = None
    for row, draw in enumerate(over_time):
        axes = shared = figure.add_subplot(grid[row, 1], sharex=shared)
        draw(axes, scan)
    axes.set_xlabel("s since the first pose")
    for axes in figure.axes:
        if axes.get_label() != "<colorbar>":
            axes.grid(True, color="0.93")
            axes.set_axisbelow(True)
            axes.spines[["top", "right"]].set_visible(False)
            axes.tick_params(labelsize=8.5)
    figure.savefig(file, format="png")


def _draw_way(axes: Axes, scan: Scan, steps: Sequence[Step]) -> None:
    motion, force = scan.motion, scan.force
    x, y = _MM * motion.positions[:, :2].T
    axes.plot(x, y, color="0.8", lw=1, zorder=1)
    if force is None:
        axes.plot(x, y, color="C0", lw=1.2, zorder=2)
    else:
        newtons = force.interpolate_at(motion.times)
        upwards = np.argsort(newtons)  # the strongest on top
        shown = axes.scatter(x[upwards], y[upwards], 9, newtons[upwards], cmap="viridis")
        axes.figure.colorbar(shown, ax=axes, label="force, N", shrink=0.7)
    for name, line in scan.lines.items():
        way = _MM * line.points[:, :2].T
        axes.plot(*way, color=choose_colour(name), lw=3, alpha=0.5, label=name, zorder=0)
    for step in steps:
        if step.target is not None and len(step.target) == 1:
            x, y = _MM * step.target[0, :2]
            axes.scatter(x, y, 150, "none", lw=2, edgecolors="C2" if step.is_done else "C3")
    if scan.lines:
        axes.legend(fontsize=8, frameon=False)
    axes.set(xlabel="x, mm", ylabel="y, mm", title="Way of the probe's face over the skin")
    axes.set_aspect("equal", adjustable="datalim")


def _draw_force(axes: Axes, scan: Scan) -> None:
    assert scan.force is not None
    axes.plot(scan.force.times, scan.force.newtons, lw=1)
    axes.set_ylabel("force, N")
    axes.set_ylim(bottom=0)


def _draw_areas(axes: Axes, scan: Scan) -> None:
    for name, section in scan.sections.items():
        if np.isfinite(section.fraction).any():
            label = f"{name}, % of its area at rest"
            colour = choose_colour(name)
            axes.plot(section.times, 100 * section.fraction, color=colour, label=label)
    axes.set_ylim(bottom=0)
    axes.legend(fontsize=8, frameon=False)


def _draw_speed(axes: Axes, scan: Scan) -> None:
    axes.plot(scan.motion.times[1:], _MM * scan.motion.speeds, lw=1)
    axes.set_ylabel("speed, mm/s")
