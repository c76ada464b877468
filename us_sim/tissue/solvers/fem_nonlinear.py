"""Large deformation of nearly incompressible tissue, in real time.

Quasi-static: every frame the elastic energy of `neo_hookean` is made least among the displacements
that keep out of the probe. A frame predicts the displacement by the exact linear answer to the
probe's motion (contact is a complementarity problem on the surface compliance) and by the last
frame's correction to such an answer; then Newton steps of a few conjugate-gradient iterations, held
on the probe's surface, correct it. Motion too large for one prediction is cut into sub-steps, which
may go on in later frames; no step is taken that turns a tetrahedron inside out, or that lowers
neither the unbalanced forces nor the energy.

>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.solvers.fem_nonlinear import FemNonlinear
>>> from us_sim.tissue.model import TissueModel
>>> model = TissueModel.block()
>>> solver = FemNonlinear(model)
>>> for _ in range(20):
...     deformation = solver.deform(Pose(position=[0.0, 0.0, 0.02]))
>>> deformation.residual <= 1e-5, deformation.action
(True, '')
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.settings.setting import setting
from us_sim.tissue.contact.carried_correction import CarriedCorrection
from us_sim.tissue.contact.penetration import GAP_TOLERANCE, push_out, wrench_on_probe
from us_sim.tissue.contact.prediction import predict_forces
from us_sim.tissue.contact.stiffness import compliance_between, contact_stiffness
from us_sim.tissue.deformation import Deformation, TissueState
from us_sim.tissue.elasticity.linear_tetrahedra import require_held
from us_sim.tissue.linear_algebra.compliance import surface_compliance
from us_sim.tissue.model import TissueModel
from us_sim.tissue.solvers.newton import Newton
from us_sim.tissue.solvers.solver import (
    COUNT,
    TOLERANCE,
    SolverSettings,
    TissueSolver,
    same_pose,
)
from us_sim.tissue.solvers.sub_steps import between, motion

__all__ = ["FemNonlinear", "FemNonlinearSettings"]

_STRIDE = 0.05
"""Longest motion of one prediction, over the tissue's smallest extent: 5 mm for 0.1 m."""

_PREDICTION = 3
"""Conjugate-gradient iterations that take as long as one prediction."""

_BUDGET, _LEAST_BUDGET = 30, 12
"""Conjugate-gradient iterations that fit a frame of 33 ms at 10,000 nodes, and the least of any
frame."""

_NEWTON = 6
"""Iterations of one Newton step: solved further, a step after a large change overshoots."""

_PASSING, _PASSABLE = 4, 0.1
"""Iterations of a sub-step that is not the last, and the residual at which the next may begin."""

_HALVINGS = 4
"""Times that a sub-step is halved, in later frames too, before it is tried in full again."""

_FRACTIONS = (0.5, 0.0)
"""Fractions of the prediction to try when all of it would invert tetrahedra."""

_NEAR = 1e-4
"""A node this near the probe counts as pushed when another solver's state is taken over, m."""


@dataclass(frozen=True)
class _Effort:
    least: int  # iterations
    most: int  # iterations, until the goal is reached
    goal: float  # residual
    newton: int = _NEWTON  # iterations of one Newton step


@dataclass(frozen=True)
class FemNonlinearSettings(SolverSettings):
    """The settings of the solver ``fem_nonlinear``."""

    section = "fem_nonlinear"

    iterations: int = setting(
        COUNT, "conjugate-gradient iterations in an ordinary frame", default=6
    )
    frame_tolerance: float = setting(
        TOLERANCE, "residual down to which a frame goes on after those", default=0.03
    )
    most_iterations: int | None = setting(
        COUNT,
        "iterations in any frame at most; what is then left to do waits for the next; not given: "
        "30, fewer on meshes of more than 10,000 nodes",
        default=None,
    )
    tolerance: float = setting(
        TOLERANCE, "residual at which the tissue under an unmoved probe has settled", default=1e-5
    )


class FemNonlinear(TissueSolver):
    """Stable neo-Hookean finite elements with frictionless contact, by Newton's method.

    The residual is the norm of the unbalanced nodal forces (those on free nodes, those along the
    probe's surface on touched nodes, and any with which the probe would have to pull) over the norm
    of the contact forces (without any, over the largest since rest), in double precision and of
    the displacement that is returned.

    Args:
        model: at least three fixed nodes that are not on one line in every connected part.
        settings: see `FemNonlinearSettings`.

    Raises:
        SolverError: a setting is out of range, or the tissue is not held.
    """

    name: ClassVar[str] = "fem_nonlinear"
    farthest: ClassVar[float] = 3.0  # fixed nodes hold it

    Settings = FemNonlinearSettings

    def __init__(
        self,
        model: TissueModel,
        settings: FemNonlinearSettings | None = None,
        progress: Callable[[float, str], None] | None = None,
    ) -> None:
        require_held(model.mesh, model.fixed)
        settings = settings or FemNonlinearSettings()
        super().__init__(model, settings, progress)
        self._iterations = settings.iterations
        most = settings.most_iterations
        if most is None:
            most = max(_LEAST_BUDGET, round(_BUDGET / max(1.0, len(model.mesh.nodes) / 1e4)))
        self._most_iterations = max(most, settings.iterations)
        self._frame_tolerance = settings.frame_tolerance
        self._tolerance = settings.tolerance
        self._surface = model.movable_contact_nodes
        box = model.collider.offset_box
        self._lever = float(np.linalg.norm(box[:3]) + box[3])
        self._stride = _STRIDE * float(np.ptp(model.mesh.nodes, axis=0).min())
        self._newton = Newton(model)
        self._correction = CarriedCorrection(model.mesh)
        if len(self._surface):
            self._compliance = surface_compliance(model, progress)
        self._field = np.zeros((3, len(model.mesh.nodes)), np.float32)
        self._restore(self.state)

    @property
    def state(self) -> TissueState:
        """Where the tissue is; a quasi-static solver has no velocity."""
        displacement = self._newton.displacement.T.copy()
        return TissueState(displacement, np.zeros_like(displacement))

    def contact_stiffness(self) -> NDArray[np.float64] | None:
        """Approximate: computed with the tissue's compliance at rest."""
        contact = self._newton.contact
        pushed = np.flatnonzero(contact.push > 0.0)
        if self._pose is None or len(pushed) == 0:
            return np.zeros((6, 6))
        return contact_stiffness(
            self.model.collider,
            self._pose,
            self._newton.surface[pushed],
            contact.push[pushed, None] * contact.normal[pushed],
            compliance_between(self._compliance.matrix, pushed),
            self.model.contact_spacing,
        )

    def _restore(self, state: TissueState) -> None:
        self._newton.rest()
        self._forget()
        self._heaviest = 0.0  # N, norm of the contact forces, the largest since rest
        if state.displacement.any():
            self._newton.displacement = np.ascontiguousarray(state.displacement.T)
            self._taken_over = True

    def _forget(self) -> None:
        self._followed: Pose | None = None  # the pose that the tissue is at
        self._retreat = 0.0  # m, penetration of the probe there that the tissue has still to follow
        self._taken_over = False
        self._halvings = 0  # of the next step, since longer ones inverted tetrahedra
        self._correction.forget()

    def _advance(self, pose: Pose | None) -> Deformation:
        newton = self._newton
        depth = self._depth(pose, self.model.mesh.nodes[self._surface])
        if pose is None or depth <= GAP_TOLERANCE:
            # Nothing reaches the undeformed tissue: it is the solution.
            newton.rest()
            self._forget()
            self._heaviest = 0.0
            self._settled = True
            return self._resting()
        actions = []
        if self._taken_over:
            self._adopt(pose)
        anew = math.ceil(depth / self._stride)
        if self._followed is None or anew < self._steps_to(pose):
            if self._followed is not None:
                actions.append("began anew from rest")
            newton.rest()
            self._forget()
            self._followed, self._retreat = pose, depth
        imbalance, load = newton.imbalance, newton.load
        taken = self._follow(pose)
        if taken > 1:
            actions.append(f"sub-stepped {taken} times")
        if taken == 0:
            effort = _Effort(self._iterations, self._most_iterations, self._frame_tolerance)
            if newton.imbalance <= self._frame_tolerance * newton.load:
                # So near the solution a long step does not overshoot.
                half = max(self._most_iterations // 2, 1)
                effort = _Effort(half, half, 1.0, half)
            newton.settle_on(self._followed, self._retreat)
            self._improve(self._followed, self._retreat, effort)
        progress = taken > 0 or newton.imbalance != imbalance or newton.load != load
        progress |= 0 < self._halvings <= _HALVINGS
        return self._outcome(pose, progress, actions)

    def _depth(self, pose: Pose | None, points: NDArray[np.float64]) -> float:
        """How deep (m) the probe is in points (C, 3), at least 0."""
        if pose is None or len(points) == 0:
            return 0.0
        gap, _ = push_out(self.model.collider, pose, points, self.model.contact_spacing)
        return max(0.0, -float(gap.min()))

    def _adopt(self, pose: Pose) -> None:
        """Go on from another solver's displacement, or from rest where that is of no use."""
        newton = self._newton
        self._taken_over = False
        if newton.tissue.smallest_volume_ratio(newton.displacement) <= 0.0:
            return
        self._followed, self._retreat = pose, self._depth(pose, newton.surface)
        newton.contact.aim(pose, self._retreat, newton.surface)
        newton.contact.touched = newton.contact.gap < _NEAR
        newton.settle_on(pose, self._retreat)

    def _steps_to(self, pose: Pose) -> int:
        """The number of steps into which the rest of the motion is cut."""
        assert self._followed is not None
        if same_pose(self._followed, pose) and self._retreat == 0.0:
            return 0
        distance = float(np.linalg.norm(motion(self._followed, pose, self._lever)))
        return max(1, math.ceil(max(distance, self._retreat) / self._stride - 1e-6))

    def _follow(self, pose: Pose) -> int:
        """Step towards the pose as far as the frame's iterations go; returns the steps taken."""
        newton, budget = self._newton, self._most_iterations
        taken = 0
        if self._halvings > _HALVINGS:
            self._halvings = 0
        ordinary = self._steps_to(pose) == 1
        if not ordinary:
            self._correction.forget()
        while (steps := self._steps_to(pose)) and budget > 0:
            assert self._followed is not None
            fraction = 0.5**self._halvings / steps
            target = between(self._followed, pose, fraction)
            retreat = self._retreat * (1 - fraction)
            good = newton.snapshot()
            effort = _Effort(_PASSING, budget - _PREDICTION, _PASSABLE)
            if fraction == 1.0:
                effort = replace(effort, least=self._iterations, goal=self._frame_tolerance)
            used = self._attempt(target, retreat, effort, ordinary)
            budget -= _PREDICTION + abs(used)
            if used < 0:
                newton.restore(good)
                self._correction.forget()
                self._halvings += 1
                if self._halvings > _HALVINGS:
                    break
            else:
                self._followed, self._retreat = target, retreat
                self._halvings = max(self._halvings - 1, 0)
                taken += 1
        return taken

    def _attempt(self, pose: Pose, retreat: float, effort: _Effort, ordinary: bool) -> int:
        """One step; returns its iterations, as a negative number when it inverted tetrahedra."""
        newton = self._newton
        assert self._followed is not None
        start, touched = newton.displacement.copy(), newton.contact.touched.copy()
        step = motion(self._followed, pose, self._lever)
        guess = self._correction.guess(step, pose.rotation[:, 2])
        if guess is not None:
            newton.displacement = start + guess
        self._predict(pose, retreat)
        newton.displacement = newton.displacement + self._field
        newton.settle_on(pose, retreat)
        if newton.tissue.inverted(newton.displacement):
            self._take_less(pose, retreat, start, touched)
        used = self._improve(pose, retreat, effort)
        inverted = newton.tissue.inverted(newton.displacement)
        if inverted and inverted > newton.tissue.inverted(start):
            return -max(used, 1)
        if ordinary:
            self._correction.learn(newton.displacement - start - self._field, step)
        return used

    def _take_less(
        self,
        pose: Pose,
        retreat: float,
        start: NDArray[np.float64],
        touched: NDArray[np.bool_],
    ) -> None:
        """Start from a fraction of a prediction that inverts tetrahedra: that of the least energy.

        Args:
            pose, retreat: of the step.
            start: (3, N) m, before the prediction.
            touched: (S,), which nodes were touched then.
        """
        newton = self._newton
        least, best = newton.tissue.energy(newton.displacement), newton.snapshot()
        change = newton.displacement - start
        for fraction in _FRACTIONS:
            newton.displacement = start + fraction * change
            newton.contact.touched = touched | (newton.contact.touched & (fraction > 0.0))
            newton.settle_on(pose, retreat)
            energy = newton.tissue.energy(newton.displacement)
            if energy < least:
                least, best = energy, newton.snapshot()
        newton.restore(best)

    def _rehearse(self) -> None:
        newton = self._newton
        newton.tissue.energy(newton.displacement)
        self._correction.learn(np.zeros(newton.displacement.shape), np.eye(6)[0])
        self._correction.guess(np.eye(6)[0], np.eye(3)[2])

    def _improve(self, pose: Pose, retreat: float, effort: _Effort) -> int:
        """Take Newton steps until the effort is spent; returns the iterations used."""
        newton, used = self._newton, 0
        while newton.imbalance > 0.0:
            left = effort.least - used
            if left <= 0 and newton.imbalance > effort.goal * newton.load:
                left = effort.most - used
            if left <= 0:
                break
            spent, better = newton.step(pose, retreat, min(left, effort.newton))
            used += max(spent, 1)
            if not better:
                break
        return used

    def _predict(self, pose: Pose, retreat: float) -> None:
        """Fill the field with the linear answer to a new pose, and set the touched nodes."""
        newton, contact = self._newton, self._newton.contact
        before = contact.touched.copy()
        contact.aim(pose, retreat, newton.surface)
        change, contact.touched = predict_forces(
            self._compliance.matrix,
            contact.gap,
            contact.normal,
            newton.force[:, self._surface].T,
            before,
            2 * self._stride,
        )
        self._field[:] = 0.0
        self._compliance.add_field(change, self._field)

    def _outcome(self, pose: Pose, progress: bool, actions: list[str]) -> Deformation:
        newton = self._newton
        behind = self._steps_to(pose) > 0
        assert self._followed is not None
        kept = newton.snapshot()
        if behind:
            newton.weigh_on(pose)
            lag = float(np.linalg.norm(motion(self._followed, pose, self._lever)))
            actions.append(f"the tissue is {1e3 * max(lag, self._retreat):.2g} mm behind")
        contact = newton.contact
        if newton.imbalance == 0.0 and newton.load == 0.0:
            self._heaviest = 0.0  # still at rest
        self._heaviest = max(self._heaviest, newton.load) or newton.imbalance
        reference = newton.load or self._heaviest
        residual = newton.imbalance / reference if reference else 0.0
        self._settled = not progress or (residual <= self._tolerance and not behind)
        if not progress and residual > self._tolerance:
            actions.append("no step led any further")
        nodes = self.model.mesh.nodes + newton.displacement.T
        pushed = contact.push > 0
        touched = self._surface[pushed]
        forces = contact.push[pushed, None] * contact.normal[pushed]
        force, torque = wrench_on_probe(pose, nodes[touched], forces)
        newton.restore(kept)
        return Deformation(nodes, touched, force, torque, residual, "; ".join(actions))
