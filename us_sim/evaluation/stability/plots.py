"""Maps of how solvers fared over modulus, contrast, depth, step and damping, and of step limits."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import ListedColormap, LogNorm
from numpy.typing import NDArray

from us_sim.evaluation.figure import new_figure, save
from us_sim.evaluation.stability.cases import MOTIONS, StabilityCase
from us_sim.evaluation.stability.meshes import MESHES
from us_sim.evaluation.stability.points import Trial, Tried
from us_sim.evaluation.tissue_methods import TISSUE_METHODS

_FAILED, _REFUSED = "#d62728", "#d9d9d9"

_MANY = 500  # cases, with fewer of which cells are larger
_FINE, _COARSE = 10, 5  # cells along an axis


@dataclass(frozen=True)
class _Axis:
    """A quantity of cases; its cells are equal parts of a range, or its categories."""

    name: str
    value: Callable[[StabilityCase], float]
    low: float = 0.0
    high: float = 0.0
    power: bool = True  # the value is a decimal logarithm
    categories: tuple[str, ...] = ()

    def cell(self, case: StabilityCase, cells: int) -> int:
        """Of the case; what is beyond the range is in the first or the last cell."""
        if self.categories:
            return int(self.value(case))
        fraction = (self.value(case) - self.low) / (self.high - self.low)
        return int(min(max(fraction * cells, 0), cells - 1))

    def count(self, cells: int) -> int:
        """How many cells there are."""
        return len(self.categories) or cells

    def ticks(self, cells: int) -> tuple[list[float], list[str]]:
        """Where the axis is labelled, in cells, and with what."""
        if self.categories:
            return [i + 0.5 for i in range(len(self.categories))], list(self.categories)
        step = (3 if self.high - self.low > 5 else 1) if self.power else 0.2
        numbers = np.arange(math.ceil(self.low / step) * step, self.high + 1e-9, step)
        places = (numbers - self.low) / (self.high - self.low) * cells
        texts = [f"$10^{{{n:.0f}}}$" if self.power else f"{n:.1f}" for n in numbers]
        return places.tolist(), texts


_MODULUS = _Axis(
    "Young's modulus of the softest / Pa", lambda c: math.log10(c.young_modulus), 0, 12
)
_RATIO = _Axis("0.5 - Poisson's ratio", lambda c: math.log10(0.5 - c.poisson_ratio), -4.1, -0.3)
_CONTRAST = _Axis("contrast within the mesh", lambda c: math.log10(c.contrast), 0, 9)
_DEPTH = _Axis("depth / thickness", lambda c: c.depth, 0, 1, power=False)
_STEP = _Axis("time step / s", lambda c: math.log10(c.time_step), -6, 1)
_DAMPING = _Axis(
    "damping / critical (lowest row: none)",
    lambda c: math.log10(c.damping) if c.damping > 0 else -math.inf,
    -3.5,
    3,
)
_MOTION = _Axis("motion", lambda c: MOTIONS.index(c.motion), categories=MOTIONS)
_MESH = _Axis("mesh", lambda c: list(MESHES).index(c.mesh), categories=tuple(MESHES))


def draw_map(method: str, mine: Sequence[Tried], file: Path) -> None:
    """Write a method's map as PNG: in each cell the worst of the cases that fall into it."""
    tried = [(one.case, one.trial) for one in mine if one.case is not None]
    failed = sum(not trial.passed for _, trial in tried)
    title = (
        f"{method}: {len(tried)} cases, {failed} failed   "
        f"(a cell shows its worst case; white: none; grey: all refused; red ×: one failed)"
    )
    figure = new_figure(15, 9.2, title)
    third = (_STEP, _DAMPING) if TISSUE_METHODS[method].has_springs else (_MOTION, _MESH)
    pairs = ((_MODULUS, _RATIO), (_CONTRAST, _DEPTH), third)
    rows: tuple[tuple[str, Callable[[Trial], float], LogNorm], ...] = (
        ("farthest from rest after release / mm", lambda t: t.recovered_mm, LogNorm(1e-6, 1e2)),
        ("residual under the probe", lambda t: t.residual_checked, LogNorm(1e-12, 1e2)),
    )
    panels = figure.subplots(len(rows), len(pairs), squeeze=False)
    for line, (title, value, norm) in zip(panels, rows, strict=True):
        for panel, (x, y) in zip(line, pairs, strict=True):
            image = _draw_cells(panel, tried, x, y, value, norm)
        bar = figure.colorbar(image, ax=list(line), pad=0.01, extend="both")
        bar.set_label(title)
    save(figure, file)


def draw_step_limits(
    method: str, predicted: NDArray[np.float64], observed: NDArray[np.float64], file: Path
) -> None:
    """Write predicted against observed step limits (K,) s as PNG."""
    figure = new_figure(8, 6.4, f"{method}: longest stable step, {len(predicted)} cases")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.2, 1))
    low, high = predicted.min() / 2, predicted.max() * 2
    upper.loglog([low, high], [low, high], color="0.6", linewidth=1, label="equal")
    upper.loglog(predicted, observed, "o", markersize=4, alpha=0.6, label="a case")
    upper.set_ylabel("observed by bisection / s")
    upper.legend(frameon=False)
    lower.semilogx(predicted, 100 * (observed / predicted - 1), "o", markersize=4, alpha=0.6)
    lower.axhspan(-2, 2, color="0.93", zorder=0)
    lower.set(xlim=(low, high), ylim=(-3, 3), xlabel="predicted / s", ylabel="deviation / %")
    for panel in (upper, lower):
        panel.grid(alpha=0.3)
    save(figure, file)


def _draw_cells(
    panel: Axes,
    tried: Sequence[tuple[StabilityCase, Trial]],
    x: _Axis,
    y: _Axis,
    value: Callable[[Trial], float],
    norm: LogNorm,
) -> QuadMesh:
    cells = _FINE if len(tried) >= _MANY else _COARSE
    worst = np.full((y.count(cells), x.count(cells)), np.nan)
    refused = np.zeros(worst.shape, dtype=bool)
    failed = np.zeros(worst.shape, dtype=bool)
    for case, trial in tried:
        place = y.cell(case, cells), x.cell(case, cells)
        failed[place] |= not trial.passed
        refused[place] |= trial.refused
        if math.isfinite(value(trial)):
            worst[place] = np.fmax(worst[place], max(value(trial), float(norm.vmin or 0.0)))
    grey = np.where(refused & np.isnan(worst), 0.0, np.nan)
    panel.pcolormesh(grey, cmap=ListedColormap([_REFUSED]))
    image = panel.pcolormesh(worst, cmap="viridis", norm=norm, edgecolors="white", linewidth=0.3)
    rows, columns = np.nonzero(failed)
    panel.plot(columns + 0.5, rows + 0.5, "x", color=_FAILED, markersize=8, markeredgewidth=2)
    panel.set(xlabel=x.name, ylabel=y.name)
    panel.set_xticks(*x.ticks(cells))
    for label in panel.get_xticklabels() if x.categories else []:
        label.set(rotation=35, horizontalalignment="right", rotation_mode="anchor")
    panel.set_yticks(*y.ticks(cells))
    return image
