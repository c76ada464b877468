"""The tissue's answer near a pose of the probe, as an energy whose slope is the wrench.

>>> import numpy as np
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tracking.haptic.contact_model import ContactModel
>>> wrench = np.array([0.0, 0.0, -2.0, 0.0, 0.0, 0.0])  # N: pressed 10 mm into 200 N/m
>>> stiffness = np.diag([0.0, 0.0, 200.0, 0.0, 0.0, 0.0])
>>> wall = ContactModel(0, Pose(position=[0.0, 0.0, 0.01]), wrench, stiffness)
>>> for depth in (0.015, 0.005, -0.005):
...     print(wall.wrench_at(Pose(position=[0.0, 0.0, depth]))[2].round(6))
-3.0
-1.0
0.0
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import TrackingError
from us_sim.geometry import se3
from us_sim.geometry.pose import Pose

_HEAVIEST, _STIFFEST = 1e5, 1e9
"""N and N/m beyond which a model is not believed."""

_FADING = 0.5
"""Fraction of the push at the model's pose below which the rest of the energy fades."""

_FARTHEST = 0.03
"""m: distance after which the push ends at the latest, however soft the tissue is."""

_STIFFEST_SECANT = 3e3
"""N/m: beyond it the stiffness is an oscillation of the solver, not tissue."""

_NEAR = 5e-4
"""m along the push: poses nearer than this do not determine the stiffness between them."""


def wrench_in_patient(
    pose: Pose, force: NDArray[np.float64], torque: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(6,) N, N m: force and torque (3,) along the probe's axes, along those of ``patient``."""
    return np.concatenate([pose.rotation @ force, pose.rotation @ torque])


@dataclass(frozen=True, eq=False)
class ContactModel:
    """The wrench on the probe near a pose, from the tissue's last solution.

    With d the displacement of the probe's origin and its rotation vector about the axes of
    ``patient``, the energy is ``-wrench · d + d · stiffness d / 2``. The part of it along the push
    is that of a spring, which ends where it would pull. The rest is bounded by the energy of that
    spring, and fades with the push, so that it is zero without one. The wrench is the slope of
    this one energy: over a closed path no work is done.

    Raises:
        TrackingError: a number is not finite or absurd, a shape is wrong, or the stiffness is not
            symmetric.
    """

    stamp: int  # ns, of the pose
    pose: Pose  # of the probe in patient
    wrench: NDArray[np.float64]  # (6,) N, N m, on the probe, about its origin, axes of patient
    stiffness: NDArray[np.float64]  # (6, 6) N/m, N, N m, how the wrench falls with the motion

    def __post_init__(self) -> None:
        wrench = np.array(self.wrench, dtype=np.float64)
        stiffness = np.array(self.stiffness, dtype=np.float64)
        if wrench.shape != (6,) or stiffness.shape != (6, 6):
            raise TrackingError(
                f"a model of the contact needs a wrench of 6 numbers and a 6 by 6 stiffness, not "
                f"{wrench.shape} and {stiffness.shape}"
            )
        if not (np.isfinite(wrench).all() and np.isfinite(stiffness).all()):
            raise TrackingError("the model of the contact is not finite")
        if np.abs(wrench).max() > _HEAVIEST or np.abs(stiffness).max() > _STIFFEST:
            raise TrackingError(
                f"the model of the contact has a wrench of {np.abs(wrench).max():.3g} N or a "
                f"stiffness of {np.abs(stiffness).max():.3g} N/m: no tissue is so"
            )
        if not np.allclose(stiffness, stiffness.T, rtol=1e-6, atol=1e-9):
            raise TrackingError("the stiffness of the contact is not symmetric")
        object.__setattr__(self, "wrench", wrench)
        object.__setattr__(self, "stiffness", stiffness)

    @property
    def push(self) -> NDArray[np.float64]:
        """(3,) unit direction in which the tissue pushes the probe; zero without contact."""
        return self._split[0]

    @cached_property
    def _split(
        self,
    ) -> tuple[
        NDArray[np.float64], float, NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]
    ]:
        """The push's direction (3,), N, and how it falls (6,); the rest's wrench (6,) and stiffness
        (6, 6)."""
        force = float(np.linalg.norm(self.wrench[:3]))
        if force == 0.0:
            return np.zeros(3), 0.0, np.zeros(6), np.zeros(6), np.zeros((6, 6))
        direction = self.wrench[:3] / force
        along = np.concatenate([direction, np.zeros(3)])
        slope = self.stiffness @ along
        lacking = max(force / _FARTHEST - float(direction @ slope[:3]), 0.0)
        slope += lacking * along
        shape = slope / float(direction @ slope[:3])
        rest = self.stiffness + lacking * np.outer(along, along) - np.outer(slope, shape)
        return direction, force, slope, self.wrench - force * shape, rest

    def displacement(self, pose: Pose) -> NDArray[np.float64]:
        """(6,) m, rad: of the origin, and the rotation vector, from the model's pose to another."""
        turn = se3.rotation_between(self.pose.orientation, pose.orientation)
        return np.concatenate([pose.position - self.pose.position, turn])

    def energy_at(self, pose: Pose) -> float:
        """J, energy that the tissue returns until the probe is let go, by this model."""
        return self.answer(self.displacement(pose))[0]

    def wrench_at(self, pose: Pose) -> NDArray[np.float64]:
        """(6,) N, N m on the probe at another pose, about its origin there, axes of ``patient``."""
        return self.answer(self.displacement(pose))[1]

    def answer(self, displacement: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """The energy (J) and the wrench (6,) N, N m at a displacement (6,) m, rad."""
        energy, wrench = self._slope(displacement)
        turn = displacement[3:]
        if wrench[3:].any() and turn.any():
            # The energy falls along rotation vectors; a torque works on angular velocities.
            wrench[3:] = np.linalg.solve(se3.left_jacobian(turn).T, wrench[3:])
        return energy, wrench

    def _slope(self, d: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """The energy (J) at a displacement (6,), and how it falls with that (6,)."""
        direction, force, slope, wrench, stiffness = self._split
        if force == 0.0:
            return 0.0, np.zeros(6)
        spring = float(direction @ slope[:3])
        push = force - float(slope @ d)
        if push <= 0.0:
            return 0.0, np.zeros(6)
        fade, fade_slope = _fade(push / force)
        pulled = wrench - stiffness @ d
        # At most what the spring along the push stored, or light contact would end with a kick.
        most = 0.5 * force * force / spring
        part = math.tanh(-0.5 * float((wrench + pulled) @ d) / most)
        rest = most * part
        energy = 0.5 * push * push / spring + fade * rest
        answer = (push / spring + fade_slope / force * rest) * slope
        answer += fade * (1.0 - part * part) * pulled
        return energy, answer


def _fade(push: float) -> tuple[float, float]:
    """The factor of the rest of the energy at a fraction of the push, and its slope."""
    x = push / _FADING
    if x >= 1.0:
        return 1.0, 0.0
    return x * x * (3.0 - 2.0 * x), 6.0 * x * (1.0 - x) / _FADING


class SecantStiffness:
    """The stiffness along the push, by the secant between two poses.

    It is for solvers that know no stiffness of their own. A few poses do not determine the
    stiffness across the push or against turns: so that is zero.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Begin anew, as after the contact was lost."""
        self._spring = 0.0  # N/m
        self._last: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None

    def at(self, pose: Pose, wrench: NDArray[np.float64]) -> NDArray[np.float64]:
        """The stiffness (6, 6) at the next pose of the probe.

        Args:
            pose: in ``patient``.
            wrench: (6,) N, N m, on the probe, about its origin, axes of ``patient``.
        """
        stiffness = np.zeros((6, 6))
        force = wrench[:3]
        size = float(np.linalg.norm(force))
        if size == 0.0:
            self.forget()
            return stiffness
        push = force / size
        if self._last is None:
            self._last = pose.position, force
        else:
            distance = float((pose.position - self._last[0]) @ push)
            if abs(distance) >= _NEAR:
                spring = -float((force - self._last[1]) @ push) / distance
                spring = min(max(spring, 0.0), _STIFFEST_SECANT)
                self._spring = 0.5 * (self._spring or spring) + 0.5 * spring
                self._last = pose.position, force
        stiffness[:3, :3] = self._spring * np.outer(push, push)
        return stiffness
