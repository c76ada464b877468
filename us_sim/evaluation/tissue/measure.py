"""`us-sim evaluate tissue`: how wrong each method is, against how long it takes.

Every method follows the probe's path at its own pace, frame by frame; what it says at the path's
end is compared with its own equations solved without regard to time, and with large deformation on
fine quadratic elements (`us_sim.evaluation.tissue.reference`).
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from us_sim.evaluation.block import LARGEST_MESH, MESHES
from us_sim.evaluation.report_folder import ReportFolder
from us_sim.evaluation.row import failures, words_of
from us_sim.evaluation.steps import steps
from us_sim.evaluation.tissue.cases import LOCKING, MAIN_SCENE, SCENES, Scene
from us_sim.evaluation.tissue.kept_reference import Reference, kept_reference
from us_sim.evaluation.tissue.own_equations import converged, solved_independently
from us_sim.evaluation.tissue.points import Outcome, Point, Timing, compare, held_memory, timed
from us_sim.evaluation.tissue.report import table, write_report
from us_sim.evaluation.tissue_methods import TISSUE_METHODS, Setting
from us_sim.progress import Progress
from us_sim.tissue.mesh.tetrahedral_mesh import signed_volumes
from us_sim.tissue.model import TissueModel
from us_sim.tissue.solvers.solver import create_solver

_QUICK_SCENES = ("press_25mm", "press_and_slide", "tilt")
_QUICK_SETTINGS = 3  # of each method, the defaults among them
_SIZES, _QUICK_SIZES = (0.01, 0.0065, 0.005), (0.01, 0.0065)  # m, of the reference's elements


@dataclass(frozen=True)
class Trial:
    """One solver to be made and timed."""

    scene: Scene
    counts: tuple[int, int, int]
    method: str
    setting: Setting
    own: bool  # whether its own equations are solved too

    def __str__(self) -> str:
        """For a person who waits for it."""
        return f"{self.scene.name}, {self.method}, {'x'.join(map(str, self.counts))}"


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
            own = (main and counts == MESHES[0]) or (finest and scene.name in _QUICK_SCENES)
            for method in TISSUE_METHODS.values():
                settings = method.settings
                if quick:
                    settings = settings[: _QUICK_SETTINGS if main and finest else 1]
                elif locking or not (finest or (main and counts == MESHES[0])):
                    settings = settings[:1]
                trials += [Trial(scene, counts, method.name, setting, own) for setting in settings]
    return trials


def evaluate_tissue(out: Path, quick: bool) -> int:
    """Write tissue.csv, the plots and tissue.md, as `us_sim.evaluation` says.

    A quick run has fewer scenes, meshes and settings, and a coarser reference. It raises UsSimError
    too where no reference can be computed.
    """
    folder = ReportFolder("tissue", out, quick)
    trials = plan(quick)
    references = _references({trial.scene.name: trial.scene for trial in trials}.values(), quick)
    bench = _Bench(references)
    points = [
        point
        for trial in steps("errors and times", trials, "points")
        for point in bench.points(trial)
    ]
    folder.write_rows("tissue", points)
    write_report(folder, points, references)
    return folder.finish(table(points), failures(points))


def _references(scenes: Iterable[Scene], quick: bool) -> dict[str, Reference]:
    scenes, found = list(scenes), {}
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
    """Runs trials; keeps what several of them have in common."""

    def __init__(self, references: dict[str, Reference]) -> None:
        self._references = references
        self._models: dict[Any, TissueModel] = {}
        self._exact: dict[Any, tuple[Outcome, str]] = {}  # of the last model
        self._warm: set[str] = set()

    def points(self, trial: Trial) -> Iterator[Point]:
        """The trial's rows: against its own equations, and against the nonlinear reference."""
        model = self._model(trial)
        threads = int(trial.setting.get("threads", 1))
        setting = ", ".join(f"{key}={value}" for key, value in trial.setting.items()) or "default"
        empty = Point(
            *(trial.scene.name, trial.method, len(model.mesh.nodes), len(model.mesh.tetrahedra)),
            *(threads, setting),
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
            volumes = signed_volumes(timing.last.nodes, model.mesh.tetrahedra)
            done = replace(
                empty,
                ms_median=timing.median,
                ms_p99=timing.p99,
                memory=float(held_memory(solver)),
                setup=setup,
                smallest_volume_ratio=float((volumes / model.mesh.volumes).min()),
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
        words = words_of(error)
        return replace(point, reference=f"failed: {words}", failure=words)

    def _model(self, trial: Trial) -> TissueModel:
        key = (trial.scene.name, trial.counts)
        if key not in self._models:
            self._models, self._exact = {key: trial.scene.model(trial.counts)}, {}
        return self._models[key]

    def _own_solution(
        self, trial: Trial, model: TissueModel, timing: Timing
    ) -> tuple[Outcome, str]:
        method = TISSUE_METHODS[trial.method]
        if method.patient is None:
            return solved_independently(trial.scene, model, timing.last)
        key = method.equations(trial.setting)
        if key not in self._exact:
            self._exact[key] = converged(trial.scene, model, method, trial.setting)
        return self._exact[key]

    def _nonlinear(self, trial: Trial, model: TissueModel) -> tuple[Outcome, str]:
        if "nonlinear" not in self._exact:
            reference = self._references[trial.scene.name]
            there = reference.solution
            outcome = Outcome(there.at(model.mesh.nodes), float(there.force[2]), there.volume)
            words = f"nonlinear: scikit-fem, {reference.unknowns} unknowns"
            self._exact["nonlinear"] = outcome, words
        return self._exact["nonlinear"]
