"""The paper's mass-spring-damper system: Algorithm 1, symplectic Euler, 20 steps a frame.

>>> from us_sim.tissue.model import TissueModel
>>> solver = Msds(TissueModel.make_block())
>>> print(solver.deform(Pose(position=[0.0, 0.0, 0.01])).action)
masses scaled 159 to 198 times: unscaled, steps beyond 0.18 ms are unstable
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from us_sim import Progress
from us_sim.geometry.collider_distance import rotate_vector, rotate_vector_back
from us_sim.geometry.pose import Pose
from us_sim.kernels import njit
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import setting
from us_sim.settings.spelling import format_count
from us_sim.tissue.contact.probe_gap import measure_gaps, pushes_only_forward, pushing_gap
from us_sim.tissue.elasticity.springs import build_springs, fit_springs, spring_forces
from us_sim.tissue.elasticity.stability import (
    ElasticResidual,
    InversionWatch,
    highest_frequency,
    stabilise,
    step_limit,
)
from us_sim.tissue.model import Deformation, Intervention, TissueModel, TissueState
from us_sim.tissue.solvers.solver import COUNT, SolverSettings, TissueSolver

REST_TIME = 0.2
"""Shortest time for which motion is watched before the tissue counts as settled, s."""

_NEARLY_RESTING = 1e-4
"""Distance from its rest state up to which a released, settled tissue is put to rest, m."""


@dataclass(frozen=True)
class MsdsSettings(SolverSettings):
    """The settings of the solver ``msds``.

    Raises:
        SolverError: a value is out of range, with its name and the range.
    """

    section = "msds"

    stiffness: str = setting(
        choices=("algorithm_1", "fitted"),
        default="algorithm_1",
        description="how springs get their stiffness: algorithm_1 is the paper's; fitted fits them "
        "to the elasticity of the same mesh, at their own Poisson's ratio of 1/4, and needs no "
        "stiffness_factor",
    )
    stiffness_factor: float = setting(
        Quantity("length", 1e-9, 1e3),
        "spring constant over Young's modulus, for algorithm_1",
        default=0.002,
    )
    damping_factor: float = setting(
        Quantity("time", 0.0, 1e6), "damping constant over spring constant", default=0.1
    )
    rest_tolerance: float = setting(
        Quantity("length", 0.0, 1.0),
        "motion in a frame (in 0.2 s, or in damping_factor, if these are longer) below which the "
        "tissue counts as settled",
        default=1e-6,
    )
    steps: int = setting(COUNT, "time steps in a frame", default=20)
    time_step: float = setting(Quantity("time", 1e-18, 10.0), "of one step", default=0.01)
    stabilisation: str = setting(
        choices=("mass_scaling", "substeps", "none"),
        default="mass_scaling",
        description="what makes a step beyond the limit stable; with none, only the last good "
        "state is kept of such frames",
    )
    maximum_substeps: int = setting(COUNT, "of one step; more are refused", default=100)


class Particles(NamedTuple):
    """Masses, positions and velocities; kernels write on all but the masses."""

    inverse_mass: NDArray[np.float64]  # (N,), 1/kg, 0 where a particle is fixed
    positions: NDArray[np.float64]  # (N, 3), m
    velocity: NDArray[np.float64]  # (N, 3), m/s
    force: NDArray[np.float64]  # (N, 3), N


class ProbeMotion(NamedTuple):
    """Shape of the probe and its placement in each step; S = 0 steps when there is no probe."""

    box: NDArray[np.float64]  # the collider's `offset_box`
    forward: bool  # see `us_sim.tissue.contact.probe_gap.pushes_only_forward`
    rotations: NDArray[np.float64]  # (S, 3, 3), probe to patient
    origins: NDArray[np.float64]  # (S, 3), m


class ParticleContact(NamedTuple):
    """Particles that the probe can touch, and the kernels' results for them."""

    reachable: NDArray[np.int32]  # (C,), the particles
    touched: NDArray[np.bool_]  # (C,), in the last sub-step
    normal: NDArray[np.float64]  # (C, 3), where the probe pushes them
    wrench: NDArray[np.float64]  # (2, 3), N and N m on the probe in its frame, mean of the frame

    @classmethod
    def make_untouched(cls, reachable: NDArray[np.int32]) -> ParticleContact:
        """Make a contact in which nothing is touched."""
        count = len(reachable)
        return cls(reachable, np.zeros(count, bool), np.zeros((count, 3)), np.zeros((2, 3)))


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
        progress: Progress | None = None,
    ) -> None:
        settings = settings or MsdsSettings()
        super().__init__(model, settings, progress)
        mesh, materials, damping = model.mesh, model.materials, settings.damping_factor
        if settings.stiffness == "fitted":
            springs = fit_springs(mesh, materials, damping)
        else:
            springs = build_springs(mesh, materials, settings.stiffness_factor, damping)
        self._springs = springs.drop_fixed(model.fixed)
        self._residual_norm = ElasticResidual.for_springs(self._springs, mesh.nodes)
        self._inversion = InversionWatch(model)
        self._positions = model.mesh.nodes.copy()
        self._velocity = np.zeros_like(self._positions)
        self._steps = settings.steps
        self._rest_tolerance = settings.rest_tolerance
        self._damping_factor = settings.damping_factor
        self._factor = self._springs.factor_stiffness(mesh.nodes)
        self.mass, self._substeps, remark = stabilise(
            model,
            self._factor,
            settings.time_step,
            settings.damping_factor,
            settings.stabilisation,
            settings.maximum_substeps,
        )  # mass: (N,) kg, as simulated
        self._actions = (remark,) if remark else ()
        self._time_step = settings.time_step / self._substeps
        self._inverse_mass = np.where(model.fixed, 0.0, 1.0 / self.mass)
        self._forward = pushes_only_forward(model.collider, model.contact_spacing)
        self._particles = Particles(
            self._inverse_mass, self._positions, self._velocity, np.zeros_like(self._positions)
        )
        self._contact = ParticleContact.make_untouched(model.movable_contact_nodes)
        self._restore(self.state)

    @property
    def state(self) -> TissueState:
        """Displacement and velocity of the tissue."""
        return TissueState(self._positions - self.model.mesh.nodes, self._velocity.copy())

    @property
    def step_limit(self) -> float:
        """s, the longest stable step of small oscillations with the masses as simulated."""
        if self.model.fixed.all():
            return math.inf
        frequency = highest_frequency(self._factor, self.mass, self.model.fixed)
        return step_limit(frequency, self._damping_factor)

    def _restore(self, state: TissueState) -> None:
        self._positions[:] = self.model.mesh.nodes + state.displacement
        self._velocity[:] = state.velocity
        self._velocity[self.model.fixed] = 0.0
        self._residual_norm.reset()
        self._inversion.reset()
        self._contact.touched[:] = False

    def _advance(self, pose: Pose | None) -> Deformation:
        if self._settled and not self._contact.touched.any() and not self._is_entered(pose):
            return replace(
                self._resting(),
                nodes=self._positions.copy(),
                residual=self._last.residual,
                actions=self._actions,
                inverted=self._last.inverted,
            )
        probe = ProbeMotion(self.model.collider.offset_box, self._forward, *self._path(pose))
        self._contact.touched[:] = False
        self._contact.wrench[:] = 0.0
        advance_frame(
            self._springs,
            self._particles,
            probe,
            self._contact,
            self._time_step,
            self._substeps,
            self._steps,
        )
        return self._make_deformation(pose, *self._contact.wrench.copy())

    def _untangle(self, touched: bool) -> tuple[int, tuple[str, ...], Intervention]:
        """Put tissue to rest that stayed inside out without a probe.

        Returns:
            How many tetrahedra are inside out now, remarks, and these as a code.
        """
        inverted, hopeless = self._inversion.check_frame(self._positions, touched)
        if not hopeless:
            words = f"{format_count(inverted, 'tetrahedron is', 'tetrahedra are')} inside out"
            return inverted, (words,) if inverted else (), Intervention.NONE
        self._positions[:] = self.model.mesh.nodes
        self._velocity[:] = 0.0
        self._residual_norm.reset()
        words = (
            f"{format_count(inverted, 'tetrahedron', 'tetrahedra')} stayed inside out, so the "
            f"tissue was put back to rest"
        )
        return 0, (words,), Intervention.PUT_TO_REST

    def _stop(self, touched: bool) -> bool:
        """End the motion of settled tissue; returns whether it was put to rest entirely."""
        self._velocity[:] = 0.0
        displaced = np.abs(self._positions - self.model.mesh.nodes).max()
        if touched or not self.model.fixed.any() or not displaced < _NEARLY_RESTING:
            return False
        self._positions[:] = self.model.mesh.nodes
        self._residual_norm.reset()
        return True

    def _measure_gaps(self, pose: Pose) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return measure_gaps(
            self.model.collider,
            pose,
            self._positions[self.model.movable_contact_nodes],
            self.model.contact_spacing,
        )

    def _is_entered(self, pose: Pose | None) -> bool:
        return pose is not None and bool((self._measure_gaps(pose)[0] < 0).any())

    def _path(self, pose: Pose | None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return rotations (S, 3, 3) and origins (S, 3) m of the probe; S steps, 0 without one."""
        if pose is None:
            return np.empty((0, 3, 3)), np.empty((0, 3))
        before = self._pose or self._lift(pose)
        fraction = np.arange(1, self._steps + 1)[:, None] / self._steps
        origins = before.position + fraction * (pose.position - before.position)
        if np.array_equal(before.orientation, pose.orientation):
            rotations = np.repeat(pose.rotation[None], self._steps, axis=0)
        else:
            towards = pose.orientation * (1 if pose.orientation @ before.orientation >= 0 else -1)
            turns = (1 - fraction) * before.orientation + fraction * towards
            rotations = np.array([Pose(orientation=turn).rotation for turn in turns])
        return rotations, origins

    def _lift(self, pose: Pose) -> Pose:
        """Return the start of a probe that was not there before: lifted along its axis, clear."""
        gap, _ = self._measure_gaps(pose)
        depth = max(0.0, -float(gap.min(initial=0.0)))
        return Pose(pose.position - depth * pose.rotation[:, 2], pose.orientation)

    def _make_deformation(
        self, pose: Pose | None, force: NDArray[np.float64], torque: NDArray[np.float64]
    ) -> Deformation:
        is_touched = bool(self._contact.touched.any())
        inverted, words, interventions = self._untangle(is_touched)
        still = np.zeros_like(self._velocity)
        elastic = self._springs.compute_forces(self._positions, still)
        elastic[self.model.fixed] = 0.0
        touched = self.model.movable_contact_nodes[self._contact.touched]
        normal = (
            np.zeros((0, 3)) if pose is None else self._measure_gaps(pose)[1][self._contact.touched]
        )
        residual = self._residual_norm.compute_residual(-elastic, touched, normal)

        frame = max(self._steps * self._substeps * self._time_step, REST_TIME)
        speed = np.abs(self._velocity).max()
        along = np.einsum("ij,ij->i", elastic[touched], normal)
        elastic[touched] -= np.minimum(along, 0.0)[:, None] * normal
        acceleration = np.abs(elastic * self._inverse_mass[:, None]).max()
        self._settled = bool(
            max(speed * max(frame, self._damping_factor), acceleration * frame**2)
            < self._rest_tolerance
            and not self._is_entered(pose)
        )
        if self._settled and self._stop(is_touched):
            residual = 0.0
        return Deformation(
            self._positions.copy(),
            touched,
            force,
            torque,
            residual,
            self._actions + words,
            inverted,
            interventions=interventions,
        )


@njit(cache=True, nogil=True, error_model="numpy")
def advance_frame(springs, particles, probe, contact, time_step, substeps, steps):
    """Move the particles by ``steps`` of ``substeps`` of ``time_step`` (s), by symplectic Euler.

    Args:
        springs: their `SpringNetwork`.
        particles: `Particles`, moved here.
        probe: `ProbeMotion` of S = ``steps`` steps, or of none.
        contact: `ParticleContact`, filled in here as of the last sub-step; its wrench is added to.
        time_step: s, of a sub-step.
        substeps: of each step.
        steps: of the frame.
    """
    inverse_mass, positions, velocity, force = particles
    duration = time_step * steps * substeps
    for step in range(steps):
        for _sub in range(substeps):
            spring_forces(springs, positions, velocity, force)
            for i in range(len(positions)):
                for axis in range(3):
                    v = velocity[i, axis] + time_step * inverse_mass[i] * force[i, axis]
                    # Ahead of a press motion decays to denormal numbers, ten times as slow.
                    velocity[i, axis] = v if abs(v) > 1e-30 else 0.0
            for i in range(len(positions)):
                for axis in range(3):
                    positions[i, axis] += time_step * velocity[i, axis]
            if len(probe.origins) > 0:
                contact.touched[:] = False
                _stop_at_probe(particles, probe, step, contact, duration)


@njit(cache=True, nogil=True, error_model="numpy")
def _stop_at_probe(particles, probe, step, contact, duration):
    """Put particles that have entered the probe onto it; they lose their velocity towards it.

    The impulses on the probe, over ``duration`` (s), are added to the wrench.
    """
    inverse_mass, positions, velocity, _ = particles
    reachable, touched, normal, wrench = contact
    r, origin = probe.rotations[step], probe.origins[step]
    for k in range(len(reachable)):
        i = reachable[k]
        a = positions[i, 0] - origin[0]
        b = positions[i, 1] - origin[1]
        c = positions[i, 2] - origin[2]
        x, y, z = rotate_vector_back(r, a, b, c)
        gap, u, v, w = pushing_gap(probe.box, probe.forward, 0.0, x, y, z)
        if gap >= 0.0:
            continue
        nx, ny, nz = rotate_vector(r, u, v, w)
        positions[i, 0] -= gap * nx
        positions[i, 1] -= gap * ny
        positions[i, 2] -= gap * nz
        along = velocity[i, 0] * nx + velocity[i, 1] * ny + velocity[i, 2] * nz
        if along >= 0.0:
            continue
        velocity[i, 0] -= along * nx
        velocity[i, 1] -= along * ny
        velocity[i, 2] -= along * nz
        touched[k] = True
        normal[k, 0] = nx
        normal[k, 1] = ny
        normal[k, 2] = nz
        push = along / (inverse_mass[i] * duration)
        x -= gap * u
        y -= gap * v
        z -= gap * w
        wrench[0, 0] += push * u
        wrench[0, 1] += push * v
        wrench[0, 2] += push * w
        wrench[1, 0] += push * (y * w - z * v)
        wrench[1, 1] += push * (z * u - x * w)
        wrench[1, 2] += push * (x * v - y * u)
