"""What came of all extreme cases, in Markdown with maps, and as a table in the terminal.

Maps of how solvers fared over modulus, contrast, depth, step and damping, and of step limits.

`us-sim evaluate stability`: try to break every tissue solver, and write down what happened.

Thousands of stiff and extreme cases (see `us_sim.evaluation.stability.cases`) on small meshes, for
every solver: does it stay finite and bounded, does it come back after release, is its residual
true, and does it refuse what it must. And a thousand within what anatomy is (`held_cases`): does
the tissue come to balance when the probe is held still. The cases are the same in every run.
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
from numba.core import config
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from us_sim.errors import SolverError
from us_sim.evaluation.report import ReportFolder, failures, markdown_table, new_figure, save
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
from us_sim.kernels import kernel_folder
from us_sim.progress import Progress
from us_sim.tissue.solvers.solver import create_solver

_HEAD = (
    *("method", "cases", "refused", "failed", "not finite", "not bounded", "not truthful"),
    *("back to rest", "frames", "kept", "slowest ms"),
)

_HELD_HEAD = (
    *("method", "judged", "cases", "residual ≤ 0.001", "inverted", "both fine", "frames, median"),
    *("95th percentile", "worst residual"),
)

_DEFINITIONS = """\
Every case is a small tissue (4 to 150 nodes), a collider and a motion of it, and then its release.

- *finite*: all nodes, force, torque and residual of all frames.
- *bounded*: no node is ever farther from its rest than three times the mesh's diagonal, the depth
  and the collider together; a part that nothing holds may also drift off by ten times its size.
- *back to rest*: at the end, the farthest node is within 1e-4 of the thickness from its rest (parts
  that nothing holds: after a rigid motion). Quasi-static methods have 40 frames for it, the others
  150, whatever their time step is: 20 steps of 1 µs, or damping of 1000 times critical, leave no
  time to come back, which is physics and not counted as a failure. *frames* is the median number
  of frames until then.
- *truthful*: in every frame that was compared, the reported residual and the one computed from the
  returned nodes by other code (NumPy, double precision, from the method's equations:
  `us_sim/evaluation/independent_residual.py`) are within a factor of two, or both below 1e-5, or
  both below what rounding the nodes' coordinates to doubles makes. Of `fem_nonlinear`, whose
  surface is pushed by springs, the other code finds the least that the residual can be, whatever
  springs push: there more may be reported, but not less. After a probe came down deep in tissue, it
  is not compared until that has settled.
- *kept*: frames that failed, after which the solver itself kept the last good state or rest.
- *refused*: in one sentence, before the run. To be refused for no reason counts as failed, and so
  does not to refuse a tissue that can move as a whole (quasi-static methods) or broken input.
- *held*: see below; a case of `fem_nonlinear` that does not come to balance counts as failed.
- critical damping is that of the root mean square of the nodes' frequencies."""


def table(tried: Sequence[Tried]) -> str:
    """What the command prints: the numbers of each method, and how well step limits are known."""
    rows = markdown_table(_HEAD, [_numbers(method, tried) for method in _methods(tried)])
    limits = [f"step limit of {name}: {said}" for name, said in _step_limits(tried).items()]
    return "\n".join([rows, *limits])


def write_report(folder: ReportFolder, tried: Sequence[Tried]) -> None:
    """Draw the maps and write stability.md."""
    failed = failures(tried)
    parts = [
        "# Stability of the tissue solvers",
        f"{folder.opening('numpy', 'scipy', 'numba')} Two processes shared the cases.",
        _DEFINITIONS,
        markdown_table(_HEAD, [_numbers(method, tried) for method in _methods(tried)]),
        "" if failed else "No case failed.",
    ]
    parts += _held(tried)
    for method, said in _step_limits(tried).items():
        limits = _with_step_limit(method, tried)
        predicted = np.array([trial.step_limit_predicted for trial in limits])
        observed = np.array([trial.step_limit_observed for trial in limits])
        picture = folder.picture(f"step_limit_{method}")
        draw_step_limits(method, predicted, observed, picture)
        parts += [f"## Step limit of {method}", f"{said}."]
        parts += [f"![predicted and observed]({picture.name})"]
    for method in _methods(tried):
        mine = [one for one in tried if one.method == method]
        picture = folder.picture(method)
        draw_map(method, mine, picture)
        parts += [f"## {method}", f"![map]({picture.name})", *_worst(mine), *_said(mine)]
    folder.write_report([*parts, *_refusals(tried)], failed)


def _held(tried: Sequence[Tried]) -> list[str]:
    """What came of the cases in which the probe was held, and who is judged by it."""
    rows = []
    for method in _methods(tried):
        held = [one.trial for one in tried if one.method == method and one.trial.held]
        if not held:
            continue
        frames = [n for n in (trial.frames_to_balance for trial in held) if n is not None]
        upright = [trial for trial in held if not trial.held_inverted]
        fine = [trial for trial in upright if trial.frames_to_balance is not None]
        typical = [f"{np.percentile(frames, part):.0f}" if frames else "" for part in (50, 95)]
        rows.append(
            (
                method,
                "yes" if TISSUE_METHODS[method].is_judged_at_rest else "",
                f"{len(held)}",
                f"{100 * len(frames) / len(held):.1f} %",
                f"{len(held) - len(upright)}",
                f"{100 * len(fine) / len(held):.1f} %",
                *typical,
                f"{max(trial.held[-1] for trial in held):.2g}",
            )
        )
    if not rows:
        return []
    judged = [f"`{name}`" for name, method in TISSUE_METHODS.items() if method.is_judged_at_rest]
    return [
        "## A probe that is held",
        "Within what anatomy is (1 to 100 kPa, contrasts up to 1000, Poisson's ratios of 0.3 to "
        f"0.495, presses of 5 to 50 % of the thickness), the probe then stays for {HOLD} frames, "
        f"after which the residual must be at most {SMALL:g} and no tetrahedron inside out. "
        f"{', '.join(judged)} is judged by it: its energy has a minimum under every probe, and a "
        "case in which it does not come there counts as failed. The others are only recorded. "
        "Linear strain (`fem`, `fem_cg`) knows no volume, so that deep presses turn tetrahedra "
        "inside out in the exact solution of its equations; springs have masses that swing on, "
        "and time steps that a frame has only so many of.",
        markdown_table(_HELD_HEAD, rows),
    ]


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


def _with_step_limit(method: str, tried: Sequence[Tried]) -> list[Trial]:
    trials = (one.trial for one in tried if one.method == method)
    return [trial for trial in trials if not math.isnan(trial.step_limit_predicted)]


def _step_limits(tried: Sequence[Tried]) -> dict[str, str]:
    """By method, for those of which a step limit was looked for: how good its prediction is."""
    said = {}
    for method in _methods(tried):
        limits = _with_step_limit(method, tried)
        if limits:
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
    far = [one for one in ran if one.trial.recovery_frames is None]
    if far:
        parts += ["Farthest from rest after release:"]
        parts += [_largest(far, lambda trial: trial.recovered_mm, " mm")]
    large = [one for one in ran if one.trial.residual_checked > 1e-2]
    if large:
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


def _said(tried: Sequence[Tried]) -> list[str]:
    """What the solver said it did, with its numbers taken out, and in how many cases."""
    counted: Counter[str] = Counter()
    for one in tried:
        if not one.trial.refused:
            parts = (part for action in one.trial.actions for part in action.split("; "))
            counted.update({re.sub(r"\d[\d.e+-]*", "#", part) for part in parts})
    if not counted:
        return []
    lines = [f"- {number}: {said}" for said, number in counted.most_common(12)]
    return ["What it said it did (numbers left out), in how many cases:", "\n".join(lines)]


def _refusals(tried: Sequence[Tried]) -> list[str]:
    """Each sentence once, though its numbers and the method in it differ."""
    seen: dict[str, tuple[str, str, list[str]]] = {}
    for one in tried:
        if one.trial.refused:
            sentence = one.trial.actions[0].removeprefix("refused: ")
            key = re.sub(r"\d[\d.e+-]*", "#", sentence.replace(one.method, ""))
            methods = seen.setdefault(key, (one.name, sentence, []))[2]
            if one.method not in methods:
                methods.append(one.method)
    rows = [(name, ", ".join(methods), sentence) for name, sentence, methods in seen.values()]
    words = "## Refused, and with what words"
    return [words, markdown_table(("case", "methods", "sentence"), rows)]


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


_SAMPLES, _QUICK_SAMPLES = 2048, 64
_STEP_LIMITS, _QUICK_STEP_LIMITS = 200, 24  # sampled cases whose step limit is looked for
_STEP_LIMIT_ERROR = 0.02  # relative, of predicted step limits
_HELD, _QUICK_HELD = 1000, 24
_SEED = 1  # of the held cases
_CHUNK = 12  # cases that a process is handed at a time


@dataclass(frozen=True)
class _Task:
    """A case for one method."""

    method: str
    case: StabilityCase | str  # or the name of what must be refused
    bisect: bool = False  # whether its step limit is looked for


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
    write_report(folder, tried)
    return folder.finish(table(tried), failures(tried))


def _tasks(quick: bool) -> Iterator[_Task]:
    named = extreme_cases(corners=not quick)
    sampled = sampled_cases(_QUICK_SAMPLES if quick else _SAMPLES)
    held = held_cases(_QUICK_HELD if quick else _HELD, _SEED)
    limits = _QUICK_STEP_LIMITS if quick else _STEP_LIMITS
    for name_of_method, method in TISSUE_METHODS.items():
        for name in REFUSALS:
            yield _Task(name_of_method, name)
        for case in named:
            yield _Task(name_of_method, case)
        for number, case in enumerate(sampled):
            yield _Task(name_of_method, case, method.is_explicit and number < limits)
        for case in held:
            yield _Task(name_of_method, case)


def _run(tasks: Sequence[_Task], progress: Callable[[float, str], None]) -> list[Tried]:
    """All tasks, in processes of their own, in order."""
    tried: list[Tried] = []
    with (
        tempfile.TemporaryDirectory(prefix="us-sim-stability-") as cache,
        ProcessPoolExecutor(
            max_workers=max(1, min(2, os.cpu_count() or 1)),
            mp_context=multiprocessing.get_context("spawn"),
            initializer=_prepare,
            initargs=(cache, str(kernel_folder())),
        ) as pool,
    ):
        try:
            for task, trial in zip(tasks, pool.map(_try, tasks, chunksize=_CHUNK), strict=True):
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


def _prepare(cache: str, kernels: str) -> None:
    """In a new process: one thread for BLAS, and what is kept on disk goes to ``cache``.

    Kernels alone are those of every other process: in a new folder all would be compiled again.
    """
    os.environ["US_SIM_CACHE"] = cache
    os.environ["NUMBA_CACHE_DIR"] = config.CACHE_DIR = kernels  # type: ignore[attr-defined]
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
            if abs(observed - predicted) > _STEP_LIMIT_ERROR * predicted:
                trial.failure = (
                    f"predicts a step limit of {predicted:.4g} s, but it is {observed:.4g} s"
                )
    return trial
