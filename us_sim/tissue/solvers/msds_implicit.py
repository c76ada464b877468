"""Implicit Euler for the mass-spring tissue: one long step a frame, whatever its stiffness.

The step is the minimum of `us_sim.tissue.elasticity.incremental_potential`. It is approached by
conjugate gradients with the constant factored matrix of
`us_sim.tissue.linear_algebra.sparse_factors`; each of their steps lowers the function, so
that no energy comes from nowhere and no time step is too long.

>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.model import TissueModel
>>> from us_sim.tissue.solvers.msds_implicit import MsdsImplicit
>>> model = TissueModel.block()
>>> solver = MsdsImplicit(model)
>>> for _ in range(40):
...     deformation = solver.deform(Pose(position=[0.0, 0.0, 0.01]))
>>> deformation.residual < 1e-3, bool(deformation.force[2] < 0)
(True, True)
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose, same_pose
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import setting
from us_sim.tissue.contact.active_set import ActiveSet
from us_sim.tissue.contact.probe_gap import push_out, wrench_on_probe
from us_sim.tissue.elasticity.incremental_potential import IncrementalPotential
from us_sim.tissue.elasticity.linear_tetrahedra import shape_gradients
from us_sim.tissue.elasticity.springs import SpringNetwork, VolumeTerm
from us_sim.tissue.linear_algebra.sparse_factors import ScalarPreconditioner
from us_sim.tissue.model import Deformation, TissueModel, TissueState
from us_sim.tissue.solvers.msds import (
    REST_TIME,
    SpringSettings,
    SpringTissue,
    spring_stiffness,
    spring_volume,
)
from us_sim.tissue.solvers.solver import (
    COUNT,
    TOLERANCE,
    Progress,
)

_SPRING_WEIGHT, _VOLUME_WEIGHT = 0.4, 0.3
"""Weights of springs and volumes in the preconditioner, where they resist in all directions alike:
between their resistance to shear and to compression (found by trial)."""

_LEAST_INERTIA = 1e-9
"""Least inertia of a node in the preconditioner, over its own stiffness."""

_HALVINGS = 20
"""Times that a step which does not lower the function is halved."""

_ROUNDING = 1e-13  # relative, of the function that is minimised


@dataclass(frozen=True)
class MsdsImplicitSettings(SpringSettings):
    """The settings of the solver ``msds_implicit``."""

    section = "msds_implicit"

    iterations: int = setting(COUNT, "conjugate-gradient iterations in a frame", default=2)
    contact_updates: int = setting(
        COUNT, "how often in a frame the set of touched nodes is revised", default=1
    )
    tolerance: float = setting(
        TOLERANCE, "unbalanced force over contact force at which a frame stops early", default=1e-4
    )
    time_step: float = setting(Quantity("time", 1e-9, 1e3), "of a frame", default=0.2)
    stiffness: str = spring_stiffness("fitted")
    volume: bool = spring_volume(True)


class MsdsImplicit(SpringTissue):
    """Point masses joined by springs and dampers, and tetrahedra that keep their volume.

    Nodes that the probe enters are moved onto its surface and slide on it; they are let go when
    they would be pulled. A probe that jumps takes the tissue along in one step.

    The residual is the norm of the unbalanced elastic forces over the norm of the contact forces
    (after a release, over the largest there were), as that of ``msds``.

    Args:
        model: may be free; then the whole tissue moves away when pushed.
        settings: see `MsdsImplicitSettings`.

    Raises:
        SolverError: a setting is out of range.
    """

    name: ClassVar[str] = "msds_implicit"
    in_short: ClassVar[str] = "springs fitted to the tissue, stable however stiff: for comparison"

    Settings = MsdsImplicitSettings

    def __init__(
        self,
        model: TissueModel,
        settings: MsdsImplicitSettings | None = None,
        progress: Progress | None = None,
    ) -> None:
        settings = settings or MsdsImplicitSettings()
        super().__init__(model, settings, progress)
        updates = min(settings.contact_updates, settings.iterations)
        self._rounds = np.diff(np.linspace(0, settings.iterations, updates + 1).round().astype(int))
        self._tolerance = settings.tolerance
        self._time_step = settings.time_step
        self._rest_tolerance = settings.rest_tolerance
        damping = settings.damping_factor
        self._rest_time = max(settings.time_step, damping, REST_TIME)
        springs, term = self._springs, self._volume
        self.mass = model.lumped_mass
        self._potential = IncrementalPotential(
            springs, term, self.mass, settings.time_step, damping
        )
        self._touchable = model.movable_contact_nodes
        self._contact = ActiveSet(
            model.collider, model.mesh.nodes[self._touchable], model.contact_spacing
        )
        self._preconditioner = self._factored(
            springs, term, 1.0 + damping / settings.time_step, progress
        )
        self._restore(self.state)

    def _factored(
        self,
        springs: SpringNetwork,
        term: VolumeTerm,
        stiffening: float,
        progress: Progress | None,
    ) -> ScalarPreconditioner:
        mesh = self.model.mesh
        ends, weights = [springs.edges], [_SPRING_WEIGHT * springs.stiffness]
        if len(term.tetrahedra):
            gradients = shape_gradients(mesh)
            bulk = _VOLUME_WEIGHT * (term.element + term.nodal) * mesh.volumes
            for a in range(4):
                for b in range(a):
                    ends.append(mesh.tetrahedra[:, [a, b]])
                    dots = np.einsum("ij,ij->i", gradients[:, a], gradients[:, b])
                    weights.append(-bulk * dots)
        edges, weight = np.concatenate(ends), stiffening * np.concatenate(weights)
        stiffest = np.zeros(len(mesh.nodes))
        np.add.at(stiffest, edges, np.abs(weight)[:, None])
        inertia = np.maximum(self.mass / self._time_step**2, _LEAST_INERTIA * stiffest)
        return ScalarPreconditioner(
            edges, weight, inertia, ~self.model.fixed, self._touchable, progress
        )

    def _restore(self, state: TissueState) -> None:
        super()._restore(state)
        self._contact.clear()
        self._preconditioner.confine(np.zeros(0, np.intp), np.zeros((0, 3)))
        self._energy = self._potential.elastic(self._positions)[0]  # J, of springs and volumes
        self._reference = 0.0  # N, what the tolerance refers to
        self._taken_over = bool(state.displacement.any())

    def _surface(self) -> NDArray[np.float64]:
        """(C, 3) m, displacement of the nodes that the probe can touch."""
        return (self._positions - self.model.mesh.nodes)[self._touchable]

    def _advance(self, pose: Pose | None) -> Deformation:
        contact = self._contact
        untouched = self._settled and not contact.touched.any()
        if self.model.fixed.all() or (untouched and contact.is_consistent(pose, self._surface())):
            return replace(
                self._resting(),
                nodes=self._positions.copy(),
                residual=self._last.residual,
                inverted=self._last.inverted,
            )
        if self._taken_over and pose is not None:
            contact.adopt(pose, self._surface())
            self._confine()
        self._taken_over = False
        moved = not same_pose(pose, self._pose)
        before = self._positions.copy()
        self._potential.begin(before, self._velocity)
        if moved and self._goes_on(pose):
            self._positions += self._time_step * self._velocity
        initial = -np.inf  # J, the function's largest value before it was lowered
        for number, iterations in enumerate(self._rounds):
            self._revise(pose, moved and number == 0)
            initial = max(initial, self._minimise(iterations))
        kinetic = self._kinetic()
        self._velocity = (self._positions - before) / self._time_step
        return self._outcome(pose, kinetic, initial)

    def _goes_on(self, pose: Pose | None) -> bool:
        """Whether the touched nodes, moving on as they do, come nearer to the probe's surface."""
        rows = self._touchable[self._contact.touched]
        if pose is None or not len(rows):
            return False
        here = self._positions[rows]
        gaps = []
        for points in (here, here + self._time_step * self._velocity[rows]):
            gap, _ = push_out(self.model.collider, pose, points, self.model.contact_spacing)
            gaps.append(float(np.linalg.norm(gap)))
        return gaps[1] < 0.5 * gaps[0]  # false where the probe has left a node

    def _confine(self) -> None:
        touched = np.flatnonzero(self._contact.touched)
        self._preconditioner.confine(touched, self._contact.normal[touched])

    def _revise(self, pose: Pose | None, moved: bool) -> None:
        """Renew the set of touched nodes and put them onto the probe; the others go along."""
        surface = self._surface()
        was = surface.copy()
        if not self._contact.update(pose, surface, moved=moved):
            return
        self._confine()
        touched = self._contact.touched
        distance = np.einsum("ij,ij->i", surface - was, self._contact.normal)[touched]
        self._preconditioner.move(self._positions, distance)
        rows = self._touchable[touched]
        self._positions[rows] = self.model.mesh.nodes[rows] + surface[touched]

    def _unconfined(self, force: NDArray[np.float64]) -> NDArray[np.float64]:
        """The force (N, 3) without the reactions of fixed nodes and of contact."""
        left = force.copy()
        left[self.model.fixed] = 0.0
        touched = self._contact.touched
        rows, normal = self._touchable[touched], self._contact.normal[touched]
        left[rows] -= np.einsum("ij,ij->i", left[rows], normal)[:, None] * normal
        return left

    def _minimise(self, iterations: int) -> float:
        """Lower the function by so many iterations; its value before, J."""
        potential = self._potential
        value, force = potential.evaluate(self._positions)
        start = value
        left = self._unconfined(force)
        stop = 0.5 * self._tolerance * self._reference
        direction, previous, slope = np.zeros_like(left), left, np.inf
        for _ in range(iterations):
            if np.linalg.norm(left) <= stop:
                break
            step = self._preconditioner.solve(left)
            # G. Polak and G. Ribiere's formula, started anew where it would turn back.
            descent = float(np.vdot(left, step))
            turn = max(0.0, (descent - float(np.vdot(step, previous))) / slope)
            direction = step + turn * direction
            if not np.vdot(direction, left) > 0:
                direction = step
            slope, previous = descent, left
            along = float(np.vdot(direction, left))
            bend = potential.curvature(self._positions, direction)
            if not (along > 0 and bend > 0):
                break
            length = along / bend
            for _halving in range(_HALVINGS):
                tried = self._positions + length * direction
                lower, force = potential.evaluate(tried)
                if lower <= value - 1e-4 * length * along + _ROUNDING * abs(value):
                    break
                length *= 0.5
            else:
                break
            self._positions, value = tried, lower
            left = self._unconfined(force)
        self._contact.set_forces(-force[self._touchable])
        load = float(np.linalg.norm(np.maximum(self._contact.normal_force, 0.0)))
        self._reference = load or self._residual_norm.largest_load
        return start

    def _outcome(self, pose: Pose | None, kinetic: float, initial: float) -> Deformation:
        contact, touchable = self._contact, self._touchable
        is_touched = bool(contact.touched.any())
        inverted, words, interventions = self._untangle(is_touched)
        energy, elastic = self._potential.elastic(self._positions)
        self._limit_speed(kinetic, initial, energy)
        elastic[self.model.fixed] = 0.0
        # Nodes that slid, or were moved onto planes, are now pushed in another direction.
        normal = contact.normal_at(pose, self._surface())
        loaded = np.einsum("ij,ij->i", elastic[touchable], normal) < 0
        pushed = contact.touched & (loaded | (contact.normal_force > 0))
        residual = self._residual_norm.residual(-elastic, touchable[pushed], normal[pushed])
        self._settled = (
            bool(np.abs(self._velocity).max() * self._rest_time < self._rest_tolerance)
            and residual <= self._tolerance
            and contact.is_consistent(pose, self._surface())
        )
        if self._settled and self._stop(is_touched):
            self._energy = residual = 0.0
        force, torque = np.zeros(3), np.zeros(3)
        if pose is not None:
            pushes = np.maximum(contact.normal_force[pushed, None], 0.0) * contact.normal[pushed]
            rows = touchable[pushed]
            force, torque = wrench_on_probe(pose, self._positions[rows], pushes)
        return Deformation(
            self._positions.copy(),
            touchable[pushed],
            force,
            torque,
            residual,
            words,
            inverted,
            interventions=interventions,
        )

    def _kinetic(self) -> float:
        """J, of the nodes' motion."""
        return 0.5 * float(self.mass @ np.einsum("ij,ij->i", self._velocity, self._velocity))

    def _limit_speed(self, kinetic: float, initial: float, energy: float) -> None:
        """Remove the speed that an unfinished minimisation or a jump of the probe brings in.

        The energy of inertia, springs and volumes at the start, with touched nodes where the probe
        has put them, is the value of the function there; no more can be left at the end. And a jump
        displaces nodes but does not throw them: kinetic energy grows by no more than the springs'
        and volumes' energy has changed.

        Args:
            kinetic: J, before the frame.
            initial: J, the function's largest value before it was lowered.
            energy: J, of springs and volumes now.
        """
        initial += self._energy * self._potential.viscous_part
        allowed = min(initial - energy, kinetic + abs(energy - self._energy))
        moving = self._kinetic()
        if moving > max(allowed, 0.0):
            self._velocity *= np.sqrt(max(allowed, 0.0) / moving)
        self._energy = energy
