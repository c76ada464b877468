"""Large deformation of nearly incompressible tissue, in real time.

Quasi-static: every frame the energy of `neo_hookean` and of a penalty contact is made least, by
Newton's method with a line search (see `us_sim.tissue.solvers.newton`), from where the frame before
ended. A new pose of the probe is met with the exact linear answer to it first (contact is a
complementarity problem on the surface compliance). What a frame's time does not allow for goes on
in the next; under a probe at rest, until the forces balance. A tissue that is inside out is worked
on but never shown.

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

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import setting
from us_sim.tissue.contact.penetration import GAP_TOLERANCE, push_out, wrench_on_probe
from us_sim.tissue.contact.prediction import predict_forces
from us_sim.tissue.contact.stiffness import compliance_between, contact_stiffness
from us_sim.tissue.deformation import Deformation, TissueState
from us_sim.tissue.elasticity.linear_tetrahedra import require_held
from us_sim.tissue.linear_algebra.compliance import surface_compliance
from us_sim.tissue.mesh.check import signed_volumes
from us_sim.tissue.model import TissueModel
from us_sim.tissue.solvers.newton import Newton
from us_sim.tissue.solvers.solver import (
    COUNT,
    TOLERANCE,
    SolverSettings,
    TissueSolver,
    same_pose,
)

__all__ = ["FemNonlinear", "FemNonlinearSettings"]

_TOUCHING = 0.1
"""Gap up to which a node may come to touch in one frame, over the tissue's smallest extent."""

_SMALL = 500
"""Free nodes up to which there is time to factor the stiffness while the probe moves."""

_RESTING = 30
"""Frames of a probe at rest after which one may take longer than it should, if that is needed."""

_SUNK = 10.0
"""Depth to which the probe may sink into settled tissue, over the spacing of the nodes that it can
touch, for a tolerance of 1."""

_SINKS = 3e-4
"""Depth of the probe in the tissue, m, that is worth saying."""

_PATIENCE = 10
"""Frames in a row that may end inside out before the tissue is begun anew from rest."""


@dataclass(frozen=True)
class FemNonlinearSettings(SolverSettings):
    """The settings of the solver ``fem_nonlinear``."""

    section = "fem_nonlinear"

    frame_tolerance: float = setting(
        TOLERANCE, "residual at which a frame with a moving probe ends", default=0.01
    )
    frame_budget: float | None = setting(
        Quantity("time", 0.0005, 10.0),
        "time after which a frame ends with what it has, and the next goes on; not given: what a "
        "live simulation leaves, and in lockstep any, lest results depend on the machine",
        default=None,
    )
    most_iterations: int = setting(
        COUNT, "conjugate-gradient iterations of any frame at most", default=250
    )
    tolerance: float = setting(
        TOLERANCE, "residual at which the tissue under an unmoved probe has settled", default=1e-5
    )


class FemNonlinear(TissueSolver):
    """Stable neo-Hookean finite elements with frictionless contact, by Newton's method.

    The residual is the norm of the unbalanced nodal forces, of tissue and contact together, over
    the norm of the contact forces (without any, over the largest since rest), in double precision
    and of the displacement that is returned.

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
        self._own = settings
        self._surface = model.movable_contact_nodes
        smallest = float(np.ptp(model.mesh.nodes, axis=0).min())
        self._sunk = _SUNK * settings.tolerance * (model.contact_spacing or smallest)
        self._touching = _TOUCHING * smallest
        self._newton = Newton(model)
        self._upright = self._newton.displacement  # (3, N) m, the last that was
        self._small = int((~model.fixed).sum()) <= _SMALL
        if len(self._surface):
            self._compliance = surface_compliance(model, progress)
        self._restore(self.state)

    @property
    def state(self) -> TissueState:
        """Where the tissue is; a quasi-static solver has no velocity."""
        displacement = self._upright.T.copy()
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
            flanks=True,
        )

    def _restore(self, state: TissueState) -> None:
        self._newton.rest()
        self._heaviest = 0.0  # N, norm of the contact forces, the largest since rest
        self._aimed: Pose | None = None  # the pose that the tissue is at or on its way to
        self._still = 0  # frames in a row with the probe at rest
        self._balanced = False  # whether the last frame's forces were
        self._inverted = 0  # frames in a row that ended inside out
        if state.displacement.any():
            displacement = np.ascontiguousarray(state.displacement.T)
            # The way out of tissue inside out may end in a minimum where it is folded over.
            if self._newton.tissue.smallest_volume_ratio(displacement) > 0.0:
                self._newton.put(displacement)
        self._upright = self._newton.displacement

    def _rehearse(self) -> None:
        self._newton.rehearse()

    def _advance(self, pose: Pose | None) -> Deformation:
        began = time.perf_counter()
        newton, settings = self._newton, self._own
        if pose is None or self._depth(pose, self.model.mesh.nodes[self._surface]) <= GAP_TOLERANCE:
            # Nothing reaches the undeformed tissue: it is the solution.
            self._restore(TissueState.at_rest(len(self.model.mesh.nodes)))
            self._settled = True
            return self._resting()
        budget = settings.frame_budget or self.frame_limit
        moved = not same_pose(pose, self._aimed)
        goal = settings.frame_tolerance if moved else settings.tolerance
        # Where they did not balance, pushes are still those of being hit.
        shifted = np.inf
        if self._balanced:
            shifted = newton.augment() if moved else newton.follow()
        start = self._predicted(pose) if moved else None
        self._still = 0 if moved else self._still + 1
        hurried = budget is not None and self._still < _RESTING
        newton.may_factor = self._small or not (moved or hurried)
        left, stuck, actions = settings.most_iterations, False, []
        while newton.imbalance > goal * self._reference() and left > 0 and not stuck:
            enough = goal * newton.load if start is None else 0.0
            taken = newton.step(min(left, newton.patience), enough, start)
            stuck = not taken and newton.is_stuck
            left -= newton.used
            if budget is not None and (spent := time.perf_counter() - began) > budget:
                if start is not None and settings.frame_budget is not None:
                    actions.append(
                        f"frame_budget is {1e3 * budget:.3g} ms, but one step takes "
                        f"{1e3 * spent:.2g} ms: give it more"
                    )
                break
            start = None
        self._balanced = newton.imbalance <= settings.frame_tolerance * self._reference()
        if stuck:
            actions.append(f"no step led any further: {self._obstacle()}")
        self._settled = stuck
        return self._outcome(pose, shifted, actions)

    def _reference(self) -> float:
        """N, what unbalanced forces are measured by."""
        return self._newton.load or self._heaviest

    def _depth(self, pose: Pose, points: NDArray[np.float64]) -> float:
        """How deep (m) the probe is in points (C, 3), at least 0."""
        if len(points) == 0:
            return 0.0
        gap, _ = push_out(self.model.collider, pose, points, self.model.contact_spacing)
        return max(0.0, -float(gap.min()))

    def _predicted(self, pose: Pose) -> NDArray[np.float64]:
        """(3, N) m, aim at a new pose and return the linear answer to it."""
        newton, contact = self._newton, self._newton.contact
        held = contact.push[:, None] * contact.normal
        newton.aim(pose)
        self._aimed = pose
        change = predict_forces(
            self._compliance.matrix,
            contact.reach,
            contact.normal,
            held,
            contact.softness,
            self._touching,
        )
        field = np.zeros(newton.displacement.shape, np.float32)
        self._compliance.add_field(change, field)
        return field.astype(np.float64)

    def _obstacle(self) -> str:
        """What holds up a tissue that cannot be balanced."""
        newton = self._newton
        pulled = int(np.argmax(np.linalg.norm(newton.unbalanced, axis=0)))
        nodes = self.model.mesh.nodes + newton.displacement.T
        ratios = signed_volumes(nodes, self.model.mesh.tetrahedra) / self.model.mesh.volumes
        least = int(np.argmin(ratios))
        return (
            f"node {pulled} is the least balanced, and tetrahedron {least} has {ratios[least]:.2g} "
            "of its volume"
        )

    def _outcome(self, pose: Pose, shifted: float, actions: list[str]) -> Deformation:
        newton, contact = self._newton, self._newton.contact
        reached = newton.displacement
        if newton.tissue.smallest_volume_ratio(reached) > 0.0:
            self._upright, self._inverted = reached, 0
        else:
            self._inverted += 1
            actions.append("still inside out, so the last upright state is shown")
            newton.put(self._upright)
        self._heaviest = max(self._heaviest, newton.load)
        reference = self._reference() or newton.imbalance
        residual = newton.imbalance / reference if reference else 0.0
        sunk = -float(contact.gap.min())
        if sunk > _SINKS:
            actions.append(f"the probe is {1e3 * sunk:.2g} mm inside the tissue")
        nodes = self.model.mesh.nodes + newton.displacement.T
        pushed = contact.push > 0
        touched = self._surface[pushed]
        forces = contact.push[pushed, None] * contact.normal[pushed]
        force, torque = wrench_on_probe(pose, nodes[touched], forces)
        if self._inverted == 0:
            self._settled |= residual <= self._own.tolerance and shifted <= self._sunk
        elif self._inverted > _PATIENCE:
            actions.append("begun anew from rest")
            self._restore(TissueState.at_rest(len(nodes)))
        else:
            newton.put(reached)
        return Deformation(nodes, touched, force, torque, residual, "; ".join(actions))
