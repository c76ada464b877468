"""The tissue's answer near a pose of the probe, as an energy whose slope is the wrench.

>>> import numpy as np
>>> from us_sim.pose import Pose
>>> from us_sim.tracking.contact_model import ContactModel
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

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import TrackingError
from us_sim.pose import Pose
from us_sim.tracking import se3

__all__ = ["ContactModel", "SecantStiffness"]

_HEAVIEST, _STIFFEST = 1e5, 1e9
"""N and N/m beyond which a model is not believed."""

_FADING = 0.5
"""Part of the push at the model's pose below which all but the push along it fades."""

_LEVER = 0.03
"""m: a turn by an angle counts as a way of this much times it."""

_FARTHEST = 0.03
"""m: with less stiffness than makes the push end on this way, it ends there all the same."""

_NEAR = 5e-4
"""m: two poses this near tell nothing of the stiffness between them."""


@dataclass(frozen=True, eq=False)
class ContactModel:
    """The wrench on the probe near a pose, from the tissue's last solution.

    With d the displacement of the probe's origin and its rotation vector about the axes of
    ``patient``, the energy is ``-wrench · d + d · stiffness d / 2``. The part of it along the push
    is that of a spring, which ends where it would pull; the rest fades with the push, so that
    nothing is left without it. The wrench is the slope of this one energy: over a closed path
    no work is done.

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
        """J, what the tissue gives back until the probe is let go, as far as the model tells."""
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
        share, share_slope = _share(push / force)
        pulled = wrench - stiffness @ d
        rest = -0.5 * float((wrench + pulled) @ d)
        energy = 0.5 * push * push / spring + share * rest
        answer = push / spring * slope + share * pulled + (share_slope / force * rest) * slope
        return energy, answer


def _share(push: float) -> tuple[float, float]:
    """How much is left of the rest at a part of the push, and the slope of that."""
    x = push / _FADING
    if x >= 1.0:
        return 1.0, 0.0
    return x * x * (3.0 - 2.0 * x), 6.0 * x * (1.0 - x) / _FADING


class SecantStiffness:
    """Mends a stiffness by how the wrench really changed between the poses that came by.

    The change that makes it right along the last motion and is least beside that (the symmetric
    Broyden update of M. J. D. Powell, A new algorithm for unconstrained optimization, 1970). So a
    solver that knows no stiffness gets one, and one that knows it nearly gets it better.
    """

    def __init__(self) -> None:
        self._scale = np.array([1.0, 1.0, 1.0, _LEVER, _LEVER, _LEVER])
        self.forget()

    def forget(self) -> None:
        """Begin anew, as after the contact was lost."""
        self._mend = np.zeros((6, 6))
        self._last: ContactModel | None = None

    def mended(
        self, pose: Pose, wrench: NDArray[np.float64], stiffness: NDArray[np.float64] | None
    ) -> NDArray[np.float64]:
        """The stiffness (6, 6) at a pose of the probe.

        Args:
            pose: in ``patient``.
            wrench: (6,) N, N m, on the probe, about its origin, axes of ``patient``.
            stiffness: (6, 6), what the solver says; None where it says nothing.
        """
        if not wrench.any():
            self.forget()
            return np.zeros((6, 6))
        known = np.zeros((6, 6)) if stiffness is None else stiffness
        here = ContactModel(0, pose, wrench, known)
        if self._last is not None:
            step = self._last.displacement(pose) * self._scale
            length = float(step @ step)
            if length >= _NEAR * _NEAR:
                mean = 0.5 * (known + self._last.stiffness) / np.outer(self._scale, self._scale)
                change = (self._last.wrench - wrench) / self._scale
                missing = change - (mean + self._mend) @ step
                self._mend += (np.outer(missing, step) + np.outer(step, missing)) / length
                self._mend -= (missing @ step) * np.outer(step, step) / length**2
                self._last = here
        else:
            self._last = here
        mended: NDArray[np.float64] = known + self._mend * np.outer(self._scale, self._scale)
        return mended
