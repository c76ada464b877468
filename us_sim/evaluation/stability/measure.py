"""`us-sim evaluate stability`: try to break every tissue solver, and write down what happened.

Thousands of stiff and extreme cases (see `us_sim.evaluation.stability.cases`) on small meshes, for
every solver: does it stay finite and bounded, does it come back after release, is its residual
true, and does it refuse what it must. And a thousand within what anatomy is (`held_cases`): does
the tissue come to balance when the probe is held still. The cases are the same in every run.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from numba.core import config
from threadpoolctl import threadpool_limits

from us_sim.errors import SolverError
from us_sim.evaluation.report_folder import ReportFolder
from us_sim.evaluation.row import failures
from us_sim.evaluation.stability.cases import StabilityCase, extreme_cases, model_of, sampled_cases
from us_sim.evaluation.stability.held_cases import held_cases
from us_sim.evaluation.stability.observed_step_limit import observed_step_limit
from us_sim.evaluation.stability.points import Trial, Tried, try_case
from us_sim.evaluation.stability.refusals import REFUSALS, refusal_of
from us_sim.evaluation.stability.report import table, write_report
from us_sim.evaluation.tissue_methods import TISSUE_METHODS
from us_sim.kernels import kernel_folder
from us_sim.progress import Progress
from us_sim.tissue.solvers.solver import create_solver

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
