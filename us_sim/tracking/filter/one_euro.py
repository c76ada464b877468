"""The One-Euro filter on SE(3): steady where the probe rests, quick where it moves.

>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tracking.filter.settings import OneEuroSettings
>>> from us_sim.tracking.measurement import Measurement
>>> from us_sim.tracking.filter.one_euro import OneEuro
>>> still = OneEuro(OneEuroSettings(minimum_cutoff=1.0, speed_coefficient=0.0))
>>> for k in range(3):
...     filtered = still.update(Measurement(k * 10_000_000, Pose([0.001 * (k == 1), 0.0, 0.0])))
>>> round(1e6 * filtered.pose.position[0].item())  # µm, of a spike of 1 mm a moment ago
56
"""

from __future__ import annotations

import dataclasses
from math import atan, atan2, cos, pi, sin

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import product, rotation_between, rotation_exp
from us_sim.tracking.filter.pose_filter import PoseFilter
from us_sim.tracking.filter.settings import OneEuroSettings
from us_sim.tracking.measurement import Measurement


class OneEuro(PoseFilter):
    """A low-pass filter whose cutoff rises with speed (Casiez, Roussel, Vogel, CHI 2012).

    Position and rotation have a cutoff each, fc = minimum + coefficient · speed, with the speed
    itself low-passed. It is one for all coordinates, so that a motion is filtered alike in whatever
    direction it goes. The rotation is filtered on the manifold: the step towards the measured one
    is taken along the shortest turn. Speeds are differences of measured poses, as in the authors'
    first implementations: the paper's differences to the filtered pose hold the lag as well, which
    makes slow motions look fast.

    Steps may vary. The covariance stays the measurement's, though there is less noise, since the
    filter does not know how far it is behind.
    """

    Settings = OneEuroSettings

    def __init__(self, settings: OneEuroSettings) -> None:
        self._settings = settings
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next measurement is the first."""
        self._measured: Measurement | None = None  # the newest
        self._pose = Pose()  # filtered
        self._velocity = np.zeros(3)  # m/s, low-passed
        self._angular_velocity = np.zeros(3)  # rad/s about the parent's axes, low-passed
        self._step = 0.0  # s, the newest

    def update(self, measurement: Measurement) -> Measurement:
        """The measurement with its pose filtered."""
        pose, before = measurement.pose, self._measured
        if before is None:
            self._pose = pose
        else:
            self._step = step = 1e-9 * (measurement.stamp - before.stamp)
            alpha = _alpha(self._settings.derivative_cutoff, step)
            velocity = (pose.position - before.pose.position) / step
            self._velocity = self._velocity + alpha * (velocity - self._velocity)
            turn = rotation_between(before.pose.orientation, pose.orientation) / step
            self._angular_velocity = self._angular_velocity + alpha * (
                turn - self._angular_velocity
            )
            self._pose = self._towards(pose)
        self._measured = measurement
        return dataclasses.replace(measurement, pose=self._pose)

    def _towards(self, pose: Pose) -> Pose:
        """The filtered pose after a step towards a measured one."""
        position, orientation = self._pose.position, self._pose.orientation
        alpha = _alpha(self._cutoff, self._step)
        turn = _alpha(self._rotation_cutoff, self._step) * rotation_between(
            orientation, pose.orientation
        )
        return Pose(
            position + alpha * (pose.position - position),
            product(rotation_exp(turn), orientation),
        )

    @property
    def _cutoff(self) -> float:
        """Hz, of the position."""
        settings = self._settings
        return settings.minimum_cutoff + settings.speed_coefficient * _norm(self._velocity)

    @property
    def _rotation_cutoff(self) -> float:
        """Hz, of the rotation."""
        settings = self._settings
        speed = _norm(self._angular_velocity)
        return settings.rotation_minimum_cutoff + settings.rotation_speed_coefficient * speed

    @property
    def lag(self) -> float:
        """s, behind a uniform motion: the filter's time constant 1 / (2 pi fc), exactly.

        Exponential smoothing with the factor a and the step T is T (1 - a) / a behind a ramp; with
        the factor of Casiez et al. (eq. 5) that is the time constant, whatever the step is.
        """
        return 1.0 / (2.0 * pi * self._cutoff)

    @property
    def rotation_lag(self) -> float:
        """s, behind a uniform turn: see `lag`."""
        return 1.0 / (2.0 * pi * self._rotation_cutoff)

    def lag_at(self, frequency: float) -> float:
        """s, the phase delay of a / (1 - (1 - a) / z) at z = exp(2 pi i f T)."""
        angular = 2.0 * pi * frequency
        if not self._step:
            return atan(angular * self.lag) / angular
        angle, memory = angular * self._step, 1.0 - _alpha(self._cutoff, self._step)
        return atan2(memory * sin(angle), 1.0 - memory * cos(angle)) / angular


def _alpha(cutoff: float, step: float) -> float:
    """The smoothing factor for a cutoff (Hz) and a step (s): Casiez et al. (2012), eq. 5."""
    return 1.0 / (1.0 + 1.0 / (2.0 * pi * cutoff * step))


def _norm(vector: NDArray[np.float64]) -> float:
    return float(np.sqrt(vector @ vector))
