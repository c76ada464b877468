"""Large deformation of nearly incompressible tissue, in real time.

Quasi-static: every frame the energy of `neo_hookean` and of a penalty contact is made least, by
Newton's method with a line search (see `us_sim.tissue.solvers.newton`), from where the frame before
ended. A new pose of the probe is met with the exact linear answer to it first (contact is a
complementarity problem on the surface compliance). Friction and viscous tissue, where they are
asked for, remember the frames before (see `us_sim.tissue.contact.penalty_contact` and
`us_sim.tissue.elasticity.neo_hookean`). What a frame's time does not allow for goes on
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

What may be set of the solver ``fem_nonlinear``.

>>> from us_sim.tissue.solvers.fem_nonlinear import FemNonlinearSettings
>>> FemNonlinearSettings(frame_budget="8 ms").frame_budget
0.008
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from us_sim.geometry.pose import Pose
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import setting
from us_sim.tissue.contact.complementarity import predict_forces
from us_sim.tissue.contact.compliant_contact import COEFFICIENT, CONTACTS
from us_sim.tissue.contact.probe_gap import GAP_TOLERANCE, wrench_on_probe
from us_sim.tissue.contact.stiffness import compliance_between, contact_stiffness
from us_sim.tissue.elasticity.linear_tetrahedra import require_held
from us_sim.tissue.elasticity.neo_hookean import PronyBranch
from us_sim.tissue.elasticity.neo_hookean_material import require_solid
from us_sim.tissue.linear_algebra.compliance import surface_compliance
from us_sim.tissue.mesh.tetrahedral_mesh import signed_volumes
from us_sim.tissue.model import Deformation, TissueModel, TissueState
from us_sim.tissue.solvers.newton import Newton, strides
from us_sim.tissue.solvers.solver import COUNT, TOLERANCE, SolverSettings, TissueSolver, same_pose


@dataclass(frozen=True)
class FemNonlinearSettings(SolverSettings):
    """The settings of the solver ``fem_nonlinear``."""

    section = "fem_nonlinear"

    frame_tolerance: float = setting(
        TOLERANCE,
        "residual, unbalanced over contact forces, at which a frame with a moving probe ends",
        default=0.003,
    )
    frame_budget: float | None = setting(
        Quantity("time", 0.0005, 10.0),
        "time after which a frame ends with what it has, and the next goes on. Not given, 0 as a "
        "parameter: live, what the rate leaves, and up to three times that until the forces are "
        "balanced; in lockstep no limit, lest results depend on the machine",
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
    contact: str = setting(
        choices=CONTACTS,
        default="frictionless",
        description="what holds between probe and tissue; sticking: a touched node keeps its place "
        "on the probe until it is let go",
    )
    friction: float = setting(
        COEFFICIENT,
        "Coulomb's coefficient, where contact is coulomb; the default is a choice, meant for gel",
        default=0.07,
    )
    viscosity: float = setting(
        Quantity("number", 0.0, 10.0),
        "stiffness that relaxes while a deformation lasts, over the one that stays: tissue gives "
        "way slowly and creeps back when it is let go; 0: none",
        default=0.0,
    )
    relaxation_time: float = setting(
        Quantity("time", 1e-3, 1e3),
        "time in which that falls to 37 percent (1/e)",
        default=0.5,
    )
    frame_interval: float = setting(
        Quantity("time", 1e-4, 10.0),
        "time that is taken to pass from one frame to the next, for viscous tissue; a frame is "
        "one pose of the probe",
        default=0.0167,
    )


__all__ = ["FemNonlinear", "FemNonlinearSettings"]


_TOUCHING = 0.1
"""Gap up to which a node may come to touch in one frame, over the tissue's smallest extent."""


_RESTING = 30
"""Frames of a probe at rest after which one may take longer than it should, if that is needed."""


_SUNK = 10.0
"""Change of what springs hold that settled tissue may still see, over the spacing of the nodes that
the probe can touch, for a tolerance of 1."""


_SINKS = 0.5
"""Depth of the probe in the tissue, over that spacing, that is worth saying."""


_APPROACHING, _SPENT = 0.7, 0.6
"""Part of a frame's time, and of its iterations, after which no stride is begun any more."""


_ANEW = 6
"""How many times the iterations of other frames one may take that is begun anew from rest."""


_STEP = 8
"""What a step costs besides its iterations, in iterations."""


_OVERTIME = 3.0
"""How many times the time that a live simulation leaves a frame may take that is not in balance:
tissue that is left behind is harder to balance than poses that were missed, and shows more."""


_LOOSE, _STEPS = 0.2, 5
"""Residual with which a stride ends, and the most steps that it may take."""


_PATIENCE = 10
"""Frames in a row that may end inside out before the tissue is begun anew from rest. None where
time is short and the probe moves on: what is shown would stay behind ever farther."""


class FemNonlinear(TissueSolver):
    """Stable neo-Hookean finite elements under a probe, by Newton's method.

    The residual is the norm of the unbalanced nodal forces, of tissue and contact together, over
    the norm of the contact forces (without any, over the largest since rest, and before there are
    any, over the first unbalanced), in double precision and of the displacement that is returned.

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
    farthest: ClassVar[float] = 3.0  # fixed nodes hold it
    most_unbalanced: ClassVar[float] = 0.1  # within 6 % in 95 of 100 frames; at 1 tenfold

    Settings = FemNonlinearSettings
    settings: FemNonlinearSettings

    def __init__(
        self,
        model: TissueModel,
        settings: FemNonlinearSettings | None = None,
        progress: Callable[[float, str], None] | None = None,
    ) -> None:
        require_held(model.mesh, model.fixed)
        require_solid(model.mesh, model.materials)
        settings = settings or FemNonlinearSettings()
        super().__init__(model, settings, progress)
        self._surface = model.movable_contact_nodes
        smallest = float(np.ptp(model.mesh.nodes, axis=0).min())
        self._sunk = _SUNK * settings.tolerance * (model.contact_spacing or smallest)
        self._sinks = _SINKS * (model.contact_spacing or smallest)
        box = model.collider.offset_box
        self._arm = math.hypot(box[0], box[1])
        self._touching = _TOUCHING * smallest
        laws = {"frictionless": 0.0, "coulomb": settings.friction, "sticking": math.inf}
        branch = PronyBranch(settings.viscosity, settings.relaxation_time, settings.frame_interval)
        self._newton = Newton(model, laws[settings.contact], branch if settings.viscosity else None)
        self._upright = self._newton.displacement  # (3, N) m, the last that was
        if len(self._surface):
            self._compliance = surface_compliance(model, progress)
        self._restore(self.state)

    @property
    def state(self) -> TissueState:
        """Where the tissue is; a quasi-static solver has no velocity."""
        displacement = self._upright.T.copy()
        return TissueState(displacement, np.zeros_like(displacement))

    def contact_stiffness(self) -> NDArray[np.float64] | None:
        """Approximate: tissue as at rest, pushes that do not turn. Unknown with friction."""
        newton, contact = self._newton, self._newton.contact
        law = contact.slope, contact.gap, contact.normal
        gap, normal, softness = newton.points.nodal_springs(*law)
        pushed = np.flatnonzero(np.isfinite(gap[self._surface]))
        if self._pose is None or len(pushed) == 0:
            return np.zeros((6, 6))
        if self.settings.contact != "frictionless":
            return None
        nodes = self._surface[pushed]
        # The springs of the contact and the tissue give way one after the other.
        compliance = compliance_between(self._compliance.matrix, pushed) / self._stiffer
        across = normal[nodes, :, None] * normal[nodes, None, :]
        compliance += block_diag(*(softness[nodes, None, None] * across))
        return contact_stiffness(
            self.model.collider,
            self._pose,
            self.model.mesh.nodes[nodes] + newton.displacement.T[nodes],
            newton.pushes[:, nodes].T,
            compliance,
            self.model.contact_spacing,
            (normal[nodes], np.zeros((len(nodes), 3, 3))),
        )

    @property
    def _stiffer(self) -> float:
        """Stiffness within a frame, over the one that stays."""
        overstress = self._newton.overstress
        return 1.0 if overstress is None else 1.0 + overstress.stiffness

    @property
    def _has_relaxed(self) -> bool:
        """Whether viscous tissue will not creep any more."""
        overstress = self._newton.overstress
        return overstress is None or overstress.load <= self.settings.tolerance * self._reference()

    def _restore(self, state: TissueState) -> None:
        self._newton.rest()
        self._heaviest = 0.0  # N, largest contact forces since rest; before there are, unbalanced
        self._aimed: Pose | None = None  # the pose that the tissue is at or on its way to
        self._still = 0  # frames in a row with the probe at rest
        self._balanced = False  # whether the last frame's forces were
        self._inverted = 0  # frames in a row that ended inside out
        self._anew = False  # whether the tissue is begun anew, after such frames
        if state.displacement.any():
            displacement = np.ascontiguousarray(state.displacement.T)
            # The way out of tissue inside out may end in a minimum where it is folded over.
            if self._newton.tissue.smallest_volume_ratio(displacement) > 0.0:
                self._newton.put(displacement)
                if self._newton.overstress is not None:
                    self._newton.overstress.forget(displacement)
        self._upright = self._newton.displacement

    def _rehearse(self) -> None:
        self._newton.rehearse()

    def _advance(self, pose: Pose | None) -> Deformation:
        began = time.perf_counter()
        newton, settings = self._newton, self.settings
        newton.relax()
        if self._is_unloaded(pose):
            # Nothing reaches the undeformed tissue: it is the solution.
            self._restore(TissueState.at_rest(len(self.model.mesh.nodes)))
            self._settled = True
            return self._resting()
        budget = settings.frame_budget or self.frame_limit
        moved = not same_pose(pose, self._aimed)
        goal = settings.frame_tolerance if moved else settings.tolerance
        self._still = 0 if moved else self._still + 1
        shifted, start, spent = np.inf, None, 0
        if pose is None:
            newton.lift()
            self._aimed = None
        elif not moved:
            shifted = newton.settle() if self._balanced else np.inf
        elif len(self._surface):
            spent = self._approach(pose, None if budget is None else began + _APPROACHING * budget)
            start = self._predicted(pose)
        hurried = budget is not None and self._still < _RESTING
        newton.may_factor = newton.is_small or not (moved or hurried)
        left = self._allowed() - spent
        stuck, actions = False, []
        while newton.imbalance > goal * self._reference() and left > 0 and not stuck:
            enough, stepping = goal * newton.load if start is None else 0.0, time.perf_counter()
            taken = newton.step(min(left, newton.patience), enough, start)
            stuck = not taken and newton.is_stuck
            left -= newton.used + _STEP
            now = time.perf_counter()
            if budget is not None and now - began > budget * self._overtime():
                if now - stepping > budget and settings.frame_budget is not None:
                    actions.append(
                        f"frame_budget is {1e3 * budget:.3g} ms, but one step takes "
                        f"{1e3 * (now - stepping):.2g} ms: give it more"
                    )
                break
            start = None
        self._balanced = newton.imbalance <= settings.frame_tolerance * self._reference()
        if stuck:
            actions.append(f"no step led any further: {self._obstacle()}")
        self._settled = stuck
        self._anew = False
        return self._outcome(pose, shifted, actions, 0 if hurried else _PATIENCE)

    def _allowed(self) -> int:
        """Iterations that this frame may take, as `most_iterations` counts them."""
        return self.settings.most_iterations * (_ANEW if self._anew else 2 if self._still else 1)

    def _reference(self) -> float:
        """N, what unbalanced forces are measured by."""
        return self._newton.load or self._heaviest

    def _overtime(self) -> float:
        """How many times its time a frame may take as it is now."""
        balanced = self._newton.imbalance <= self.settings.frame_tolerance * self._reference()
        return 1.0 if balanced or self.settings.frame_budget is not None else _OVERTIME

    def _is_unloaded(self, pose: Pose | None) -> bool:
        """Whether nothing reaches the undeformed tissue, nor does it remember anything."""
        overstress = self._newton.overstress
        if overstress is not None and np.abs(overstress.relaxed).max() > self._sunk:
            return False
        return pose is None or self._newton.depth_at_rest(pose) <= GAP_TOLERANCE

    def _approach(self, pose: Pose, end: float | None) -> int:
        """Go most of a long way in strides, until a time (s): tissue that is hit or swept aside at
        once may end elsewhere than if the probe had moved there. Returns the iterations spent, as
        `most_iterations` counts them.
        """
        spent, most = 0, _SPENT * self._allowed()
        last = self._aimed if self._newton.load > 0.0 else None
        for nearer in strides(last, pose, self._newton.depth(pose), self._arm):
            if spent > most or (end is not None and time.perf_counter() > end):
                break
            start = self._predicted(nearer)
            for k in range(_STEPS):
                self._newton.step(self._newton.patience, 0.0, None if k else start)
                spent += self._newton.used + _STEP
                if self._newton.imbalance <= _LOOSE * self._newton.load:
                    break
        return spent

    def _predicted(self, pose: Pose) -> NDArray[np.float64]:
        """(3, N) m, aim at a new pose and return the linear answer to it."""
        newton, contact, points = self._newton, self._newton.contact, self._newton.points
        held, before = newton.pushes[:, self._surface].T.copy(), contact.push
        newton.aim(pose)
        self._aimed = pose
        # As if each node had the springs of its points to itself.
        firm = np.where(contact.gap < 0.0, contact.stiffness, 0.0)
        gap, normal, softness = points.nodal_springs(firm, contact.gap, contact.normal)
        change = predict_forces(
            self._compliance.matrix,
            gap[self._surface],
            normal[self._surface],
            held / self._stiffer,
            softness[self._surface] * self._stiffer,
            self._touching,
        )
        field = np.zeros(newton.displacement.shape, np.float32)
        self._compliance.add_field(change, field)
        start = field.astype(np.float64)
        if self.settings.contact != "frictionless":
            along = np.einsum("ij,ij->i", contact.normal, points.moved(start))
            newton.expect(np.where(before > 0.0, before, contact.push_at(contact.gap + along)))
        return start

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

    def _outcome(
        self, pose: Pose | None, shifted: float, actions: list[str], patience: int
    ) -> Deformation:
        newton, contact = self._newton, self._newton.contact
        reached = newton.displacement
        if newton.tissue.smallest_volume_ratio(reached) > 0.0:
            self._upright, self._inverted = reached, 0
        else:
            self._inverted += 1
            actions.append("still inside out, so the last upright state is shown")
            newton.put(self._upright)
        self._heaviest = max(self._heaviest, newton.load) or newton.imbalance
        reference = self._reference()
        residual = newton.imbalance / reference if reference else 0.0
        sunk = -float(contact.gap.min(initial=np.inf))
        if sunk > self._sinks:
            actions.append(f"the probe is {1e3 * sunk:.2g} mm inside the tissue")
        nodes = self.model.mesh.nodes + newton.displacement.T
        forces = newton.pushes[:, self.model.contact_nodes].T
        pushed = forces.any(axis=1)
        touched, forces = self.model.contact_nodes[pushed], forces[pushed]
        force, torque = np.zeros(3), np.zeros(3)
        if pose is not None:
            force, torque = wrench_on_probe(pose, nodes[touched], forces)
        if self._inverted == 0:
            balanced = residual <= self.settings.tolerance and shifted <= self._sunk
            self._settled = self._has_relaxed and (self._settled or balanced)
        elif self._inverted > patience:
            actions.append("begun anew from rest")
            self._restore(TissueState.at_rest(len(nodes)))
            self._anew = True
        else:
            newton.put(reached)
        return Deformation(nodes, touched, force, torque, residual, "; ".join(actions))
