"""A gate that refuses poses which a probe cannot have reached in the time.

>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tracking.settings import GateSettings
>>> from us_sim.tracking.measurement import Measurement
>>> from us_sim.tracking.outlier_gate import OutlierGate
>>> gate = OutlierGate(GateSettings(maximum_speed="1 m/s", jump="5 mm", accept_after=3))
>>> [gate.judge_measurement(Measurement(k * 10_000_000, Pose([x, 0, 0]))).value
...  for k, x in enumerate([0.0, 0.5, 0.01, 0.2, 0.2, 0.2])]
['believed', 'refused', 'believed', 'refused', 'refused', 'new place']
"""

from __future__ import annotations

from enum import Enum
from math import degrees, hypot, sqrt

import numpy as np

from us_sim.geometry.se3 import rotation_between
from us_sim.tracking.measurement import Measurement
from us_sim.tracking.settings import GateSettings

_DIAGONAL = np.diag_indices(6)
_LIMIT = 38.26  # of chi-square with six degrees of freedom: one right pose in a million is more


class Verdict(Enum):
    """Judgement of the gate on a measurement."""

    BELIEVED = "believed"
    REFUSED = "refused"
    NEW_PLACE = "new place"  # believed, but not as a motion from where the probe was


class OutlierGate:
    """Compares each measurement with the newest believed one.

    Where both have a covariance it compares by Mahalanobis' distance (chi-square with six degrees
    of freedom); without noise, the fastest probe allowed would be just at the limit. Otherwise it
    compares by the limits on speed, plus the settings' jumps for the noise.
    No filter is asked what it expects: a hand that starts to move is quicker than its filter, and
    a fit's covariance is often too small to be all that a gate allows.

    Refused measurements in a row of which each is within the speed limits of the one before are
    the new place after so many of them: the probe did move fast, or was registered anew. As long
    as fewer were believed, one more than these is enough, since the first of all may be wrong.

    While measurements come and are refused, the time in which the probe may have moved is at most
    that of so many of them: else a stream of nonsense would be believed now and then.
    """

    def __init__(self, settings: GateSettings) -> None:
        self._settings = settings
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next measurement is believed."""
        self._believed: Measurement | None = None
        self._refused: Measurement | None = None  # the newest of a row
        self._row = 0
        self._support = 0  # how many have been believed at this place
        self.reason = ""

    def judge_measurement(self, measurement: Measurement) -> Verdict:
        """Judge a measurement newer than any before; if it is refused, `reason` says why."""
        self.reason = self._doubt(measurement)
        verdict = Verdict.BELIEVED
        if self.reason:
            before = self._refused
            agrees = before is not None and not self._too_fast(
                before, measurement, 1e-9 * (measurement.stamp - before.stamp)
            )
            self._row = self._row + 1 if agrees else 1
            self._refused = measurement
            if self._row < min(self._settings.accept_after, self._support + 1):
                return Verdict.REFUSED
            verdict, self._support = Verdict.NEW_PLACE, self._row - 1
        self._support += 1
        self._believed, self._refused, self._row = measurement, None, 0
        return verdict

    def _doubt(self, measurement: Measurement) -> str:
        """Return the reason why a measurement is not believed; "" if it is."""
        before = self._believed
        if before is None:
            return ""
        nanoseconds = measurement.stamp - before.stamp
        if self._refused is not None:
            newest = measurement.stamp - self._refused.stamp
            nanoseconds = min(nanoseconds, self._settings.accept_after * newest)
        step = 1e-9 * nanoseconds
        if before.covariance is None or measurement.covariance is None:
            return self._too_fast(before, measurement, step)
        settings = self._settings
        pose = measurement.pose
        turn = rotation_between(before.pose.orientation, pose.orientation)
        difference = np.concatenate([pose.position - before.pose.position, turn])
        covariance = before.covariance + measurement.covariance
        speeds = [settings.maximum_speed] * 3 + [settings.maximum_angular_speed] * 3
        covariance[_DIAGONAL] += np.square(speeds) * (2.0 * step * step / _LIMIT)
        distance = float(difference @ np.linalg.solve(covariance, difference))
        if 0.0 <= distance <= _LIMIT:
            return ""
        return (
            f"the pose is {1e3 * hypot(*difference[:3]):.1f} mm and "
            f"{degrees(hypot(*difference[3:])):.1f}° from the one before: "
            f"Mahalanobis distance {sqrt(max(distance, 0.0)):.1f}, the limit is "
            f"{sqrt(_LIMIT):.1f}"
        )

    def _too_fast(self, before: Measurement, measurement: Measurement, step: float) -> str:
        """Return why a probe cannot come from one pose to another in a time (s); "" if it can."""
        settings, elapsed = self._settings, 1e-6 * (measurement.stamp - before.stamp)
        distance = hypot(*(measurement.pose.position - before.pose.position))
        limit = settings.jump + settings.maximum_speed * step
        if distance > limit:
            return (
                f"the pose is {1e3 * distance:.1f} mm from the one {elapsed:.1f} ms before, where "
                f"{1e3 * limit:.1f} mm are believed"
            )
        turn = hypot(*rotation_between(before.pose.orientation, measurement.pose.orientation))
        limit = settings.rotation_jump + settings.maximum_angular_speed * step
        if turn > limit:
            return (
                f"the pose is turned {degrees(turn):.1f}° from the one {elapsed:.1f} ms before, "
                f"where {degrees(limit):.1f}° are believed"
            )
        return ""
