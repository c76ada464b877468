"""Maps of how solvers fared over modulus, contrast, depth, step and damping, and of step limits."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from us_sim.evaluation.stability_cases import MOTIONS, StabilityCase
from us_sim.evaluation.stability_meshes import MESHES
from us_sim.evaluation.stability_trial import Trial

__all__ = ["draw_map", "draw_step_limits"]

_FAILED, _REFUSED = "#d62728", "#d9d9d9"
_BINS = 9

# A quantity's name, its value in a case, and the edges of its bins or its categories.
_Axis = tuple[str, Callable[[StabilityCase], float], Sequence[float] | Sequence[str]]

_MODULUS: _Axis = (
    "Young's modulus of the softest / Pa",
    lambda case: math.log10(case.young_modulus),
    np.linspace(0, 12, _BINS + 1).tolist(),
)
_RATIO: _Axis = (
    "0.5 − Poisson's ratio",
    lambda case: math.log10(0.5 - case.poisson_ratio),
    np.linspace(-4.1, -0.3, _BINS + 1).tolist(),
)
_CONTRAST: _Axis = (
    "contrast within the mesh",
    lambda case: math.log10(case.contrast),
    np.linspace(0, 9, _BINS + 1).tolist(),
)
_DEPTH: _Axis = (
    "depth / thickness",
    lambda case: case.depth,
    np.linspace(0, 1, _BINS + 1).tolist(),
)
_STEP: _Axis = (
    "time step / s",
    lambda case: math.log10(case.time_step),
    np.linspace(-6, 1, _BINS + 1).tolist(),
)
_DAMPING: _Axis = (
    "damping / critical (0 at the left)",
    lambda case: math.log10(max(case.damping, 1e-4)),
    [-4.0, *np.linspace(-3, 3, _BINS).tolist()],
)
_MOTION: _Axis = ("motion", lambda case: MOTIONS.index(case.motion), MOTIONS)
_MESH: _Axis = ("mesh", lambda case: list(MESHES).index(case.mesh), tuple(MESHES))


def draw_map(method: str, tried: Sequence[tuple[StabilityCase, Trial]], file: Path) -> None:
    """Write a method's map as PNG: in each cell the worst of the cases that fall into it."""
    figure = Figure(figsize=(15, 9.2), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    third = (_STEP, _DAMPING) if method.startswith("msds") else (_MOTION, _MESH)
    pairs = ((_MODULUS, _RATIO), (_CONTRAST, _DEPTH), third)
    rows: tuple[tuple[str, Callable[[Trial], float], LogNorm], ...] = (
        ("farthest node from rest after release / mm", _recovered, LogNorm(1e-6, 1e2)),
        ("residual under the probe", lambda t: t.residual_checked, LogNorm(1e-12, 1e2)),
    )
    panels = figure.subplots(len(rows), len(pairs), squeeze=False)
    for line, (title, value, norm) in zip(panels, rows, strict=True):
        for panel, (x, y) in zip(line, pairs, strict=True):
            image = _draw_cells(panel, tried, x, y, value, norm)
        bar = figure.colorbar(image, ax=list(line), pad=0.01, extend="both")
        bar.set_label(f"{title}, worst of each cell")
    failed = sum(not trial.passed for _, trial in tried)
    figure.suptitle(
        f"{method}: {len(tried)} cases, {failed} failed"
        f"   (grey: all refused; white: none; red ×: not finite, bounded or truthful)"
    )
    figure.savefig(file)


def draw_step_limits(
    predicted: NDArray[np.float64], observed: NDArray[np.float64], file: Path
) -> None:
    """Write predicted against observed step limits (K,) s as PNG."""
    figure = Figure(figsize=(8, 6.4), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.2, 1))
    low, high = predicted.min() / 2, predicted.max() * 2
    upper.loglog([low, high], [low, high], color="0.6", linewidth=1, label="equal")
    upper.loglog(predicted, observed, "o", markersize=4, alpha=0.6, label="a case")
    upper.set_ylabel("observed by bisection / s")
    upper.legend(frameon=False)
    upper.set_title(f"msds: longest stable step, {len(predicted)} cases")
    lower.semilogx(predicted, 100 * (observed / predicted - 1), "o", markersize=4, alpha=0.6)
    lower.axhspan(-2, 2, color="0.93", zorder=0)
    lower.set_ylim(-3, 3)
    lower.set_xlim(low, high)
    lower.set_xlabel("predicted / s")
    lower.set_ylabel("deviation / %")
    for panel in (upper, lower):
        panel.grid(alpha=0.3)
    figure.savefig(file)


def _recovered(trial: Trial) -> float:
    return trial.recovered_mm


def _draw_cells(
    panel: Axes,
    tried: Sequence[tuple[StabilityCase, Trial]],
    x: _Axis,
    y: _Axis,
    value: Callable[[Trial], float],
    norm: LogNorm,
):
    across, up = _cells(tried, x), _cells(tried, y)
    shape = _count(y), _count(x)
    worst = np.full(shape, np.nan)
    refused = np.zeros(shape, dtype=bool)
    failed = np.zeros(shape, dtype=bool)
    for i, j, (_, trial) in zip(up, across, tried, strict=True):
        failed[i, j] |= not trial.passed
        refused[i, j] |= trial.refused
        number = value(trial)
        if math.isfinite(number):
            worst[i, j] = np.fmax(worst[i, j], max(number, norm.vmin or 0.0))
    grey = np.where(refused & np.isnan(worst), 0.0, np.nan)
    panel.pcolormesh(grey, cmap=ListedColormap([_REFUSED]))
    image = panel.pcolormesh(worst, cmap="viridis", norm=norm)
    rows, columns = np.nonzero(failed)
    panel.plot(columns + 0.5, rows + 0.5, "x", color=_FAILED, markersize=9, markeredgewidth=2)
    _label(panel, x, y)
    return image


def _count(axis: _Axis) -> int:
    edges = axis[2]
    return len(edges) if isinstance(edges[0], str) else len(edges) - 1


def _cells(tried: Sequence[tuple[StabilityCase, Trial]], axis: _Axis) -> NDArray[np.intp]:
    """Which cell along an axis each case is in; beyond the last edge it is in the last cell."""
    _, value, edges = axis
    numbers = np.array([value(case) for case, _ in tried])
    if isinstance(edges[0], str):
        return numbers.astype(np.intp)
    inner = np.array(edges[1:-1], dtype=float)
    return np.searchsorted(inner, numbers, side="right")


def _label(panel: Axes, x: _Axis, y: _Axis) -> None:
    for axis, place in ((x, panel.xaxis), (y, panel.yaxis)):
        name, _, edges = axis
        place.set_label_text(name)
        if isinstance(edges[0], str):
            place.set_ticks(np.arange(len(edges)) + 0.5, edges)
            continue
        chosen = range(0, len(edges), 3)
        numbers = [float(edges[i]) for i in chosen]
        logarithmic = axis is not _DEPTH
        texts = [f"$10^{{{n:.3g}}}$" if logarithmic else f"{n:.2g}" for n in numbers]
        place.set_ticks(list(chosen), texts)
    if isinstance(x[2][0], str):
        panel.tick_params(axis="x", rotation=40)
