"""One solver on one extreme case: finite, bounded, back at rest after release, and truthful?

>>> from us_sim.evaluation.stability.cases import StabilityCase
>>> from us_sim.evaluation.stability.measure import try_case
>>> trial = try_case("fem_cg", StabilityCase("soft", young_modulus=1.0))
>>> trial.finite, trial.bounded, trial.truthful, trial.recovered_mm
(True, True, True, 0.0)
"""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import UsSimError
from us_sim.evaluation.independent_residual import IndependentResidual, MsdsSettings
from us_sim.evaluation.stability.cases import (
    LIFTED,
    SMALL,
    StabilityCase,
    model_of,
    parts,
    poses_of,
)
from us_sim.evaluation.timing import frames_until
from us_sim.evaluation.tissue_methods import TISSUE_METHODS
from us_sim.geometry.pose import Pose
from us_sim.settings.quantity import Quantity
from us_sim.settings.registry import SOLVERS
from us_sim.settings.setting import rules_of
from us_sim.tissue.elasticity.springs import springs_of
from us_sim.tissue.mesh.tetrahedral_mesh import signed_volumes
from us_sim.tissue.model import Deformation, Intervention, TissueModel, TissueState
from us_sim.tissue.solvers.solver import TissueSolver, create_solver


@dataclass(eq=False)
class Trial:
    """Result of a case."""

    finite: bool = True
    bounded: bool = True
    truthful: bool = True
    refusal: str = ""  # the sentence with which the method refused the case
    failure: str = ""  # why it counts as failed though the four above are fine
    recovered_mm: float = math.nan  # farthest node from rest, in the end
    recovery_frames: int | None = None  # until it was near rest; None when it never was
    residual_reported: float = math.nan  # in the last frame with a probe, or the first untrue one
    residual_checked: float = math.nan  # in the same frame
    held: list[float] = field(default_factory=list)  # residuals since the probe stopped
    held_inverted: int = 0  # tetrahedra, at the end of the hold
    step_limit_predicted: float = math.nan  # s
    step_limit_observed: float = math.nan  # s
    slowest_ms: float = 0.0
    kept: int = 0  # frames that failed, so that the solver kept its last good state or rest
    actions: list[tuple[str, ...]] = field(default_factory=list)  # that frames reported, each once

    @property
    def fault(self) -> str:
        """The first thing that went wrong; empty where nothing did."""
        if not (self.failure or self.finite):
            return "not finite"
        if not (self.failure or self.bounded):
            return "not bounded"
        if self.failure or self.truthful:
            return self.failure
        reported, checked = self.residual_reported, self.residual_checked
        return f"reported a residual of {reported:.3g}, but it is {checked:.3g}"

    @property
    def frames_to_balance(self) -> int | None:
        """Frames of the hold until the residual stays small; None where it never does."""
        return frames_until(self.held, SMALL)

    def say(self, actions: tuple[str, ...]) -> None:
        """Add the actions that a solver reported of a frame."""
        if actions and actions not in self.actions:
            self.actions.append(actions)


def try_case(method: str, case: StabilityCase) -> Trial:
    """Make the solver and run the case; a refusal in one sentence is a result, too."""
    trial = Trial()
    unheld = False
    try:
        model = model_of(case)
        unheld = TISSUE_METHODS[method].is_quasi_static and not _held(model).all()
        solver = create_solver(method, model, **_settings(method, case, model))
    except UsSimError as error:
        trial.refusal = str(error)
        too_many_steps = case.stabilisation == "substeps" and TISSUE_METHODS[method].is_explicit
        if not (unheld or too_many_steps):
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
    """Move the probe as the case says, release, and note the solver's results."""
    model = solver.model
    poses = poses_of(case.motion, model.mesh, case.depth)
    bound = _bound(model, poses)
    moving = len(poses)
    poses = [*poses, *poses[-1:] * case.held]
    thickness = float(np.ptp(model.mesh.nodes[:, 2]))
    released = None if case.release == "removed" else LIFTED
    quasi_static = TISSUE_METHODS[solver.name].is_quasi_static
    frames = 40 if quasi_static else 150  # after the release
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
        trial.say(deformation.actions)
        if not _finite(deformation):
            trial.finite = False
            return
        if case.held and moving <= number + 1 <= len(poses):
            trial.held.append(float(deformation.residual))
            volumes = signed_volumes(deformation.nodes, model.mesh.tetrahedra)
            trial.held_inverted = int((volumes <= 0).sum())
        failed = Intervention.FRAME_FAILED in deformation.interventions
        if failed:
            trial.kept += 1
            residual.forget()
            if Intervention.KEPT_STATE in deformation.interventions and last is not None:
                same = np.array_equal(deformation.nodes, last.nodes)
                if not same or deformation.residual != last.residual:
                    trial.failure = "said that it kept the last good state, and returned another"
        free = number - len(poses)
        moved = np.abs(deformation.nodes - model.mesh.nodes).max()
        trial.bounded = trial.bounded and bool(moved <= bound)
        compared = free < 5 or free % 8 == 0 or free == frames - 1
        if not failed:
            checked = residual.check(deformation, pose)  # every frame: loads refer to those before
            if compared:
                _compare(trial, deformation.residual, *checked, residual.is_least, free < 0)
        if free >= 0:
            away = _from_rest(model, deformation.nodes)
            trial.recovered_mm = 1e3 * away
            if away > 1e-4 * thickness:
                trial.recovery_frames = None
            elif trial.recovery_frames is None:
                trial.recovery_frames = free + 1
            if deformation is last:
                break  # settled
        last = deformation
        stuck = stuck + 1 if failed else 0
    if stuck >= frames and _held(model).all():
        trial.failure = "went on failing after the release, in every frame"
    if trial.held and TISSUE_METHODS[solver.name].is_judged_at_rest and not trial.failure:
        trial.failure = _unbalanced(trial, case)


def _unbalanced(trial: Trial, case: StabilityCase) -> str:
    """Fault under the held probe; empty where the tissue is in balance and not inverted."""
    if trial.frames_to_balance is None:
        return f"held for {case.held} frames it was left with a residual of {trial.held[-1]:.3g}"
    if trial.held_inverted:
        return f"held for {case.held} frames it left {trial.held_inverted} tetrahedra inside out"
    return ""


def agrees(reported: float, checked: float, rounding: float, least: bool = False) -> bool:
    """Whether a reported residual is true: within a factor of two, or both negligible.

    Negligible is below 1e-5, or below the ``rounding`` of nodes to doubles. Where the checked one
    is only the ``least`` that it can be, the reported one may be greater.
    """
    floor = max(1e-5, rounding)
    if not (math.isfinite(reported) and math.isfinite(checked)):
        return False
    low, high = sorted((reported, checked))
    return high <= floor or high <= 2.0 * low or (least and checked <= reported)


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
    """Independent residuals of a method on a case."""
    return TISSUE_METHODS[method].residual(model, spring_settings(case))


def spring_settings(case: StabilityCase) -> MsdsSettings:
    """Settings of methods with springs for a case's ``springs``."""
    stiffness = "algorithm_1" if case.springs == "algorithm_1" else "fitted"
    return MsdsSettings(stiffness, volume=case.springs == "fitted with volume")


def _settings(method: str, case: StabilityCase, model: TissueModel) -> dict[str, Any]:
    known = rules_of(SOLVERS.settings(method))
    asked: dict[str, Any] = {
        "time_step": case.time_step,
        "damping_factor": damping_factor(case, model),
        "stabilisation": case.stabilisation,
        **asdict(spring_settings(case)),
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
    pressing = (pose for pose in poses if pose is not None and pose is not LIFTED)
    reach = max(float(np.linalg.norm(pose.position)) for pose in pressing)
    size = np.ptp(nodes, axis=0)
    bound = 3 * (float(np.linalg.norm(size)) + reach + 2 * float(box[2] + box[3]) + 0.1)
    return bound if _held(model).all() else max(bound, 10 * float(size.max()))


def _compare(
    trial: Trial, reported: float, checked: float, rounding: float, least: bool, pressed: bool
) -> None:
    if not trial.truthful:
        return
    trial.truthful = agrees(reported, checked, rounding, least)
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


def observed_step_limit(method: str, case: StabilityCase) -> tuple[float, float]:
    """Step limit, s, that a solver predicts for a case without a probe, and the observed one.

    Small random displacements are released with unscaled masses, for some thousand steps, whose
    length is bisected by whether they grow. Both limits are infinite where every node is fixed, or
    the limit is none that can be set.

    Raises:
        UsSimError: the case is refused.
    """
    model = model_of(case)
    nodes = model.mesh.nodes
    settings: dict[str, Any] = asdict(spring_settings(case))
    settings |= {"damping_factor": damping_factor(case, model), "stabilisation": "none"}
    shape = np.random.default_rng(1).uniform(-1.0, 1.0, nodes.shape)
    shape[model.fixed] = 0.0
    edges = nodes[model.mesh.edges]
    # So small that springs do not turn.
    shape *= 1e-8 * np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1).min()
    start = TissueState(shape, np.zeros_like(nodes))

    def grows(step: float) -> bool:
        going_on = {"steps": 3000, "rest_tolerance": 0.0, **settings}
        solver = create_solver(method, model, time_step=step, **going_on)
        solver.take_over(start)
        with np.errstate(over="ignore", invalid="ignore"):
            ended = solver.deform(None)
        moved = np.abs(ended.nodes - nodes).max()
        # Just below the limit amplitudes swell by 20 times and stay so.
        failed = Intervention.FRAME_FAILED in ended.interventions
        return bool(failed or moved > 1e3 * np.abs(shape).max())

    if model.fixed.all():
        return math.inf, math.inf
    solver: Any = create_solver(method, model, time_step=1e-9, **settings)
    predicted = float(solver.step_limit)
    can_be_set = rules_of(SOLVERS.settings(method))["time_step"].quantity or Quantity("time")
    low, high = 0.98 * predicted, 1.02 * predicted
    if not can_be_set.minimum < low < high < can_be_set.maximum:
        return math.inf, math.inf
    while low > 2 * can_be_set.minimum and grows(low):
        low /= 2
    while high < can_be_set.maximum / 2 and not grows(high):
        high *= 2
    while high > (1 + 2e-3) * low:
        middle = (low * high) ** 0.5
        low, high = (low, middle) if grows(middle) else (middle, high)
    return predicted, (low * high) ** 0.5
