"""A constant-velocity Kalman filter on SE(3): no lag behind a uniform motion.

>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tracking.filter.settings import KalmanSettings
>>> from us_sim.tracking.filter.kalman import ConstantVelocityKalman
>>> from us_sim.tracking.measurement import Measurement
>>> kalman = ConstantVelocityKalman(KalmanSettings())
>>> for k in range(100):  # 0.1 m/s
...     filtered = kalman.update(Measurement(k * 10_000_000, Pose([0.001 * k, 0.0, 0.0])))
>>> round(1e6 * (filtered.pose.position[0] - 0.099).item())  # µm behind
0
"""

from __future__ import annotations

from cmath import exp, phase
from math import pi

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import TrackingError
from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import (
    cross_matrix,
    left_jacobian,
    product,
    rotation_between,
    rotation_exp,
)
from us_sim.tracking.filter.pose_filter import PoseFilter
from us_sim.tracking.filter.settings import KalmanSettings
from us_sim.tracking.measurement import Measurement

# The speed of the first pose is not known: one standard deviation of it.
_INITIAL_SPEED = 0.5  # m/s
_INITIAL_ANGULAR_SPEED = 5.0  # rad/s

_Place = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Position (3,) m and orientation (4,) x, y, z, w: a pose between two steps."""

_IDENTITY = np.eye(12)
_POSE, _VELOCITY = slice(0, 6), slice(6, 12)


class ConstantVelocityKalman(PoseFilter):
    """An error-state Kalman filter of pose, velocity and angular velocity (Solà 2017, chapter 6).

    The error (12,) is that of position (m), rotation (rad, exp(error) times the estimate, so about
    the parent's axes), velocity and angular velocity, both along the parent's axes. That is the
    convention of a measurement's covariance, which therefore is used as it is. White accelerations
    of the settings' spectral density drive it; steps may vary.

    A filtered measurement carries the estimate's covariance.
    """

    Settings = KalmanSettings

    def __init__(self, settings: KalmanSettings) -> None:
        self._settings = settings
        variances = [settings.position_deviation**2] * 3 + [settings.rotation_deviation**2] * 3
        self._usual_noise = np.diag(variances)
        self._density = np.diag(
            [settings.acceleration**2] * 3 + [settings.angular_acceleration**2] * 3
        )
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next measurement is the first."""
        self._stamp: int | None = None
        self._place: _Place = (np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))
        self._velocity = np.zeros(6)  # m/s, then rad/s
        self._covariance: NDArray[np.float64] = np.zeros((12, 12))
        self._step = 0.0  # s, the newest
        self._gain = np.zeros((12, 6))  # the newest

    def update(self, measurement: Measurement) -> Measurement:
        """The measurement with its pose filtered, and the covariance of that."""
        noise = self._noise(measurement)
        if self._stamp is None:
            self._start(measurement, noise)
        else:
            self._step = 1e-9 * (measurement.stamp - self._stamp)
            self._correct(measurement, noise)
        self._stamp = measurement.stamp
        pose = Pose(*self._place)
        self._place = pose.position, pose.orientation  # of norm 1 again
        return Measurement(
            measurement.stamp, pose, self._covariance[_POSE, _POSE], measurement.error
        )

    def _noise(self, measurement: Measurement) -> NDArray[np.float64]:
        return self._usual_noise if measurement.covariance is None else measurement.covariance

    def _start(self, measurement: Measurement, noise: NDArray[np.float64]) -> None:
        self._place = measurement.pose.position, measurement.pose.orientation
        self._covariance[_POSE, _POSE] = noise
        speeds = [_INITIAL_SPEED**2] * 3 + [_INITIAL_ANGULAR_SPEED**2] * 3
        self._covariance[_VELOCITY, _VELOCITY] = np.diag(speeds)

    def predicted(self, stamp: int) -> tuple[_Place, NDArray[np.float64]]:
        """Where the pose is at a later stamp if its velocity stays, and the error's covariance.

        Returns:
            position (3,) m and orientation (4,), and (12, 12) as in the class.

        Raises:
            TrackingError: there was no measurement yet.
        """
        if self._stamp is None:
            raise TrackingError("a Kalman filter predicts nothing before its first measurement")
        step = 1e-9 * (stamp - self._stamp)
        turn = step * self._velocity[3:]
        position = self._place[0] + step * self._velocity[:3]
        place = position, product(rotation_exp(turn), self._place[1])
        jacobian = left_jacobian(turn)
        transition = _IDENTITY.copy()
        transition[0:3, 6:9] = step * _IDENTITY[:3, :3]
        transition[3:6, 3:6] += cross_matrix(turn) @ jacobian  # now the rotation by the turn
        transition[3:6, 9:12] = step * jacobian
        covariance = transition @ self._covariance @ transition.T
        # White acceleration over a step (Bar-Shalom, Li, Kirubarajan 2001, eq. 6.2.2-4).
        covariance[_POSE, _POSE] += self._density * (step**3 / 3.0)
        covariance[_POSE, _VELOCITY] += self._density * (step**2 / 2.0)
        covariance[_VELOCITY, _POSE] += self._density * (step**2 / 2.0)
        covariance[_VELOCITY, _VELOCITY] += self._density * step
        return place, covariance

    def _correct(self, measurement: Measurement, noise: NDArray[np.float64]) -> None:
        place, covariance = self.predicted(measurement.stamp)
        gain: NDArray[np.float64] = np.linalg.solve(
            covariance[_POSE, _POSE] + noise, covariance[_POSE]
        ).T.astype(np.float64, copy=False)
        correction = gain @ _difference(place, measurement.pose)
        self._place = (
            place[0] + correction[:3],
            product(rotation_exp(correction[3:6]), place[1]),
        )
        self._velocity = self._velocity + correction[_VELOCITY]
        # Joseph's form stays positive however sure a measurement is of itself.
        kept = _IDENTITY.copy()
        kept[:, _POSE] -= gain
        corrected = kept @ covariance @ kept.T + gain @ noise @ gain.T
        self._covariance = 0.5 * (corrected + corrected.T)
        self._gain = gain

    @property
    def lag(self) -> float:
        """s, none: once it knows the velocity the filter is not behind a uniform motion.

        It settles as an alpha-beta tracker, whose error for a ramp is zero (Kalata 1984); see
        `lag_at` for motions that change.
        """
        return 0.0

    @property
    def rotation_lag(self) -> float:
        """s, none: see `lag`."""
        return 0.0

    def lag_at(self, frequency: float) -> float:
        """s, the phase delay of the alpha-beta tracker that the filter is with its newest gain.

        With z = exp(2 pi i f T) and gains a of the position and b / T of the velocity it is that
        of (a + (b - a) / z) / (1 - (2 - a - b) / z + (1 - a) / z²). It may be negative: a filter
        that extrapolates is ahead of slow sways by a little.
        """
        if not self._step:
            return 0.0
        step = self._step
        a = float(np.trace(self._gain[0:3, 0:3])) / 3.0
        b = step * float(np.trace(self._gain[6:9, 0:3])) / 3.0
        late = exp(-2j * pi * frequency * step)  # 1 / z
        response = (a + (b - a) * late) / (1.0 - (2.0 - a - b) * late + (1.0 - a) * late**2)
        return -phase(response) / (2.0 * pi * frequency)


def _difference(expected: _Place, measured: Pose) -> NDArray[np.float64]:
    """(6,) m, rad, from one pose to another, as a measurement's covariance has them."""
    return np.concatenate(
        [
            measured.position - expected[0],
            rotation_between(expected[1], measured.orientation),
        ]
    )
