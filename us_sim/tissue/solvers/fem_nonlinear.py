"""Large deformation of nearly incompressible tissue, in real time.

Quasi-static: every frame the energy of tissue and contact is made least, by Newton's method
(`us_sim.tissue.solvers.newton`), from where the frame before ended. A new pose of the probe is met
with the exact linear answer to it first (contact is a complementarity problem on the surface
compliance). What a frame's time does not allow for (`us_sim.tissue.solvers.frame_budget`) goes on
in the next; under a probe at rest, until the forces balance. A tissue that is inside out is worked
on but never shown.

>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.model import TissueModel
>>> solver = FemNonlinear(TissueModel.make_block())
>>> for _ in range(20):
...     deformation = solver.deform(Pose(position=[0.0, 0.0, 0.02]))
>>> deformation.residual <= 1e-5, deformation.action
(True, '')
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from us_sim import Progress
from us_sim.geometry.pose import Pose, is_same_pose
from us_sim.geometry.se3 import interpolate_poses
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import setting
from us_sim.tissue.contact.complementarity import predict_forces
from us_sim.tissue.contact.probe_gap import GAP_TOLERANCE, wrench_on_probe
from us_sim.tissue.contact.stiffness import compliance_between, compute_contact_stiffness
from us_sim.tissue.elasticity.linear_tetrahedra import require_held
from us_sim.tissue.elasticity.neo_hookean_material import require_solid
from us_sim.tissue.linear_algebra.compliance import compute_compliance
from us_sim.tissue.mesh.tetrahedral_mesh import signed_volumes
from us_sim.tissue.model import Deformation, Intervention, TissueModel, TissueState
from us_sim.tissue.solvers.discretisation_error import estimate_relative_error
from us_sim.tissue.solvers.frame_budget import FrameBudget
from us_sim.tissue.solvers.newton import Newton
from us_sim.tissue.solvers.solver import COUNT, TOLERANCE, SolverSettings, TissueSolver
from us_sim.tissue.solvers.tuning import TUNING


@dataclass(frozen=True)
class FemNonlinearSettings(SolverSettings):
    """The settings of the solver ``fem_nonlinear``."""

    section = "fem_nonlinear"

    frame_tolerance: float = setting(
        TOLERANCE,
        "residual (unbalanced over contact forces) and relative error of the displacement "
        "(estimated) at which a frame with a moving probe ends",
        default=0.003,
    )
    frame_budget: float | None = setting(
        Quantity("time", 0.0005, 10.0),
        "time after which a frame ends, and the next goes on from there. Not given (0 as a "
        "parameter): live, the time that the rate leaves, and up to a quarter more until residual "
        "and error are at most 0.01; in lockstep none, so all machines give the same",
        default=None,
    )
    most_iterations: int = setting(
        COUNT,
        "conjugate-gradient iterations of a frame at most, each step of Newton's method counting "
        "as eight more; twice as many while the probe rests",
        default=440,
    )
    tolerance: float = setting(
        TOLERANCE, "residual at which the tissue under an unmoved probe has settled", default=1e-5
    )


class FemNonlinear(TissueSolver):
    """Stable neo-Hookean finite elements under a probe, by Newton's method.

    The residual is the norm of the unbalanced nodal forces, of tissue and contact together, over
    the norm of the contact forces and the tissue's own load (without any, over the largest since
    rest, and before there are any, over the first unbalanced), in double precision and of the
    displacement that is returned.

    Args:
        model: at least three fixed nodes that are not on one line in every connected part.
        settings: see `FemNonlinearSettings`.

    Raises:
        SolverError: a setting is out of range, or the tissue is not held.
    """

    name: ClassVar[str] = "fem_nonlinear"
    in_short: ClassVar[str] = (
        "large deformation of nearly incompressible tissue, slowest: for deep presses"
    )
    must_be_held: ClassVar[bool] = True
    bears_load: ClassVar[bool] = True
    # Of the residual and of the estimated error. Of 102 generated presses of 2,000 nodes by four
    # probes, the first Newton step that came so far was within 7 % of the balance that followed in
    # 72 and within 35 % in 98: neither number knows of tissue that is about to snap.
    most_unbalanced: ClassVar[float] = 0.1

    Settings = FemNonlinearSettings
    settings: FemNonlinearSettings

    def __init__(
        self,
        model: TissueModel,
        settings: FemNonlinearSettings | None = None,
        progress: Progress | None = None,
    ) -> None:
        require_held(model.mesh, model.fixed)
        require_solid(model.mesh, model.materials)
        settings = settings or FemNonlinearSettings()
        self._newton = Newton(model)
        super().__init__(model, settings, progress)
        self._surface = model.movable_contact_nodes
        smallest = float(np.ptp(model.mesh.nodes, axis=0).min())
        spacing = model.contact_spacing or smallest
        self._settled_motion = TUNING.settled_motion * settings.tolerance * spacing  # m
        self._reported_depth = TUNING.reported_depth * spacing  # m
        self._predicted_gap = TUNING.predicted_gap * smallest  # m
        self._budget = FrameBudget()
        self._recovery = InversionRecovery(self._newton.displacement)
        if len(self._surface):
            self._compliance = compute_compliance(model, progress, needs_imbalance=False)
        self._restore(self.state)

    @property
    def state(self) -> TissueState:
        """Displacement of the tissue; a quasi-static solver has no velocity."""
        displacement = self._recovery.upright.T.copy()
        return TissueState(displacement, np.zeros_like(displacement))

    @property
    def _sag(self) -> NDArray[np.float64]:
        return self._newton.rest.T

    def compute_contact_stiffness(self) -> NDArray[np.float64] | None:
        """Approximate the stiffness by tissue as at rest, and forces that do not turn."""
        newton, contact = self._newton, self._newton.contact
        law = contact.slope, contact.gap, contact.normal
        gap, normal, softness = newton.points.merge_springs(*law)
        pushed = np.flatnonzero(np.isfinite(gap[self._surface]))
        if self._pose is None or len(pushed) == 0:
            return np.zeros((6, 6))
        nodes = self._surface[pushed]
        # The springs of the contact and the tissue give way one after the other.
        compliance = compliance_between(self._compliance.matrix, pushed)
        across = normal[nodes, :, None] * normal[nodes, None, :]
        compliance += block_diag(*(softness[nodes, None, None] * across))
        return compute_contact_stiffness(
            self.model.collider,
            self._pose,
            self.model.mesh.nodes[nodes] + newton.displacement.T[nodes],
            newton.contact_forces[:, nodes].T,
            compliance,
            self.model.contact_spacing,
            (normal[nodes], np.zeros((len(nodes), 3, 3))),
        )

    def estimate_discretisation_error(self) -> float | None:
        """Estimate by `us_sim.tissue.solvers.discretisation_error`; None for unbalanced frames."""
        last, rest = self._last, self.model.mesh.nodes
        known = last.is_balanced and not last.interventions and len(self._surface)
        if not known or np.array_equal(last.nodes, rest):
            return None
        return estimate_relative_error(
            self.model,
            self._compliance,
            self._pose,
            last.nodes - rest,
            self._newton.contact_forces.T,
            self._predicted_gap,
        )

    def _restore(self, state: TissueState) -> None:
        self._newton.reset()
        self._budget.reset()
        self._greatest_norm = 0.0  # N, of contact forces since rest; before, of the residual
        self._target: Pose | None = None  # the pose that the tissue is at or on its way to
        self._was_balanced = False  # at the end of the last frame
        self._catches_up = False  # with the probe, where a live frame began anew from rest
        if state.displacement.any():
            displacement = np.ascontiguousarray(state.displacement.T)
            # The way out of tissue inside out may end in a minimum where it is folded over.
            if self._newton.tissue.smallest_volume_ratio(displacement) > 0.0:
                self._newton.set_displacement(displacement)
        self._recovery.reset(self._newton.displacement)

    def _compile_rare_kernels(self) -> None:
        self._newton.compile_kernels()

    def _advance(self, pose: Pose | None) -> Deformation:
        newton, budget, settings = self._newton, self._budget, self.settings
        asked, moved = pose, not is_same_pose(pose, self._target)
        budget.begin_frame(
            settings.most_iterations,
            settings.frame_budget,
            self.frame_limit,
            moved=moved,
            restarted=self._recovery.take_restart(),
        )
        if pose is None or newton.measure_depth_at_rest(pose) <= GAP_TOLERANCE:
            # Nothing reaches the tissue at rest: it is the solution.
            self._restore(TissueState.at_rest(len(self.model.mesh.nodes)))
            self._settled = True
            return self._resting()
        motion, start = np.inf, None  # m, that updating the contact causes; guess of the first step
        if not moved:
            motion = newton.update_contact() if self._was_balanced else np.inf
        elif len(self._surface):
            if self._catches_up:
                pose = self._next_step(pose)
            else:
                self._approach(pose)
            if pose is not self._target:
                start = self._predict(pose)
        # Factoring takes many frames' time, and what is in balance looks the same without it.
        is_shown = self._was_balanced and budget.time_limit is not None
        newton.may_factor = newton.is_small or not (moved or budget.is_hurried or is_shown)
        is_behind = pose is not asked
        actions = ["it follows the probe in steps"] if is_behind else []
        tolerance = settings.frame_tolerance if moved else settings.tolerance
        self._settled = self._solve(tolerance, start, actions)
        self._was_balanced = not self._exceeds(settings.frame_tolerance)
        self._catches_up &= is_behind or not self._was_balanced
        outcome = self._make_deformation(pose, motion, actions)
        if is_behind:
            self._settled = False
            return replace(outcome, is_balanced=False)
        return outcome

    def _solve(
        self, tolerance: float, start: NDArray[np.float64] | None, actions: list[str]
    ) -> bool:
        """Take Newton steps to a residual, or as far as the budget allows.

        Args:
            tolerance: the residual.
            start: (3, N) m, a guess of the first step.
            actions: to which problems are added.

        Returns:
            Whether no step leads any further.
        """
        newton, budget = self._newton, self._budget
        while self._exceeds(tolerance) and budget.iterations_left > 0:
            goal = tolerance * newton.applied_norm if start is None else 0.0
            if newton.residual_norm <= goal:  # what is left is the error of the displacement
                goal = 0.0
            budget.begin_step()
            limit = min(budget.iterations_left, budget.step_iterations, newton.iteration_limit)
            taken = newton.step(limit, goal, start)
            budget.end_step(newton.iterations)
            start = None
            stagnated = not taken and newton.has_stagnated
            is_over = budget.is_over(balanced=not self._exceeds(TUNING.overtime_tolerance))
            if is_over and budget.is_shorter_than_a_step:
                actions.append(
                    f"frame_budget is {1e3 * (budget.time_limit or 0.0):.3g} ms, but one step "
                    f"takes {1e3 * budget.step_time:.2g} ms: give it more"
                )
            if stagnated:
                actions.append(f"no step lowers the energy any further: {self._obstacle()}")
            if is_over or stagnated:
                return stagnated
        return False

    @property
    def _reference(self) -> float:
        """N, norm by which that of the residual is divided."""
        return self._newton.applied_norm or self._greatest_norm

    def _exceeds(self, tolerance: float) -> bool:
        """Return whether the residual, or in contact the estimated error, is above a tolerance."""
        newton = self._newton
        if newton.residual_norm > tolerance * self._reference:
            return True
        return newton.contact_norm > 0.0 and newton.displacement_error > tolerance

    def _next_step(self, pose: Pose) -> Pose:
        """Return the next load step on the way to a pose; the last one until that is in balance."""
        newton, last = self._newton, self._target
        if last is not None and newton.residual_norm > TUNING.load_step_tolerance * self._reference:
            return last
        return (*self._load_steps(pose), pose)[0]

    def _load_steps(self, pose: Pose) -> list[Pose]:
        newton, box = self._newton, self.model.collider.offset_box
        last = self._target if newton.contact_norm > 0.0 else None
        return plan_load_steps(last, pose, newton.measure_depth(pose), math.hypot(box[0], box[1]))

    def _approach(self, pose: Pose) -> None:
        """Go most of a long way in load steps, as far as the budget allows."""
        newton, budget = self._newton, self._budget
        for nearer in self._load_steps(pose):
            if not budget.allows_load_step:
                break
            start: NDArray[np.float64] | None = self._predict(nearer)
            for _ in range(TUNING.load_step_newton_steps):
                budget.begin_step()
                newton.step(min(budget.step_iterations, newton.iteration_limit), 0.0, start)
                budget.end_step(newton.iterations)
                start = None
                done = newton.residual_norm <= TUNING.load_step_tolerance * newton.contact_norm
                if done or budget.is_late:
                    break

    def _predict(self, pose: Pose) -> NDArray[np.float64]:
        """Set a new pose and return the linear answer to it, (3, N) m."""
        newton, contact, points = self._newton, self._newton.contact, self._newton.points
        held = newton.contact_forces[:, self._surface].T.copy()
        newton.set_pose(pose)
        self._target = pose
        # As if each node had the springs of its points to itself.
        firm = np.where(contact.gap < 0.0, contact.stiffness, 0.0)
        gap, normal, softness = points.merge_springs(firm, contact.gap, contact.normal)
        change = predict_forces(
            self._compliance.matrix,
            gap[self._surface],
            normal[self._surface],
            held,
            softness[self._surface],
            self._predicted_gap,
        )
        field = np.zeros(newton.displacement.shape, np.float32)
        self._compliance.add_displacement(change, field)
        return field.astype(np.float64)

    def _obstacle(self) -> str:
        """Describe the node and the tetrahedron at which a tissue cannot be balanced."""
        newton = self._newton
        pulled = int(np.argmax(np.linalg.norm(newton.residual, axis=0)))
        nodes = self.model.mesh.nodes + newton.displacement.T
        ratios = signed_volumes(nodes, self.model.mesh.tetrahedra) / self.model.mesh.volumes
        least = int(np.argmin(ratios))
        return (
            f"node {pulled} is the least balanced, and tetrahedron {least} has {ratios[least]:.2g} "
            "of its volume"
        )

    def _make_deformation(self, pose: Pose, motion: float, actions: list[str]) -> Deformation:
        newton, recovery = self._newton, self._recovery
        interventions = Intervention.NONE
        reached = newton.displacement
        recovery.record_frame(reached, newton.tissue.smallest_volume_ratio(reached) > 0.0)
        if recovery.inverted_frames:
            actions.append("still inside out, so the last upright state is shown")
            interventions |= Intervention.SHOWED_UPRIGHT
            newton.set_displacement(recovery.upright)
        self._greatest_norm = max(self._greatest_norm, newton.applied_norm) or newton.residual_norm
        reference = self._reference
        residual = newton.residual_norm / reference if reference else 0.0
        depth = -float(newton.contact.gap.min(initial=np.inf))
        if depth > self._reported_depth:
            actions.append(f"the probe is {1e3 * depth:.2g} mm inside the tissue")
        nodes = self.model.mesh.nodes + newton.displacement.T
        forces = newton.contact_forces[:, self.model.contact_nodes].T
        pushed = forces.any(axis=1)
        touched, forces = self.model.contact_nodes[pushed], forces[pushed]
        force, torque = wrench_on_probe(pose, nodes[touched], forces)
        if not recovery.inverted_frames:
            balanced = residual <= self.settings.tolerance and motion <= self._settled_motion
            self._settled |= balanced
        elif recovery.must_restart(hurried=self._budget.is_hurried and not self._catches_up):
            actions.append("begun anew from rest")
            interventions |= Intervention.RESTARTED
            self._restore(TissueState.at_rest(len(nodes)))
            recovery.restarts, self._catches_up = True, self._budget.time_limit is not None
        else:
            newton.set_displacement(reached)
        return Deformation(
            nodes,
            touched,
            force,
            torque,
            residual,
            tuple(actions),
            interventions=interventions,
            is_balanced=not newton.contact_norm
            or newton.displacement_error <= self.most_unbalanced,
        )


class InversionRecovery:
    """Keeps the last state of the tissue that was not inside out, and says when to begin anew.

    Args:
        displacement: (3, N) m, upright.
    """

    def __init__(self, displacement: NDArray[np.float64]) -> None:
        self.reset(displacement)

    def reset(self, displacement: NDArray[np.float64]) -> None:
        """Go on from an upright displacement (3, N) m."""
        self.upright = displacement  # (3, N) m
        self.inverted_frames = 0  # in a row
        self.restarts = False  # whether the next frame begins anew from rest

    def record_frame(self, displacement: NDArray[np.float64], is_upright: bool) -> None:
        """Record the displacement (3, N) m at the end of a frame."""
        if is_upright:
            self.upright, self.inverted_frames = displacement, 0
        else:
            self.inverted_frames += 1

    def must_restart(self, *, hurried: bool) -> bool:
        """Return whether tissue that is inside out has had its time to come out."""
        return self.inverted_frames > (0 if hurried else TUNING.inverted_frames)

    def take_restart(self) -> bool:
        """Return whether this frame begins anew from rest; the next does not."""
        restarts, self.restarts = self.restarts, False
        return restarts


def plan_load_steps(last: Pose | None, pose: Pose, depth: float, arm: float) -> list[Pose]:
    """Plan poses on a probe's way, so that tissue is swept aside and not left where it was hit.

    >>> steps = plan_load_steps(Pose(), Pose([0.0, 0.0, 0.008]), depth=0.008, arm=0.02)
    >>> [f"{pose.position[2]:.4f}" for pose in steps]
    ['0.0027', '0.0053']
    >>> leap = plan_load_steps(None, Pose([0, 0, 0.03]), depth=0.006, arm=0.02)
    >>> [f"{pose.position[2]:.4f}" for pose in leap]
    ['0.0270']

    Args:
        last: where the probe was, if it touched the tissue.
        pose: where it is now.
        depth: m, of that in the tissue as it is.
        arm: m, from the probe's origin to the outermost of it, which turns move farthest.
    """
    length, most = TUNING.load_step, TUNING.most_load_steps
    if last is not None:
        turned = 2 * math.acos(min(1.0, abs(float(last.orientation @ pose.orientation))))
        way = math.dist(last.position, pose.position) + arm * turned
        count = math.ceil(way / length)
        if count <= most:
            return [interpolate_poses(last, pose, k / count) for k in range(1, count)]
    count = min(math.ceil(depth / length), most)
    backs = [(1 - k / count) * depth for k in range(1, count)]
    return [Pose(pose.position - x * pose.rotation[:, 2], pose.orientation) for x in backs]
