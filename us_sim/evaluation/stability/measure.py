"""One solver on one extreme case: is it finite, bounded, truthful, and at rest after release?

>>> from us_sim.evaluation.stability.cases import StabilityCase
>>> from us_sim.evaluation.stability.measure import try_case
>>> trial = try_case("fem_cg", StabilityCase("soft", young_modulus=1.0))
>>> trial.finite, trial.bounded, trial.truthful, trial.recovered_mm
(True, True, True, 0.0)
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from us_sim.errors import UsSimError
from us_sim.evaluation.independent_forces import Forces, bound_imbalance
from us_sim.evaluation.stability.cases import (
    LIFTED,
    SMALL,
    StabilityCase,
    make_mesh,
    make_model,
    make_poses,
)
from us_sim.evaluation.tissue_methods import TISSUE_METHODS
from us_sim.geometry.pose import Pose
from us_sim.tissue.mesh.tetrahedral_mesh import signed_volumes
from us_sim.tissue.model import Deformation, Intervention, TissueModel
from us_sim.tissue.solvers.solver import TissueSolver, create_solver


@dataclass(eq=False)
class Trial:
    """Result of a solver in a case."""

    finite: bool = True
    bounded: bool = True
    truthful: bool = True
    refusal: str = ""  # the sentence with which the method refused the case
    failure: str = ""  # a fault besides those above
    recovered_mm: float = math.nan  # farthest node from rest, at the end
    recovery_frames: int | None = None  # until it is near rest; None if it never is
    residual_reported: float = math.nan  # in the last frame with a probe, or the first untrue one
    residual_checked: float = math.nan  # in the same frame
    held: list[float] = field(default_factory=list)  # residuals since the probe stopped
    held_inverted: int = 0  # tetrahedra, at the end of the hold
    slowest_ms: float = 0.0
    kept: int = 0  # failed frames, in which the solver kept its last good state or rest
    actions: list[tuple[str, ...]] = field(default_factory=list)  # reported by frames, each once

    @property
    def fault(self) -> str:
        """The first fault; empty without one."""
        if self.failure or (self.finite and self.bounded and self.truthful):
            return self.failure
        if not (self.finite and self.bounded):
            return "not bounded" if self.finite else "not finite"
        reported, checked = self.residual_reported, self.residual_checked
        return f"reported a residual of {reported:.3g}, but it is at least {checked:.3g}"

    @property
    def frames_to_balance(self) -> int | None:
        """Frames of the hold until the residual stays small; None if it never does."""
        large = [number for number, residual in enumerate(self.held) if not residual <= SMALL]
        after = large[-1] + 1 if large else 0
        return after if after < len(self.held) else None


def try_case(method: str, case: StabilityCase) -> Trial:
    """Make the solver and run the case; a refusal in one sentence is also a result."""
    trial = Trial()
    is_dynamic = TISSUE_METHODS[method].is_dynamic
    try:
        model = make_model(case)
        solver = create_solver(method, model, **_make_settings(case) if is_dynamic else {})
    except UsSimError as error:
        trial.refusal = str(error)
        if not (is_dynamic and case.stabilisation == "substeps"):  # it may need too many
            trial.failure = "was refused, and has nothing to be refused for"
        return trial
    except Exception as error:  # a user would see a traceback
        trial.failure = f"raised {type(error).__name__} while it was made: {error}"
        return trial
    run_trial(solver, TISSUE_METHODS[method].equations(model), case, trial)
    return trial


def run_trial(solver: TissueSolver, forces: Forces, case: StabilityCase, trial: Trial) -> None:
    """Move the probe as in the case, release it, and record the solver's results."""
    model = solver.model
    poses = make_poses(case.motion, model.mesh, case.depth)
    bound = _compute_bound(model, poses)
    moving = len(poses)
    poses = [*poses, *poses[-1:] * case.held]
    released = None if case.release == "removed" else LIFTED
    frames = 150 if TISSUE_METHODS[solver.name].is_dynamic else 40  # after the release
    last: Deformation | None = None
    stuck, load = 0, 0.0
    for number, pose in enumerate([*poses, *[released] * frames]):
        deformation = _run_frame(solver, pose, number, trial)
        if deformation is None:
            return
        if case.held and moving <= number + 1 <= len(poses):
            trial.held.append(float(deformation.residual))
            volumes = signed_volumes(deformation.nodes, model.mesh.tetrahedra)
            trial.held_inverted = int((volumes <= 0).sum())
        failed = Intervention.FRAME_FAILED in deformation.interventions
        if failed:
            _check_kept_state(deformation, last, trial)
        away = float(np.linalg.norm(deformation.nodes - model.mesh.nodes, axis=1).max())
        trial.bounded = trial.bounded and away <= bound
        if number >= len(poses):
            _record_recovery(model, away, number - len(poses), trial)
            if deformation is last:
                break  # settled
        elif not failed:
            load = _check_residual(model, forces, deformation, load, trial)
        last = deformation
        stuck = stuck + 1 if failed else 0
    if stuck >= frames:
        trial.failure = "went on failing after the release, in every frame"
    if trial.held and TISSUE_METHODS[solver.name].is_judged_at_rest and not trial.failure:
        trial.failure = _describe_imbalance(trial, case)


def _run_frame(
    solver: TissueSolver, pose: Pose | None, number: int, trial: Trial
) -> Deformation | None:
    """Run one frame; return None if the solver raised, or if its numbers are not finite."""
    start = time.perf_counter()
    try:
        deformation = solver.deform(pose)
    except Exception as error:  # a frame must never raise
        trial.finite = False
        trial.failure = f"raised {type(error).__name__} in frame {number}: {error}"
        return None
    trial.slowest_ms = max(trial.slowest_ms, 1e3 * (time.perf_counter() - start))
    if deformation.actions and deformation.actions not in trial.actions:
        trial.actions.append(deformation.actions)
    numbers = (deformation.nodes, deformation.force, deformation.torque, deformation.residual)
    trial.finite = all(bool(np.isfinite(number).all()) for number in numbers)
    return deformation if trial.finite else None


def _check_kept_state(deformation: Deformation, last: Deformation | None, trial: Trial) -> None:
    """Count a failed frame, whose kept state must be that of the last frame."""
    trial.kept += 1
    if Intervention.KEPT_STATE in deformation.interventions and last is not None:
        same = np.array_equal(deformation.nodes, last.nodes)
        if not same or deformation.residual != last.residual:
            trial.failure = "said that it kept the last good state, and returned another"


def _record_recovery(model: TissueModel, away: float, number: int, trial: Trial) -> None:
    """Record the distance from rest (m) in a frame after the release."""
    trial.recovered_mm = 1e3 * away
    if away > 1e-4 * float(np.ptp(model.mesh.nodes[:, 2])):
        trial.recovery_frames = None
    elif trial.recovery_frames is None:
        trial.recovery_frames = number + 1


def _check_residual(
    model: TissueModel, forces: Forces, deformation: Deformation, load: float, trial: Trial
) -> float:
    """Check the residual under the probe; return the greatest load (N) of the frames so far.

    The residual refers to that load, also in frames with less.
    """
    if model.fixed[deformation.contact_nodes].all():
        return load
    unbalanced, rounding, own_load = bound_imbalance(model, forces, deformation)
    load = max(load, own_load)
    if load > 0.0 and trial.truthful:
        reported, checked = float(deformation.residual), unbalanced / load
        trial.truthful = is_residual_true(reported, checked, rounding / load)
        trial.residual_reported, trial.residual_checked = reported, checked
    return load


def _describe_imbalance(trial: Trial, case: StabilityCase) -> str:
    """Describe the fault under a held probe; empty if tissue is in balance and not inverted."""
    if trial.frames_to_balance is None:
        return f"held for {case.held} frames it was left with a residual of {trial.held[-1]:.3g}"
    if trial.held_inverted:
        return f"held for {case.held} frames it left {trial.held_inverted} tetrahedra inside out"
    return ""


def is_residual_true(reported: float, checked: float, rounding: float) -> bool:
    """Return True if a reported residual is at least half of ``checked``, its lower bound.

    Negligible bounds make it true: below 1e-5, or below the ``rounding`` of nodes to doubles.
    """
    return math.isfinite(checked) and checked <= max(1e-5, rounding, 2.0 * reported)


def _make_settings(case: StabilityCase) -> dict[str, Any]:
    """Make settings of a method with masses; damping 1 is about critical for one edge."""
    mesh = make_mesh(case.mesh)
    nodes, edges = mesh.nodes, mesh.edges
    edge = float(np.linalg.norm(nodes[edges[:, 1]] - nodes[edges[:, 0]], axis=1).mean())
    modulus = case.young_modulus * math.sqrt(case.contrast)
    return {
        "time_step": case.time_step,
        "damping_factor": case.damping * edge * math.sqrt(case.density / modulus),
        "stabilisation": case.stabilisation,
    }


def _compute_bound(model: TissueModel, poses: list[Pose | None]) -> float:
    """Compute the bound (m) of displacements: three times as far as a node can be pushed."""
    nodes, box = model.mesh.nodes, model.collider.offset_box
    pressing = (pose for pose in poses if pose is not None and pose is not LIFTED)
    reach = max(float(np.linalg.norm(pose.position)) for pose in pressing)
    size = np.ptp(nodes, axis=0)
    return 3 * (float(np.linalg.norm(size)) + reach + 2 * float(box[2] + box[3]) + 0.1)
