"""`us-sim evaluate stability`: try to break every tissue solver, and write down what happened.

Thousands of stiff and extreme cases (see `us_sim.evaluation.stability.cases`) on small meshes, for
every solver: does it stay finite and bounded, does it come back after release, is its residual
true, and does it refuse what it must. The cases are the same in every run.
"""

from __future__ import annotations

import csv
import math
import multiprocessing
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from pathlib import Path

from threadpoolctl import threadpool_limits

from us_sim.errors import SolverError
from us_sim.evaluation.report_folder import prepare_folder
from us_sim.evaluation.stability.cases import StabilityCase, extreme_cases, model_of, sampled_cases
from us_sim.evaluation.stability.observed_step_limit import observed_step_limit
from us_sim.evaluation.stability.points import Trial, try_case
from us_sim.evaluation.stability.refusals import REFUSALS, refusal_of
from us_sim.evaluation.stability.report import print_table, write_report
from us_sim.progress import Progress
from us_sim.tissue.solvers.solver import SOLVERS, create_solver

__all__ = ["COLUMNS", "Tried", "evaluate_stability", "write_rows"]

_SAMPLES = {True: 64, False: 2048}  # by quick
_STEP_LIMITS = {True: 24, False: 200}

_CHUNK = 12
"""Cases that a process is handed at a time."""

_STEP_LIMIT_ERROR = 0.02  # predicted and observed step limit agree within this

_VARIED = [field.name for field in fields(StabilityCase) if field.name != "case"]

COLUMNS = [
    "method",
    "case",
    *_VARIED,
    "recovery_frames",
    "dt_limit_predicted",
    "dt_limit_observed",
    "finite",
    "bounded",
    "recovered_mm",
    "residual_reported",
    "residual_checked",
    "truthful",
    "action",
]
"""Of stability.csv."""

_OF_SPRINGS = ("time_step", "damping", "springs")  # what a method without it leaves empty


@dataclass(frozen=True, eq=False)
class Tried:
    """A method, what it was given, and what came of it."""

    method: str
    name: str
    case: StabilityCase | None  # None for input that must be refused
    trial: Trial


@dataclass(frozen=True)
class _Task:
    method: str
    case: StabilityCase | str  # or the name of what must be refused
    bisect: bool = False


def evaluate_stability(out: Path, quick: bool) -> int:
    """Run all cases on all methods and write stability.csv, stability.md and the maps into ``out``.

    Args:
        out: a folder, made when it is not there.
        quick: fewer cases.

    Returns:
        0, or 1 when a case was not finite, bounded or truthful, or refused for no reason.

    Raises:
        UsSimError: the folder cannot be written or holds a report.
    """
    prepare_folder(out, "stability.md")
    start = time.perf_counter()
    tasks = list(_tasks(quick))
    with Progress("stability", len(tasks), "cases") as progress:
        tried = _run(tasks, progress)
    write_rows(tried, out / "stability.csv")
    write_report(tried, out, quick, time.perf_counter() - start)
    print_table(tried, out)
    return 0 if all(one.trial.passed for one in tried) else 1


def write_rows(tried: Sequence[Tried], file: Path) -> None:
    """A CSV row for each case; what a method does not have, or a refused case lacks, is empty."""
    with file.open("w", newline="", encoding="utf-8") as stream:
        rows = csv.DictWriter(stream, COLUMNS)
        rows.writeheader()
        for one in tried:
            rows.writerow(_row(one))


def _row(one: Tried) -> dict[str, object]:
    trial = one.trial
    row: dict[str, object] = {"method": one.method, "case": one.name}
    if one.case is not None:
        varied = asdict(one.case)
        for name in _VARIED:
            springs_only = name in _OF_SPRINGS and not one.method.startswith("msds")
            explicit_only = name == "stabilisation" and one.method != "msds"
            row[name] = "" if springs_only or explicit_only else _written(varied[name])
    said = trial.actions[:3]
    if trial.failure:
        said = [f"FAILED: {trial.failure}", *said]
    row["action"] = " | ".join(said)
    row["dt_limit_predicted"] = _written(trial.step_limit_predicted)
    row["dt_limit_observed"] = _written(trial.step_limit_observed)
    if not trial.refused:
        row["recovery_frames"] = trial.recovery_frames
        row["recovered_mm"] = _written(trial.recovered_mm)
        row["residual_reported"] = _written(trial.residual_reported)
        row["residual_checked"] = _written(trial.residual_checked)
        for name in ("finite", "bounded", "truthful"):
            row[name] = str(getattr(trial, name)).lower()
    return row


def _written(value: object) -> object:
    if not isinstance(value, float):
        return value
    return "" if math.isnan(value) else f"{value:.6g}"


def _tasks(quick: bool) -> Iterator[_Task]:
    named, sampled = extreme_cases(corners=not quick), sampled_cases(_SAMPLES[quick])
    for method in SOLVERS:
        for name in REFUSALS:
            yield _Task(method, name)
        for case in named:
            yield _Task(method, case)
        for number, case in enumerate(sampled):
            yield _Task(method, case, method == "msds" and number < _STEP_LIMITS[quick])


def _run(tasks: Sequence[_Task], progress: Progress) -> list[Tried]:
    """All tasks, in processes of their own, in order."""
    done: list[list[Trial]] = []
    chunks = [tasks[i : i + _CHUNK] for i in range(0, len(tasks), _CHUNK)]
    results: dict[int, list[Trial]] = {}
    with (
        tempfile.TemporaryDirectory(prefix="us-sim-stability-") as cache,
        ProcessPoolExecutor(
            max_workers=max(1, min(2, os.cpu_count() or 1)),
            mp_context=multiprocessing.get_context("spawn"),
            initializer=_prepare,
            initargs=(cache,),
        ) as pool,
    ):
        waiting: dict[Future[list[Trial]], int] = {
            pool.submit(_run_chunk, chunk): number for number, chunk in enumerate(chunks)
        }
        counted = 0
        for future in as_completed(waiting):
            number = waiting[future]
            try:
                results[number] = future.result()
            except BrokenProcessPool as error:
                unknown = sorted({task.method for task in chunks[number]})
                raise SolverError(
                    f"a process died while it tried {' and '.join(unknown)}: run it again with "
                    f"PYTHONFAULTHANDLER=1 to see where"
                ) from error
            counted += len(chunks[number])
            progress.update(counted, chunks[number][-1].method)
    done = [results[number] for number in range(len(chunks))]
    trials = [trial for chunk in done for trial in chunk]
    return [_tried(task, trial) for task, trial in zip(tasks, trials, strict=True)]


def _tried(task: _Task, trial: Trial) -> Tried:
    if isinstance(task.case, str):
        return Tried(task.method, task.case, None, trial)
    return Tried(task.method, task.case.case, task.case, trial)


def _prepare(cache: str) -> None:
    """In a new process: one thread for BLAS, and what is kept on disk goes to ``cache``."""
    os.environ["US_SIM_CACHE"] = cache
    threadpool_limits(1)


def _run_chunk(tasks: Sequence[_Task]) -> list[Trial]:
    for method in {task.method for task in tasks}:
        _warm_up(method)
    return [_try(task) for task in tasks]


@lru_cache
def _warm_up(method: str) -> None:
    """Once in a process, so that no frame's time contains a compilation."""
    create_solver(method, model_of(StabilityCase("box"))).warm_up()


def _try(task: _Task) -> Trial:
    if isinstance(task.case, str):
        return refusal_of(task.method, task.case)
    trial = try_case(task.method, task.case)
    if task.bisect and not trial.refused:
        predicted, observed = observed_step_limit(task.case)
        if math.isfinite(predicted):
            trial.step_limit_predicted, trial.step_limit_observed = predicted, observed
            if abs(observed - predicted) > _STEP_LIMIT_ERROR * predicted:
                trial.failure = (
                    f"predicts a step limit of {predicted:.4g} s, but it is {observed:.4g} s"
                )
    return trial
