"""Every method follows a probe's path at its own pace, and is compared at the path's end.

Its nodes are compared with its own equations, solved without regard to time, and with large
deformation on fine quadratic elements (`us_sim.evaluation.tissue.reference`).

>>> import numpy as np
>>> from us_sim.evaluation.tissue.measure import Outcome, compare
>>> nodes = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
>>> exact = Outcome(nodes * 0.1, 10.0, 1.0)
>>> errors = compare(Outcome(nodes * 0.11, 9.0, 1.01), exact, rest_volume=2.0)
>>> {name: round(error, 4) for name, error in errors.items()}
{'rel_l2_error': 0.1, 'max_error_mm': 10.0, 'force_error': 0.1, 'volume_error': 0.005}
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from us_sim.evaluation.block import LARGEST_MESH, MESHES
from us_sim.evaluation.report import Row, not_a_column, words_of
from us_sim.evaluation.tissue.cases import LOCKING, MAIN_SCENE, SCENES, Scene
from us_sim.evaluation.tissue.finite_elements import LinearEquations
from us_sim.evaluation.tissue.reference import Reference
from us_sim.evaluation.tissue_methods import TISSUE_METHODS, Setting, TissueMethod
from us_sim.tissue.contact.probe_gap import push_out
from us_sim.tissue.mesh.tetrahedral_mesh import signed_volumes
from us_sim.tissue.model import Deformation, TissueModel
from us_sim.tissue.solvers.solver import TissueSolver, create_solver

_QUICK_SCENES = ("press_25mm", "press_and_slide", "tilt")


@dataclass(frozen=True)
class Point(Row):
    """A row of tissue.csv, and further numbers for the report."""

    scene: str
    method: str
    nodes: int
    tets: int
    threads: int
    setting: str
    ms_median: float = float("nan")
    ms_p99: float = float("nan")
    rel_l2_error: float = float("nan")  # of the nodes' displacements
    max_error_mm: float = float("nan")  # of the worst node
    force_error: float = float("nan")  # of the force along the probe's axis, relative
    volume_error: float = float("nan")  # of the block's volume, over its volume at rest
    estimated_error: float = float("nan")  # rel_l2_error as the method itself estimates it
    reference: str = ""  # in words
    own: bool = not_a_column(False)  # compared with the method's own converged equations
    default: bool = not_a_column(False)
    memory: float = not_a_column(float("nan"))  # bytes
    setup: float = not_a_column(float("nan"))  # s
    smallest_volume_ratio: float = not_a_column(float("nan"))
    failure: str = not_a_column("")

    @property
    def title(self) -> str:
        return f"{self.method} ({self.setting}), {self.scene}, {self.nodes:,} nodes"


@dataclass(frozen=True, eq=False)
class Outcome:
    """The end of a path by a method, or by a reference at the same nodes."""

    displacement: NDArray[np.float64]  # (N, 3) m
    force: float  # N, on the probe along its axis
    volume: float  # m3, of the deformed block

    @classmethod
    def of(cls, model: TissueModel, deformation: Deformation) -> Outcome:
        """The outcome of a solver."""
        return cls(
            deformation.nodes - model.mesh.nodes,
            float(deformation.force[2]),
            float(signed_volumes(deformation.nodes, model.mesh.tetrahedra).sum()),
        )


def compare(found: Outcome, exact: Outcome, rest_volume: float) -> dict[str, Any]:
    """Errors of ``found``, by their columns of `Point`."""
    difference = found.displacement - exact.displacement
    return {
        "rel_l2_error": float(np.linalg.norm(difference) / np.linalg.norm(exact.displacement)),
        "max_error_mm": float(np.linalg.norm(difference, axis=1).max() * 1e3),
        "force_error": abs(found.force / exact.force - 1.0),
        "volume_error": abs(found.volume - exact.volume) / rest_volume,
    }


@dataclass(frozen=True)
class Trial:
    """One solver to be made and timed."""

    scene: Scene
    counts: tuple[int, int, int]
    method: str
    setting: Setting
    own: bool  # whether its own equations are solved too

    def __str__(self) -> str:
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
                    settings = settings[: 3 if main and finest else 1]
                elif locking or not (finest or (main and counts == MESHES[0])):
                    settings = settings[:1]
                trials += [Trial(scene, counts, method.name, setting, own) for setting in settings]
    return trials


class Bench:
    """Runs trials; keeps the model and the references that trials in a row have in common."""

    def __init__(self, references: dict[str, Reference]) -> None:
        self._references = references
        self._models: dict[Any, TissueModel] = {}
        self._exact: dict[Any, tuple[Outcome, str]] = {}  # of the last model
        self._warm: set[str] = set()

    def run(self, trial: Trial) -> Iterator[Point]:
        """The trial's rows: against its own equations, and against the nonlinear reference."""
        model = self._model(trial)
        threads = int(trial.setting.get("threads", 1))
        setting = ", ".join(f"{key}={value}" for key, value in trial.setting.items()) or "default"
        done = Point(
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
            milliseconds, last = _timed(solver, trial.scene, threads)
            estimated = solver.discretisation_error()
            volumes = signed_volumes(last.nodes, model.mesh.tetrahedra)
            done = replace(
                done,
                ms_median=float(np.median(milliseconds)),
                ms_p99=float(np.percentile(milliseconds, 99)),
                memory=float(held_memory(solver)),
                setup=setup,
                smallest_volume_ratio=float((volumes / model.mesh.volumes).min()),
                estimated_error=math.nan if estimated is None else estimated,
            )
            del solver
            found = Outcome.of(model, last)
        # Whatever breaks in one method must not take the others' results along.
        except Exception as error:
            yield self._failed(done, error)
            return
        rest = float(model.mesh.volumes.sum())
        if trial.own:
            try:
                exact, words = self._own_solution(trial, model, last)
                yield replace(done, **compare(found, exact, rest), reference=words, own=True)
            except Exception as error:
                yield self._failed(done, error)
        exact, words = self._nonlinear(trial, model)
        yield replace(done, **compare(found, exact, rest), reference=words)

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
        self, trial: Trial, model: TissueModel, last: Deformation
    ) -> tuple[Outcome, str]:
        method = TISSUE_METHODS[trial.method]
        if method.patient is None:
            return _solved_independently(trial.scene, model, last)
        key = method.equations(trial.setting)
        if key not in self._exact:
            self._exact[key] = _converged(trial.scene, model, method, trial.setting)
        return self._exact[key]

    def _nonlinear(self, trial: Trial, model: TissueModel) -> tuple[Outcome, str]:
        if "nonlinear" not in self._exact:
            reference = self._references[trial.scene.name]
            there = reference.solution
            outcome = Outcome(there.at(model.mesh.nodes), float(there.force[2]), there.volume)
            words = f"nonlinear: scikit-fem, {reference.unknowns} unknowns"
            self._exact["nonlinear"] = outcome, words
        return self._exact["nonlinear"]


def _timed(solver: TissueSolver, scene: Scene, threads: int) -> tuple[list[float], Deformation]:
    """ms of every frame of the path, followed three times from rest or for 20 s, and the last.

    The first pass warms caches and does not count, if there is another.
    """
    frames: list[float] = []
    begin = time.perf_counter()
    with threadpool_limits(threads):
        for number in range(3):
            solver.reset()
            frames = [] if number <= 1 else frames
            for pose in scene.path:
                before = time.perf_counter()
                last = solver.deform(pose)
                frames.append((time.perf_counter() - before) * 1e3)
            if time.perf_counter() - begin > 20.0:
                break
    return frames, last


def _converged(
    scene: Scene, model: TissueModel, method: TissueMethod, setting: Setting
) -> tuple[Outcome, str]:
    """The end by an iterative method that goes on until nothing changes, and how far it came.

    It ends after 400 frames at the last pose, or 10 s.
    """
    settings = method.without_effort(setting) | dict(method.patient or {})
    solver = create_solver(method.name, model, **settings)
    for pose in scene.path:
        deformation = solver.deform(pose)
    begin = time.perf_counter()
    for _ in range(400):
        before, deformation = deformation, solver.deform(scene.path[-1])
        if deformation is before or time.perf_counter() - begin > 10.0:
            break
    settled = "settled" if deformation is before else "cut off"
    words = f"own equations: {method.name} {settled} at residual {deformation.residual:.0e}"
    return Outcome.of(model, deformation), words


def _solved_independently(
    scene: Scene, model: TissueModel, deformation: Deformation
) -> tuple[Outcome, str]:
    """The linear equations by scikit-fem and SciPy, with the contact that `fem` found."""
    pose, touched = scene.path[-1], deformation.contact_nodes
    _, normals = push_out(scene.collider, pose, deformation.nodes[touched], model.contact_spacing)
    depths = np.einsum("ij,ij->i", normals, deformation.nodes[touched] - model.mesh.nodes[touched])
    displacement, forces = LinearEquations(model).solve(touched, normals, depths)
    force = -float(((forces[:, None] * normals).sum(axis=0) @ pose.rotation)[2])
    nodes = model.mesh.nodes + displacement
    volume = float(signed_volumes(nodes, model.mesh.tetrahedra).sum())
    words = "own equations: scikit-fem and SciPy on fem's contact"
    return Outcome(displacement, force, volume), words


def held_memory(solver: TissueSolver) -> int:
    """Bytes of all arrays that a solver holds, each once, those of its mesh included."""
    seen: set[int] = set()
    arrays: dict[int, int] = {}
    left: list[Any] = [solver]
    while left:
        thing = left.pop()
        if id(thing) in seen:
            continue
        seen.add(id(thing))
        if isinstance(thing, np.ndarray):
            while isinstance(thing.base, np.ndarray):
                thing = thing.base
            arrays[id(thing)] = thing.nbytes
        elif isinstance(thing, dict):
            left.extend(thing.values())
        elif isinstance(thing, list | tuple | set | frozenset):
            left.extend(thing)
        elif not isinstance(thing, type) and hasattr(thing, "__dict__") and not callable(thing):
            left.extend(vars(thing).values())
    return sum(arrays.values())
