"""Filters of poses: none, the One-Euro filter, and a constant-velocity Kalman filter on SE(3)."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from math import hypot, pi

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import TrackingError
from us_sim.geometry.pose import Pose, multiply_quaternions
from us_sim.geometry.se3 import cross_matrix, left_jacobian, rotation_between, rotation_exp
from us_sim.settings.registry import FILTERS
from us_sim.settings.setting import Settings
from us_sim.tracking.measurement import Measurement
from us_sim.tracking.settings import KalmanSettings, OneEuroSettings


class PoseFilter(ABC):
    """Takes measurements one by one, each newer than the one before, and returns better ones.

    A filtered measurement keeps its stamp: it is the filter's answer for that very moment.
    """

    @abstractmethod
    def update(self, measurement: Measurement) -> Measurement:
        """Filter the measurement's pose."""

    @abstractmethod
    def reset(self) -> None:
        """Forget everything: the next measurement is the first."""

    @property
    @abstractmethod
    def lag(self) -> float:
        """Time (s) by which the position, as the filter is set now, is behind a uniform motion."""


class Unfiltered(PoseFilter):
    """Poses as they were measured."""

    lag = 0.0

    def __init__(self, _: Settings | None = None) -> None:
        """Ignore the settings."""

    def update(self, measurement: Measurement) -> Measurement:
        """Return the measurement itself."""
        return measurement

    def reset(self) -> None:
        """Do nothing: there is no state."""


def create_filter(name: str, settings: Settings | None = None) -> PoseFilter:
    """Create the filter of that name; no other one is imported.

    Raises:
        TrackingError: there is no filter of that name.

    Examples:
        >>> from us_sim.tracking.measurement import Measurement
        >>> kalman = create_filter("kalman")
        >>> for k in range(100):  # 0.1 m/s
        ...     filtered = kalman.update(Measurement(k * 10_000_000, Pose([0.001 * k, 0.0, 0.0])))
        >>> round(1e6 * (filtered.pose.position[0] - 0.099).item())  # µm behind
        0
    """
    made: PoseFilter = FILTERS.load(name)(settings or FILTERS.load_settings(name)())
    return made


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

    def update(self, measurement: Measurement) -> Measurement:
        """Filter the measurement's pose."""
        pose, before = measurement.pose, self._measured
        if before is None:
            self._pose = pose
        else:
            step = 1e-9 * (measurement.stamp - before.stamp)
            alpha = _alpha(self._settings.derivative_cutoff, step)
            velocity = (pose.position - before.pose.position) / step
            self._velocity = self._velocity + alpha * (velocity - self._velocity)
            turn = rotation_between(before.pose.orientation, pose.orientation) / step
            self._angular_velocity = self._angular_velocity + alpha * (
                turn - self._angular_velocity
            )
            position, orientation = self._pose.position, self._pose.orientation
            position = position + _alpha(self._cutoff, step) * (pose.position - position)
            turn = rotation_between(orientation, pose.orientation)
            speed = hypot(*self._angular_velocity)
            cutoff = self._settings.rotation_minimum_cutoff
            cutoff += self._settings.rotation_speed_coefficient * speed
            turn = _alpha(cutoff, step) * turn
            self._pose = Pose(position, multiply_quaternions(rotation_exp(turn), orientation))
        self._measured = measurement
        return dataclasses.replace(measurement, pose=self._pose)

    @property
    def _cutoff(self) -> float:
        """Hz, of the position."""
        settings = self._settings
        return settings.minimum_cutoff + settings.speed_coefficient * hypot(*self._velocity)

    @property
    def lag(self) -> float:
        """Time (s) behind a uniform motion: the filter's time constant 1 / (2 pi fc), exactly.

        Exponential smoothing with the factor a and the step T is T (1 - a) / a behind a ramp; with
        the factor of Casiez et al. (eq. 5) that is the time constant, whatever the step is.
        """
        return 1.0 / (2.0 * pi * self._cutoff)


def _alpha(cutoff: float, step: float) -> float:
    """Return the smoothing factor of a cutoff (Hz) and a step (s): Casiez et al., eq. 5."""
    return 1.0 / (1.0 + 1.0 / (2.0 * pi * cutoff * step))


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

    def update(self, measurement: Measurement) -> Measurement:
        """Filter the measurement's pose, with the covariance of that."""
        given = measurement.covariance
        noise = self._usual_noise if given is None else given
        if self._stamp is None:
            self._place = measurement.pose.position, measurement.pose.orientation
            self._covariance[_POSE, _POSE] = noise
            speeds = [_INITIAL_SPEED**2] * 3 + [_INITIAL_ANGULAR_SPEED**2] * 3
            self._covariance[_VELOCITY, _VELOCITY] = np.diag(speeds)
        else:
            self._correct(measurement, noise)
        self._stamp = measurement.stamp
        pose = Pose(*self._place)
        self._place = pose.position, pose.orientation  # of norm 1 again
        return Measurement(
            measurement.stamp, pose, self._covariance[_POSE, _POSE], measurement.error
        )

    def predict_pose(self, stamp: int) -> tuple[_Place, NDArray[np.float64]]:
        """Predict the pose at a later stamp if its velocity stays, and the error's covariance.

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
        place = position, multiply_quaternions(rotation_exp(turn), self._place[1])
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
        place, covariance = self.predict_pose(measurement.stamp)
        gain: NDArray[np.float64] = np.linalg.solve(
            covariance[_POSE, _POSE] + noise, covariance[_POSE]
        ).T.astype(np.float64, copy=False)
        turn = rotation_between(place[1], measurement.pose.orientation)
        correction = gain @ np.concatenate([measurement.pose.position - place[0], turn])
        turned = multiply_quaternions(rotation_exp(correction[3:6]), place[1])
        self._place = place[0] + correction[:3], turned
        self._velocity = self._velocity + correction[_VELOCITY]
        # Joseph's form stays positive however sure a measurement is of itself.
        kept = _IDENTITY.copy()
        kept[:, _POSE] -= gain
        corrected = kept @ covariance @ kept.T + gain @ noise @ gain.T
        self._covariance = 0.5 * (corrected + corrected.T)

    @property
    def lag(self) -> float:
        """0 s: once it knows the velocity the filter is not behind a uniform motion.

        It settles as an alpha-beta tracker, whose error for a ramp is zero (Kalata 1984).
        """
        return 0.0
