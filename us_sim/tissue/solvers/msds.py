"""The paper's mass-spring-damper system: Algorithm 1, symplectic Euler, 20 steps a frame.

>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.model import TissueModel
>>> from us_sim.tissue.solvers.msds import Msds
>>> solver = Msds(TissueModel.block())
>>> print(solver.deform(Pose(position=[0.0, 0.0, 0.01])).action)
masses scaled 159 to 198 times: unscaled, steps beyond 0.18 ms are unstable
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import setting
from us_sim.tissue.contact.penetration import only_forward, push_out
from us_sim.tissue.elasticity.stability import (
    ElasticBalance,
    Tangling,
    highest_frequency,
    stabilised,
    step_limit,
)
from us_sim.tissue.model import Deformation, TissueModel, TissueState
from us_sim.tissue.solvers.solver import COUNT, TissueSolver
from us_sim.tissue.solvers.spring_tissue import SpringSettings, spring_tissue
from us_sim.tissue.solvers.symplectic_euler import Contact, Particles, ProbeMotion, advance_frame

_REST_TIME = 0.2
"""Shortest time for which motion is watched before the tissue counts as settled, s."""

_NEARLY_RESTING = 1e-4
"""Distance from its rest state up to which a released, settled tissue is put to rest, m."""


@dataclass(frozen=True)
class MsdsSettings(SpringSettings):
    """The settings of the solver ``msds``."""

    section = "msds"

    steps: int = setting(COUNT, "time steps in a frame", default=20)
    time_step: float = setting(Quantity("time", 1e-18, 10.0), "of one step", default=0.01)
    stabilisation: str = setting(
        choices=("mass_scaling", "substeps", "none"),
        default="mass_scaling",
        description="what makes a step beyond the limit stable; with none it ends in frames of "
        "which only the last good state is kept",
    )
    maximum_substeps: int = setting(COUNT, "of one step; more are refused", default=100)


class Msds(TissueSolver):
    """Point masses joined by Voigt elements (the paper's eqs. 1 to 5).

    With the tissue's own masses the paper's damping is stable only for steps of some microseconds,
    so either each mass is raised to what the step set needs or each step is divided. Both follow
    the bound w**2 <= 2 max(sum of a node's springs / its mass), which holds however the springs
    turn and stretch (`us_sim.tissue.elasticity.stability`).

    The probe moves from the last pose to the new one over the frame. A node that would enter it
    loses its velocity towards it, which is the measured push, and is put onto its surface.

    The residual is the norm of the unbalanced elastic forces over the norm of the contact forces
    (after a release, over the largest there were): how far the springs are from rest, not from
    their own motion.

    Args:
        model: may be free; then the whole tissue moves away when pushed.
        settings: see `MsdsSettings`.

    Raises:
        SolverError: a setting is out of range, or too many sub-steps would be needed.
    """

    name: ClassVar[str] = "msds"
    in_short: ClassVar[str] = "springs as in the paper, forces not calibrated: for comparison"

    Settings = MsdsSettings

    def __init__(
        self,
        model: TissueModel,
        settings: MsdsSettings | None = None,
        progress: Callable[[float, str], None] | None = None,
    ) -> None:
        settings = settings or MsdsSettings()
        super().__init__(model, settings, progress)
        self._steps = settings.steps
        self._rest_tolerance = settings.rest_tolerance
        self._damping_factor = settings.damping_factor
        self._springs, self._volume = spring_tissue(model, settings, yielding=True)
        self._factors = [part.factor(model.mesh.nodes) for part in (self._springs, self._volume)]
        self.mass, self._substeps, self._action = stabilised(
            model,
            self._factors,
            settings.time_step,
            settings.damping_factor,
            settings.stabilisation,
            settings.maximum_substeps,
        )  # mass: (N,) kg, as simulated
        self._time_step = settings.time_step / self._substeps
        self._inverse_mass = np.where(model.fixed, 0.0, 1.0 / self.mass)
        self._balance = ElasticBalance.of(self._springs, self._volume, model.mesh.nodes)
        self._tangling = Tangling(model)
        self._forward = only_forward(model.collider, model.contact_spacing)

        self._positions = model.mesh.nodes.copy()
        self._velocity = np.zeros_like(self._positions)
        self._particles = Particles(
            self._inverse_mass, self._positions, self._velocity, np.zeros_like(self._positions)
        )
        self._contact = Contact.at(model.movable_contact_nodes)
        self._restore(self.state)

    @property
    def step_limit(self) -> float:
        """s, the longest stable step of small oscillations with the masses as simulated."""
        if self.model.fixed.all():
            return math.inf
        frequency = highest_frequency(self._factors, self.mass, self.model.fixed)
        return step_limit(frequency, self._damping_factor)

    @property
    def state(self) -> TissueState:
        """Where the tissue is and how fast it moves."""
        return TissueState(self._positions - self.model.mesh.nodes, self._velocity.copy())

    def _restore(self, state: TissueState) -> None:
        self._positions[:] = self.model.mesh.nodes + state.displacement
        self._velocity[:] = state.velocity
        self._velocity[self.model.fixed] = 0.0
        self._contact.touched[:] = False
        self._balance.forget()
        self._tangling.forget()

    def _advance(self, pose: Pose | None) -> Deformation:
        if self._settled and not self._contact.touched.any() and not self._entered(pose):
            return Deformation(
                self._positions.copy(),
                np.empty(0, np.int32),
                np.zeros(3),
                np.zeros(3),
                self._last.residual,
                self._action,
            )
        probe = ProbeMotion(self.model.collider.offset_box, self._forward, *self._path(pose))
        self._contact.touched[:] = False
        self._contact.wrench[:] = 0.0
        advance_frame(
            self._springs.arrays,
            self._volume.arrays,
            self._particles,
            probe,
            self._contact,
            self._time_step,
            self._substeps,
            self._steps,
        )
        return self._outcome(pose, *self._contact.wrench.copy())

    def _gap(self, pose: Pose) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return push_out(
            self.model.collider,
            pose,
            self._positions[self.model.movable_contact_nodes],
            self.model.contact_spacing,
        )

    def _entered(self, pose: Pose | None) -> bool:
        return pose is not None and bool((self._gap(pose)[0] < 0).any())

    def _path(self, pose: Pose | None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Rotations (S, 3, 3) and origins (S, 3) m of the probe at each step; S = 0 without one."""
        if pose is None:
            return np.empty((0, 3, 3)), np.empty((0, 3))
        before = self._pose or self._lifted(pose)
        fraction = np.arange(1, self._steps + 1)[:, None] / self._steps
        origins = before.position + fraction * (pose.position - before.position)
        if np.array_equal(before.orientation, pose.orientation):
            rotations = np.repeat(pose.rotation[None], self._steps, axis=0)
        else:
            towards = pose.orientation * (1 if pose.orientation @ before.orientation >= 0 else -1)
            turns = (1 - fraction) * before.orientation + fraction * towards
            rotations = np.array([Pose(orientation=turn).rotation for turn in turns])
        return rotations, origins

    def _lifted(self, pose: Pose) -> Pose:
        """The start of a probe that was not there before: lifted straight up until it is clear."""
        gap, _ = self._gap(pose)
        depth = max(0.0, -float(gap.min(initial=0.0)))
        return Pose(pose.position - depth * pose.rotation[:, 2], pose.orientation)

    def _outcome(
        self, pose: Pose | None, force: NDArray[np.float64], torque: NDArray[np.float64]
    ) -> Deformation:
        action = self._put_back_if_tangled()
        still = np.zeros_like(self._velocity)
        elastic = self._springs.forces(self._positions, still)
        elastic += self._volume.forces(self._positions, still)
        elastic[self.model.fixed] = 0.0
        touched = self.model.movable_contact_nodes[self._contact.touched]
        normal = np.zeros((0, 3)) if pose is None else self._gap(pose)[1][self._contact.touched]
        residual = self._balance.residual(-elastic, touched, normal)

        frame = max(self._steps * self._substeps * self._time_step, _REST_TIME)
        speed = np.abs(self._velocity).max()
        along = np.einsum("ij,ij->i", elastic[touched], normal)
        elastic[touched] -= np.minimum(along, 0.0)[:, None] * normal
        acceleration = np.abs(elastic * self._inverse_mass[:, None]).max()
        self._settled = bool(
            max(speed * max(frame, self._damping_factor), acceleration * frame**2)
            < self._rest_tolerance
            and not self._entered(pose)
        )
        if self._settled:
            self._velocity[:] = 0.0
            displaced = np.abs(self._positions - self.model.mesh.nodes).max()
            if (
                not self._contact.touched.any()
                and self.model.fixed.any()
                and displaced < _NEARLY_RESTING
            ):
                self._positions[:] = self.model.mesh.nodes
                self._balance.forget()
                residual = 0.0
        return Deformation(self._positions.copy(), touched, force, torque, residual, action)

    def _put_back_if_tangled(self) -> str:
        """The action of stabilisation, followed by what was done about inverted tetrahedra."""
        words, hopeless = self._tangling.judge(self._positions, bool(self._contact.touched.any()))
        if hopeless:
            self._positions[:] = self.model.mesh.nodes
            self._velocity[:] = 0.0
            self._balance.forget()
        return "; ".join(filter(None, [self._action, words]))
