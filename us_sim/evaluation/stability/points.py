"""One solver on one extreme case: did it stay finite and bounded, come back, and say the truth.

>>> from us_sim.evaluation.stability.cases import StabilityCase
>>> from us_sim.evaluation.stability.points import try_case
>>> trial = try_case("fem_cg", StabilityCase("soft", young_modulus=1.0))
>>> trial.finite, trial.bounded, trial.truthful, trial.recovered_mm
(True, True, True, 0.0)
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import UsSimError
from us_sim.evaluation.stability.cases import StabilityCase, model_of
from us_sim.evaluation.stability.independent_residual import (
    IndependentResidual,
    averaged_hooke_forces,
    hooke_forces,
    neo_hookean_forces,
    rounding_of_forces,
    spring_forces,
    volume_forces,
)
from us_sim.evaluation.stability.meshes import parts
from us_sim.evaluation.stability.motions import LIFTED, poses_of
from us_sim.geometry.pose import Pose
from us_sim.settings.registry import SOLVERS
from us_sim.settings.setting import rules_of
from us_sim.tissue.deformation import Deformation
from us_sim.tissue.elasticity.springs import fitted_springs, springs_of
from us_sim.tissue.elasticity.volume_term import volume_term
from us_sim.tissue.model import TissueModel
from us_sim.tissue.solvers.solver import TissueSolver, create_solver

__all__ = [
    "KEPT",
    "QUASI_STATIC",
    "Trial",
    "agrees",
    "damping_factor",
    "equations_of",
    "run_trial",
    "spring_settings",
    "try_case",
]

QUASI_STATIC = ("fem", "fem_nonlinear", "fem_cg")
"""Methods without masses: a part that is not held has no position of rest, and is refused."""

FAILED, KEPT = "came out not finite or far away", "so the last good state was kept"
"""What a solver says of a frame that failed, and of one after which it kept the last good state."""

_NEGLIGIBLE, _FACTOR = 1e-5, 2.0
"""Residuals below this are the same, and above it they agree within this factor."""

_FRAMES_OF_RELEASE = {True: 40, False: 150}
"""Frames after the release that a quasi-static and a dynamic method are given."""

_RECOVERED = 1e-4
"""Of the thickness: a tissue that is so near its rest has come back."""


@dataclass(eq=False)
class Trial:
    """What came of a case."""

    finite: bool = True
    bounded: bool = True
    truthful: bool = True
    refused: bool = False
    failure: str = ""  # why it counts as failed though the four above are fine
    recovered_mm: float = math.nan  # farthest node from rest, in the end
    recovery_frames: int | None = None  # until it was near rest; None when it never was
    residual_reported: float = math.nan  # in the last frame with a probe, or the first untrue one
    residual_checked: float = math.nan  # in the same frame
    step_limit_predicted: float = math.nan  # s
    step_limit_observed: float = math.nan  # s
    slowest_ms: float = 0.0
    kept: int = 0  # frames that failed, so that the solver kept its last good state or rest
    actions: list[str] = field(default_factory=list)  # what it said, each once

    @property
    def passed(self) -> bool:
        """Whether nothing went wrong."""
        return self.finite and self.bounded and self.truthful and not self.failure

    def say(self, action: str) -> None:
        """Add what a solver said."""
        if action and action not in self.actions:
            self.actions.append(action)


def try_case(method: str, case: StabilityCase) -> Trial:
    """Make the solver and run the case; a refusal in one sentence is a result, too."""
    trial = Trial()
    unheld = False
    try:
        model = model_of(case)
        unheld = method in QUASI_STATIC and not _held(model).all()
        solver = create_solver(method, model, **_settings(method, case, model))
    except UsSimError as error:
        trial.refused = True
        trial.say(f"refused: {error}")
        if not unheld and not (case.stabilisation == "substeps" and method == "msds"):
            trial.failure = "was refused, and has nothing to be refused for"
        return trial
    except Exception as error:  # whatever it is, a user would see a traceback
        trial.failure = f"raised {type(error).__name__} while it was made: {error}"
        return trial
    if unheld:
        trial.failure = "was not refused, though it is not held"
    run_trial(solver, equations_of(method, case, model), case, trial)
    return trial


def run_trial(
    solver: TissueSolver, residual: IndependentResidual, case: StabilityCase, trial: Trial
) -> None:
    """Move the probe as the case says, release, and note what the solver returned."""
    model = solver.model
    poses = poses_of(case.motion, model.mesh, case.depth)
    bound = _bound(model, poses)
    thickness = float(np.ptp(model.mesh.nodes[:, 2]))
    released = None if case.release == "removed" else LIFTED
    frames = _FRAMES_OF_RELEASE[solver.name in QUASI_STATIC]
    last: Deformation | None = None
    stuck = 0
    for number, pose in enumerate([*poses, *[released] * frames]):
        start = time.perf_counter()
        try:
            deformation = solver.deform(pose)
        except Exception as error:  # a frame must never raise
            trial.finite = False
            trial.failure = f"raised {type(error).__name__} in frame {number}: {error}"
            return
        trial.slowest_ms = max(trial.slowest_ms, 1e3 * (time.perf_counter() - start))
        trial.say(deformation.action)
        if not _finite(deformation):
            trial.finite = False
            return
        failed = FAILED in deformation.action
        kept = KEPT in deformation.action
        if failed:
            trial.kept += 1
            residual.forget()
        if kept:
            same = last is None or np.array_equal(deformation.nodes, last.nodes)
            if not same or (last is not None and deformation.residual != last.residual):
                trial.failure = "said that it kept the last good state, and returned another one"
        free = number - len(poses)
        moved = np.abs(deformation.nodes - model.mesh.nodes).max()
        trial.bounded = trial.bounded and bool(moved <= bound)
        compared = free < 5 or free % 8 == 0 or free == frames - 1
        if not failed:
            checked = residual.check(deformation, pose)  # every frame: loads refer to those before
            if compared:
                _compare(trial, deformation.residual, *checked, free < 0)
        if free >= 0:
            away = _from_rest(model, deformation.nodes)
            trial.recovered_mm = 1e3 * away
            if away > _RECOVERED * thickness:
                trial.recovery_frames = None
            elif trial.recovery_frames is None:
                trial.recovery_frames = free + 1
            if deformation is last:
                return  # settled
        last = deformation
        stuck = stuck + 1 if failed else 0
    if stuck >= frames and _held(model).all():
        trial.failure = "went on failing after the release, in every frame"


def agrees(reported: float, checked: float, rounding: float) -> bool:
    """Whether a reported residual is true: within a factor of two, or both negligible.

    Negligible is below 1e-5, or below what rounding the nodes to doubles makes.
    """
    floor = max(_NEGLIGIBLE, rounding)
    if not (math.isfinite(reported) and math.isfinite(checked)):
        return False
    low, high = sorted((reported, checked))
    return high <= floor or high <= _FACTOR * low


def damping_factor(case: StabilityCase, model: TissueModel) -> float:
    """s, damping over stiffness at which a node is damped as the case says.

    Critical damping is that of the root mean square, over the free nodes, of the frequency of a
    node among held neighbours.
    """
    free = ~model.fixed
    if not free.any() or case.damping == 0:
        return 0.0
    springs = springs_of(model.mesh, model.materials)
    stiffness = np.zeros(len(free))
    np.add.at(stiffness, springs.edges, springs.stiffness[:, None])
    return 2 * case.damping / math.sqrt(float((stiffness / model.lumped_mass)[free].mean()))


def equations_of(method: str, case: StabilityCase, model: TissueModel) -> IndependentResidual:
    """What checks the residuals of a method on a case."""
    mesh, materials = model.mesh, model.materials
    whole = materials.young_modulus / (2 * (1 + materials.poisson_ratio))
    modulus = whole / (1 - 2 * materials.poisson_ratio) + whole
    forces: dict[str, Callable[..., NDArray[np.float64]]] = {
        "fem": averaged_hooke_forces,
        "fem_nonlinear": neo_hookean_forces,
        "fem_cg": hooke_forces,
    }
    if method in forces:
        rounding = rounding_of_forces(mesh, modulus)
        return IndependentResidual(
            model, lambda displacement: forces[method](mesh, materials, displacement), rounding
        )
    springs = (springs_of if case.springs == "algorithm_1" else fitted_springs)(mesh, materials)
    digit = np.finfo(np.float64).eps * np.abs(mesh.nodes).max()
    volume = volume_term(mesh, materials, springs)
    with_volume = case.springs == "fitted with volume"

    def of_springs(displacement: NDArray[np.float64]) -> NDArray[np.float64]:
        force = spring_forces(springs.edges, springs.stiffness, mesh.nodes, displacement)
        if with_volume:
            force += volume_forces(
                mesh, volume.element, volume.nodal, displacement, yielding=method == "msds"
            )
        return force

    rounding = 4 * digit * float(np.linalg.norm(springs.stiffness))
    if with_volume:
        rounding += rounding_of_forces(mesh, volume.element + volume.nodal)
    return IndependentResidual(model, of_springs, rounding)


def spring_settings(case: StabilityCase) -> dict[str, Any]:
    """Settings of methods with springs for a case's ``springs``."""
    return {
        "stiffness": "algorithm_1" if case.springs == "algorithm_1" else "fitted",
        "volume": case.springs == "fitted with volume",
    }


def _settings(method: str, case: StabilityCase, model: TissueModel) -> dict[str, Any]:
    known = rules_of(SOLVERS.settings(method))
    asked: dict[str, Any] = {
        "time_step": case.time_step,
        "damping_factor": damping_factor(case, model),
        "stabilisation": case.stabilisation,
        **spring_settings(case),
    }
    return {name: value for name, value in asked.items() if name in known}


def _finite(deformation: Deformation) -> bool:
    numbers = (deformation.nodes, deformation.force, deformation.torque, deformation.residual)
    return all(bool(np.isfinite(number).all()) for number in numbers)


def _held(model: TissueModel) -> NDArray[np.bool_]:
    """(P,) whether each connected part has three fixed nodes that are not on one line."""
    part = parts(model.mesh)
    held = np.zeros(part.max() + 1, dtype=bool)
    for one in range(len(held)):
        nodes = model.mesh.nodes[model.fixed & (part == one)]
        if len(nodes) > 2:
            spread = np.linalg.svd(nodes - nodes.mean(axis=0), compute_uv=False)
            held[one] = spread[1] > 1e-9 * spread[0]
    return held


def _bound(model: TissueModel, poses: list[Pose | None]) -> float:
    """m, three times as far as any node can be pushed; unheld parts may be thrown farther."""
    nodes, box = model.mesh.nodes, model.collider.offset_box
    reach = max(
        float(np.linalg.norm(pose.position))
        for pose in poses
        if pose is not None and pose is not LIFTED
    )
    size = np.ptp(nodes, axis=0)
    bound = 3 * (float(np.linalg.norm(size)) + reach + 2 * float(box[2] + box[3]) + 0.1)
    return bound if _held(model).all() else max(bound, 10 * float(size.max()))


def _compare(trial: Trial, reported: float, checked: float, rounding: float, pressed: bool) -> None:
    if not trial.truthful:
        return
    trial.truthful = agrees(reported, checked, rounding)
    if pressed or not trial.truthful:
        trial.residual_reported, trial.residual_checked = float(reported), checked


def _from_rest(model: TissueModel, nodes: NDArray[np.float64]) -> float:
    """m, farthest node from rest; unheld parts are laid over their rest by a rigid motion first."""
    rest = model.mesh.nodes
    part = parts(model.mesh)
    away = 0.0
    for one, held in enumerate(_held(model)):
        there, here = rest[part == one], nodes[part == one]
        if not held:
            there, middle = there - there.mean(axis=0), here.mean(axis=0)
            u, _, v = np.linalg.svd((here - middle).T @ there)
            turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
            here = (here - middle) @ turn
        away = max(away, float(np.linalg.norm(here - there, axis=1).max()))
    return away
