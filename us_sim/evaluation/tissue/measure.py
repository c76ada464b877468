"""`us-sim evaluate tissue`: how wrong each method is, against how long it takes.

Every method follows the probe's path at its own pace, frame by frame; what it says at the path's
end is compared with its own equations solved without regard to time, and with large deformation on
fine quadratic elements (`us_sim.evaluation.tissue.reference`).
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from us_sim.evaluation.report_folder import prepare_folder, write_rows
from us_sim.evaluation.tissue.cases import LARGEST_MESH, LOCKING, MESHES, SCENES, Scene
from us_sim.evaluation.tissue.kept_reference import Reference, kept_reference
from us_sim.evaluation.tissue.own_equations import converged, equations, solved_independently
from us_sim.evaluation.tissue.points import (
    COLUMNS,
    Outcome,
    Point,
    Timing,
    compare,
    held_memory,
    timed,
    volumes,
)
from us_sim.evaluation.tissue.report import table, write_report
from us_sim.progress import Progress
from us_sim.tissue.model import TissueModel
from us_sim.tissue.solvers.solver import SOLVERS, create_solver

__all__ = ["evaluate_tissue", "plan", "settings_of"]

_SETTINGS: dict[str, tuple[dict[str, Any], ...]] = {
    "fem": (),
    "fem_nonlinear": (
        {"iterations": 2, "frame_tolerance": 0.5},
        {"iterations": 4, "frame_tolerance": 0.1},
        {"iterations": 12, "frame_tolerance": 0.01},
        {"iterations": 30, "frame_tolerance": 0.001, "most_iterations": 200},
    ),
    "fem_cg": tuple({"iterations": n} for n in (5, 10, 40, 80, 160)),
    "msds": (
        {"steps": 5},
        {"steps": 80},
        {"stiffness": "fitted"},
        {"stiffness": "fitted", "volume": True},
        {"stiffness": "fitted", "volume": True, "steps": 80},
    ),
    "msds_implicit": (
        {"iterations": 1},
        {"iterations": 10},
        {"iterations": 30},
        {"stiffness": "algorithm_1", "volume": False},
    ),
}
"""What is tried besides each method's own defaults."""
_QUICK_SCENES = ("press_25mm", "press_and_slide", "tilt")
_QUICK_SETTINGS = 2
_SIZES, _QUICK_SIZES = (0.01, 0.005, 0.00325), (0.01, 0.0065)  # m, of the reference's elements

MAIN_SCENE = "press_25mm"  # the scene that is pressed on every mesh


@dataclass(frozen=True)
class Trial:
    """One solver to be made and timed."""

    scene: Scene
    counts: tuple[int, int, int]
    method: str
    setting: dict[str, Any]
    own: bool  # whether its own equations are solved too


def settings_of(method: str) -> list[dict[str, Any]]:
    """The settings that are tried: the default and others.

    Raises:
        ImportError: the method's module cannot be imported.
    """
    SOLVERS.load(method)
    return [{}, *_SETTINGS.get(method, ())]


def plan(quick: bool) -> list[Trial]:
    """Everything that is run, in order.

    The main press takes every mesh, the others the paper's; scenes in which tetrahedra lock the
    paper's finest. All settings are tried on that, and in the main press on the coarsest;
    elsewhere each method's defaults. Methods' own equations are solved for the quick run's scenes.
    """
    trials: list[Trial] = []
    for scene in (SCENES[name] for name in _QUICK_SCENES) if quick else SCENES.values():
        main, locking = scene.name == MAIN_SCENE, scene.name in LOCKING[1:]
        if quick:
            meshes = [MESHES[0], MESHES[-1]] if main else [MESHES[-1]]
        elif main:
            meshes = [*MESHES, LARGEST_MESH]
        else:
            meshes = [MESHES[-1]] if locking else [*MESHES]
        for counts in meshes:
            finest = counts == MESHES[-1]
            for method in SOLVERS:
                settings = _known_settings(method)
                if quick:
                    settings = settings[: 1 + _QUICK_SETTINGS if main and finest else 1]
                elif locking or not (finest or (main and counts == MESHES[0])):
                    settings = settings[:1]
                own = (main and counts == MESHES[0]) or (finest and scene.name in _QUICK_SCENES)
                trials += [Trial(scene, counts, method, setting, own) for setting in settings]
    return trials


def evaluate_tissue(out: Path, quick: bool) -> int:
    """Measure, write tissue.csv, the plots and tissue.md, and print the table.

    Args:
        out: folder to write to; made if it is not there.
        quick: fewer scenes, meshes and settings, and a coarser reference.

    Returns:
        0, or 1 when a method failed; its row says how, and the others are there.

    Raises:
        UsSimError: the folder cannot be written or holds a report, or no reference can be
            computed.
    """
    begin = time.perf_counter()
    prepare_folder(out, "tissue.md")
    trials = plan(quick)
    scenes = {trial.scene.name: trial.scene for trial in trials}
    references = _references(list(scenes.values()), quick)
    points: list[Point] = []
    with Progress("errors and times", len(trials), "points") as progress:
        bench = _Bench(references)
        for done, trial in enumerate(trials):
            counts = "x".join(map(str, trial.counts))
            progress.update(done, f"{trial.scene.name}, {trial.method}, {counts}")
            points += bench.points(trial)
        progress.update(len(trials))
    write_rows(out / "tissue.csv", COLUMNS, [point.row for point in points])
    seconds = time.perf_counter() - begin
    pictures = write_report(out, points, references, quick, seconds)
    print(table(points))
    print(f"Report: {out / 'tissue.md'}; pictures: {', '.join(map(str, pictures))}")
    failed = [point for point in points if point.failure]
    for point in failed:
        print(f"failed: {point.method} ({point.setting}) in {point.scene}: {point.failure}")
    return 1 if failed else 0


def _known_settings(method: str) -> list[dict[str, Any]]:
    try:
        return settings_of(method)
    except ImportError:
        return [{}]  # its trial fails, and says so


def _references(scenes: list[Scene], quick: bool) -> dict[str, Reference]:
    found: dict[str, Reference] = {}
    with Progress("nonlinear reference", len(scenes), "scenes") as progress:
        for done, scene in enumerate(scenes):

            def tell(fraction: float, text: str, done: int = done, name: str = scene.name) -> None:
                progress.update(done + fraction, f"{name}: {text}")

            tell(0.0, "")
            coarse = quick or scene.name in LOCKING[1:]
            found[scene.name] = kept_reference(scene, _QUICK_SIZES if coarse else _SIZES, tell)
        progress.update(len(scenes))
    return found


class _Bench:
    """Runs trials; keeps what several of them share."""

    def __init__(self, references: dict[str, Reference]) -> None:
        self._references = references
        self._models: dict[Any, TissueModel] = {}
        self._exact: dict[Any, tuple[Outcome, str]] = {}  # of the last model
        self._warm: set[str] = set()

    def points(self, trial: Trial) -> Iterator[Point]:
        """The trial's rows: against its own equations, and against the nonlinear reference."""
        model = self._model(trial)
        threads = int(trial.setting.get("threads", 1))
        empty = Point(
            trial.scene.name,
            trial.method,
            len(model.mesh.nodes),
            len(model.mesh.tetrahedra),
            threads,
            ", ".join(f"{key}={value}" for key, value in trial.setting.items()) or "default",
            default=not {key for key in trial.setting if key != "threads"} and threads == 1,
        )
        try:
            before = time.perf_counter()
            solver = create_solver(trial.method, model, **trial.setting)
            setup = time.perf_counter() - before
            if trial.method not in self._warm:
                solver.warm_up()
                self._warm.add(trial.method)
            timing = timed(solver, trial.scene, threads)
            smallest = float((volumes(model, timing.last.nodes) / model.mesh.volumes).min())
            done = replace(
                empty,
                ms_median=timing.median,
                ms_p99=timing.p99,
                memory=float(held_memory(solver)),
                setup=setup,
                smallest_volume_ratio=smallest,
            )
            del solver
            found = Outcome.of(model, timing.last)
        # Whatever breaks in one method must not take the others' results along.
        except Exception as error:
            yield self._failed(empty, error)
            return
        rest = float(model.mesh.volumes.sum())
        if trial.own:
            try:
                exact, words = self._own_solution(trial, model, timing)
                yield replace(done, **compare(found, exact, rest)._asdict(), reference=words)
            except Exception as error:
                yield self._failed(done, error)
        exact, words = self._nonlinear(trial, model)
        yield replace(done, **compare(found, exact, rest)._asdict(), reference=words)

    @staticmethod
    def _failed(point: Point, error: Exception) -> Point:
        words = f"{type(error).__name__}: {error}".replace("\n", " ")
        return replace(point, reference=f"failed: {words}", failure=words)

    def _model(self, trial: Trial) -> TissueModel:
        key = (trial.scene.name, trial.counts)
        if key not in self._models:
            self._models, self._exact = {key: trial.scene.model(trial.counts)}, {}
        return self._models[key]

    def _own_solution(
        self, trial: Trial, model: TissueModel, timing: Timing
    ) -> tuple[Outcome, str]:
        if trial.method == "fem":
            return solved_independently(trial.scene, model, timing.last)
        key = equations(trial.method, trial.setting)
        if key not in self._exact:
            self._exact[key] = converged(trial.scene, model, trial.method, trial.setting)
        return self._exact[key]

    def _nonlinear(self, trial: Trial, model: TissueModel) -> tuple[Outcome, str]:
        if "nonlinear" not in self._exact:
            reference = self._references[trial.scene.name]
            solution = reference.solution
            force, volume = float(solution.force[2]), solution.volume
            self._exact["nonlinear"] = (
                Outcome(solution.at(model.mesh.nodes), force, volume),
                f"nonlinear: scikit-fem, {reference.unknowns} unknowns",
            )
        return self._exact["nonlinear"]
