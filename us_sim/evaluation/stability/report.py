"""`us-sim evaluate stability`: try to break every tissue solver, and report how it fared.

Thousands of stiff and extreme cases on small meshes, for every solver: does it stay finite and
bounded, does it come back after release, is its residual true, and does it refuse broken input. And
a thousand within anatomy (`held_cases`): does the tissue come to balance when the probe is held
still. The cases are the same in every run.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import re
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import ListedColormap, LogNorm
from threadpoolctl import threadpool_limits

from us_sim.errors import SolverError
from us_sim.evaluation.report import ReportFolder, failures, filled, markdown_table, picture
from us_sim.evaluation.stability.cases import (
    HOLD,
    MESHES,
    MOTIONS,
    SMALL,
    StabilityCase,
    extreme_cases,
    held_cases,
    model_of,
    sampled_cases,
)
from us_sim.evaluation.stability.measure import (
    REFUSALS,
    Trial,
    Tried,
    observed_step_limit,
    refusal_of,
    try_case,
)
from us_sim.evaluation.tissue_methods import TISSUE_METHODS
from us_sim.progress import Progress
from us_sim.tissue.solvers.solver import create_solver

_QUICK_STEP_LIMITS = 24  # sampled cases whose step limit is bisected

_HEAD = (
    *("method", "cases", "refused", "failed", "not finite", "not bounded", "not truthful"),
    *("back to rest", "frames", "kept", "slowest ms"),
)
_HELD_HEAD = (
    *("method", "judged", "cases", "residual ≤ 0.001", "inverted", "both fine", "frames, median"),
    *("95th percentile", "worst residual"),
)


@dataclass(frozen=True)
class _Task:
    """A case for one method."""

    method: str
    case: StabilityCase | str  # or the name of an input that must be refused
    bisect: bool = False  # whether its step limit is bisected


def evaluate_stability(out: Path, quick: bool) -> int:
    """Write stability.csv, the maps and stability.md, as `us_sim.evaluation` says.

    A quick run has fewer cases. A case has failed that was not finite, bounded or truthful, or was
    refused for no reason, or was not in balance in the end though it should be.
    """
    folder = ReportFolder("stability", out, quick)
    tasks = list(_tasks(quick))
    with Progress("stability", len(tasks), "cases") as progress:
        tried = _run(tasks, progress.update)
    folder.write_rows("stability", tried)
    numbers = markdown_table(_HEAD, [_numbers(method, tried) for method in _methods(tried)])
    limits = _step_limits(tried)
    lines = [f"step limit of {name}: {said}" for name, said in limits.items()]
    limited, maps = [], []
    for method, said in limits.items():
        file = folder.picture(f"step_limit_{method}")
        _draw_step_limits(method, _with_step_limit(method, tried), file)
        limited += [f"## Step limit of {method}", f"{said}."]
        limited += [f"![predicted and observed]({file.name})"]
    for method in _methods(tried):
        mine = [one for one in tried if one.method == method]
        file = folder.picture(method)
        _draw_map(method, mine, file)
        maps += [f"## {method}", f"![map]({file.name})", *_worst(mine), *_actions(mine)]
    failed = failures(tried)
    return folder.finish(
        "\n".join([numbers, *lines]),
        failed,
        ("numpy", "scipy", "numba"),
        numbers=numbers,
        none_failed="" if failed else "No case failed.",
        held=_held(tried),
        step_limits="\n\n".join(limited),
        methods="\n\n".join(maps),
        refusals=_refusals(tried),
    )


def _tasks(quick: bool) -> Iterator[_Task]:
    named = extreme_cases(corners=not quick)
    sampled = sampled_cases(64 if quick else 2048)
    held = held_cases(24 if quick else 1000, 1)
    limits = _QUICK_STEP_LIMITS if quick else 200
    first: list[StabilityCase | str] = [*REFUSALS, *named]
    for name, method in TISSUE_METHODS.items():
        for case in first:
            yield _Task(name, case)
        for number, case in enumerate(sampled):
            yield _Task(name, case, method.is_explicit and number < limits)
        for case in held:
            yield _Task(name, case)


def _run(tasks: Sequence[_Task], progress: Callable[[float, str], None]) -> list[Tried]:
    """All tasks, in order, in two processes of their own."""
    tried: list[Tried] = []
    with (
        tempfile.TemporaryDirectory(prefix="us-sim-stability-") as cache,
        ProcessPoolExecutor(
            max_workers=max(1, min(2, os.cpu_count() or 1)),
            mp_context=multiprocessing.get_context("spawn"),
            initializer=_prepare,
            initargs=(cache,),
        ) as pool,
    ):
        try:
            for task, trial in zip(tasks, pool.map(_try, tasks, chunksize=12), strict=True):
                case = None if isinstance(task.case, str) else task.case
                name = case.case if case else str(task.case)
                tried.append(Tried(task.method, name, case, trial))
                progress(len(tried), task.method)
        except BrokenProcessPool as error:
            raise SolverError(
                f"a process died while it tried {tasks[len(tried)].method}, or what comes after "
                f"it: run it again with PYTHONFAULTHANDLER=1 to see where"
            ) from error
    return tried


def _prepare(cache: str) -> None:
    """In a new process: one thread for BLAS, and files of solvers in the folder ``cache``.

    Kernels alone are those of every other process: their folder was chosen by the imports above.
    """
    os.environ["US_SIM_CACHE"] = cache
    threadpool_limits(1)


@lru_cache
def _warm_up(method: str) -> None:
    """Once in a process, so that no frame's time contains a compilation."""
    create_solver(method, model_of(StabilityCase("box"))).warm_up()


def _try(task: _Task) -> Trial:
    _warm_up(task.method)
    if isinstance(task.case, str):
        return refusal_of(task.method, task.case)
    trial = try_case(task.method, task.case)
    if task.bisect and not trial.refused:
        predicted, observed = observed_step_limit(task.method, task.case)
        if math.isfinite(predicted):
            trial.step_limit_predicted, trial.step_limit_observed = predicted, observed
            if abs(observed - predicted) > 0.02 * predicted:
                trial.failure = (
                    f"predicts a step limit of {predicted:.4g} s, but it is {observed:.4g} s"
                )
    return trial


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
        """Cell of the case: the first or the last one beyond the range."""
        if self.categories:
            return int(self.value(case))
        fraction = (self.value(case) - self.low) / (self.high - self.low)
        return int(min(max(fraction * cells, 0), cells - 1))

    def ticks(self, cells: int) -> tuple[list[float], list[str]]:
        """Places of the axis' labels, in cells, and their texts."""
        if self.categories:
            return [i + 0.5 for i in range(len(self.categories))], list(self.categories)
        step = (3 if self.high - self.low > 5 else 1) if self.power else 0.2
        numbers = np.arange(math.ceil(self.low / step) * step, self.high + 1e-9, step)
        places = (numbers - self.low) / (self.high - self.low) * cells
        return places.tolist(), [f"$10^{{{n:.0f}}}$" if self.power else f"{n:.1f}" for n in numbers]


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


def _draw_map(method: str, mine: Sequence[Tried], file: Path) -> None:
    """In each cell the worst of the cases that fall into it."""
    tried = [(one.case, one.trial) for one in mine if one.case is not None]
    failed = sum(not trial.passed for _, trial in tried)
    title = (
        f"{method}: {len(tried)} cases, {failed} failed   "
        f"(a cell shows its worst case; white: none; grey: all refused; red ×: one failed)"
    )
    third = (_STEP, _DAMPING) if TISSUE_METHODS[method].has_springs else (_MOTION, _MESH)
    pairs = ((_MODULUS, _RATIO), (_CONTRAST, _DEPTH), third)
    rows: tuple[tuple[str, Callable[[Trial], float], LogNorm], ...] = (
        ("farthest from rest after release / mm", lambda t: t.recovered_mm, LogNorm(1e-6, 1e2)),
        ("residual under the probe", lambda t: t.residual_checked, LogNorm(1e-12, 1e2)),
    )
    with picture(file, 15, 9.2, title) as figure:
        panels = figure.subplots(len(rows), len(pairs), squeeze=False)
        for line, (label, value, norm) in zip(panels, rows, strict=True):
            for panel, (x, y) in zip(line, pairs, strict=True):
                image = _draw_cells(panel, tried, x, y, value, norm)
            bar = figure.colorbar(image, ax=list(line), pad=0.01, extend="both")
            bar.set_label(label)


def _draw_cells(
    panel: Axes,
    tried: Sequence[tuple[StabilityCase, Trial]],
    x: _Axis,
    y: _Axis,
    value: Callable[[Trial], float],
    norm: LogNorm,
) -> QuadMesh:
    cells = 10 if len(tried) >= 500 else 5
    worst = np.full((len(y.categories) or cells, len(x.categories) or cells), np.nan)
    refused, failed = np.zeros((2, *worst.shape), dtype=bool)
    for case, trial in tried:
        place = y.cell(case, cells), x.cell(case, cells)
        failed[place] |= not trial.passed
        refused[place] |= trial.refused
        if math.isfinite(value(trial)):
            worst[place] = np.fmax(worst[place], max(value(trial), float(norm.vmin or 0.0)))
    grey = np.where(refused & np.isnan(worst), 0.0, np.nan)
    panel.pcolormesh(grey, cmap=ListedColormap(["#d9d9d9"]))
    image = panel.pcolormesh(worst, cmap="viridis", norm=norm, edgecolors="white", linewidth=0.3)
    rows, columns = np.nonzero(failed)
    panel.plot(columns + 0.5, rows + 0.5, "x", color="#d62728", markersize=8, markeredgewidth=2)
    panel.set(xlabel=x.name, ylabel=y.name)
    panel.set_xticks(*x.ticks(cells))
    for label in panel.get_xticklabels() if x.categories else []:
        label.set(rotation=35, horizontalalignment="right", rotation_mode="anchor")
    panel.set_yticks(*y.ticks(cells))
    return image


def _draw_step_limits(method: str, limits: Sequence[Trial], file: Path) -> None:
    """Predicted against observed step limits."""
    predicted = np.array([trial.step_limit_predicted for trial in limits])
    observed = np.array([trial.step_limit_observed for trial in limits])
    title = f"{method}: longest stable step, {len(predicted)} cases"
    with picture(file, 8, 6.4, title) as figure:
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


def _methods(tried: Sequence[Tried]) -> list[str]:
    return [method for method in TISSUE_METHODS if any(one.method == method for one in tried)]


def _numbers(method: str, tried: Sequence[Tried]) -> tuple[str, ...]:
    trials = [one.trial for one in tried if one.method == method]
    ran = [trial for trial in trials if not math.isnan(trial.recovered_mm)]
    back = [trial.recovery_frames for trial in ran if trial.recovery_frames is not None]
    return (
        method,
        f"{len(trials)}",
        f"{sum(trial.refused for trial in trials)}",
        *(
            f"{sum(not getattr(trial, name) for trial in trials)}"
            for name in ("passed", "finite", "bounded", "truthful")
        ),
        f"{100 * len(back) / max(len(ran), 1):.1f} %",
        f"{np.median(back):.0f}" if back else "",
        str(sum(trial.kept for trial in trials)),
        f"{max((trial.slowest_ms for trial in trials), default=0.0):.0f}",
    )


def _held(tried: Sequence[Tried]) -> str:
    """Section on the cases in which the probe was held; empty without such cases."""
    rows = []
    for method in _methods(tried):
        held = [one.trial for one in tried if one.method == method and one.trial.held]
        if not held:
            continue
        frames = [n for n in (trial.frames_to_balance for trial in held) if n is not None]
        upright = [trial for trial in held if not trial.held_inverted]
        fine = [trial for trial in upright if trial.frames_to_balance is not None]
        rows.append(
            (
                method,
                "yes" if TISSUE_METHODS[method].is_judged_at_rest else "",
                f"{len(held)}",
                f"{100 * len(frames) / len(held):.1f} %",
                f"{len(held) - len(upright)}",
                f"{100 * len(fine) / len(held):.1f} %",
                *(f"{np.percentile(frames, part):.0f}" if frames else "" for part in (50, 95)),
                f"{max(trial.held[-1] for trial in held):.2g}",
            )
        )
    if not rows:
        return ""
    judged = [f"`{name}`" for name, method in TISSUE_METHODS.items() if method.is_judged_at_rest]
    table = markdown_table(_HELD_HEAD, rows)
    words = {"hold": f"{HOLD}", "small": f"{SMALL:g}", "judged": ", ".join(judged)}
    return filled("stability", "held", table=table, **words)


def _with_step_limit(method: str, tried: Sequence[Tried]) -> list[Trial]:
    trials = (one.trial for one in tried if one.method == method)
    return [trial for trial in trials if not math.isnan(trial.step_limit_predicted)]


def _step_limits(tried: Sequence[Tried]) -> dict[str, str]:
    """Accuracy of predicted step limits in words, by method with bisected ones."""
    said = {}
    for method in _methods(tried):
        if limits := _with_step_limit(method, tried):
            ratios = [t.step_limit_observed / t.step_limit_predicted for t in limits]
            deviation = np.abs(np.array(ratios) - 1)
            said[method] = (
                f"{len(limits)} cases bisected, observed and predicted limits differ by "
                f"{100 * np.median(deviation):.2f} % (median) and {100 * deviation.max():.2f} % "
                f"(largest)"
            )
    return said


def _worst(tried: Sequence[Tried]) -> list[str]:
    """Of those that ran: the five farthest from rest, and the five with the largest residual."""
    ran = [one for one in tried if not math.isnan(one.trial.recovered_mm) and one.case is not None]
    parts = []
    if far := [one for one in ran if one.trial.recovery_frames is None]:
        parts += ["Farthest from rest after release:"]
        parts += [_largest(far, lambda trial: trial.recovered_mm, " mm")]
    if large := [one for one in ran if one.trial.residual_checked > 1e-2]:
        parts += [f"Residual above 1e-2 under the probe in {len(large)} cases; the largest:"]
        parts += [_largest(large, lambda trial: trial.residual_checked)]
    return parts


def _largest(tried: Sequence[Tried], value: Callable[[Trial], float], unit: str = "") -> str:
    worst = sorted(tried, key=lambda one: -value(one.trial))[:5]
    return "\n".join(f"- {value(one.trial):.3g}{unit}: {_described(one)}" for one in worst)


def _described(one: Tried) -> str:
    case = one.case
    if case is None:
        return one.name
    held = f", then held for {case.held} frames" if case.held else ""
    text = (
        f"{one.name} ({case.young_modulus:.2g} Pa, contrast {case.contrast:.2g}, "
        f"ν = {case.poisson_ratio:.5g}, {case.motion} to {100 * case.depth:.0f} % of the depth, "
        f"{case.mesh}, {case.collider}, held: {case.support}{held}"
    )
    if TISSUE_METHODS[one.method].has_springs:
        text += f", {case.time_step:.2g} s steps, damping {case.damping:.2g}, {case.springs}"
    return text + ")"


def _without_numbers(sentence: str) -> str:
    return re.sub(r"\d[\d.e+-]*", "#", sentence)


def _actions(tried: Sequence[Tried]) -> list[str]:
    """Actions that the solver reported, with the number of cases."""
    counted: Counter[str] = Counter()
    for one in tried:
        parts = (action for frame in one.trial.actions for action in frame)
        counted.update(dict.fromkeys(map(_without_numbers, parts), 1))
    if not counted:
        return []
    lines = [f"- {number}: {said}" for said, number in counted.most_common(12)]
    return ["What it said it did (numbers left out), in how many cases:", "\n".join(lines)]


def _refusals(tried: Sequence[Tried]) -> str:
    """Each sentence once, though its numbers and the method in it differ."""
    seen: dict[str, tuple[str, str, list[str]]] = {}
    for one in tried:
        if one.trial.refused:
            sentence = one.trial.refusal
            key = _without_numbers(sentence.replace(one.method, ""))
            methods = seen.setdefault(key, (one.name, sentence, []))[2]
            if one.method not in methods:
                methods.append(one.method)
    rows = [(name, ", ".join(methods), sentence) for name, sentence, methods in seen.values()]
    return markdown_table(("case", "methods", "sentence"), rows)
