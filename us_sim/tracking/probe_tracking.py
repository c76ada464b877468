"""The probe's poses from a device's measurements: registered, checked, filtered."""

from __future__ import annotations

import dataclasses
from collections import Counter

from us_sim.geometry.pose import Pose, multiply_quaternions
from us_sim.geometry.se3 import adjoint
from us_sim.tracking.filters import PoseFilter
from us_sim.tracking.measurement import Measurement, TrackingState
from us_sim.tracking.outlier_gate import OutlierGate, Verdict

RESTART_NS = 1_000_000_000
"""A stamp that jumps back by more is a restarted source, not a late measurement."""


class ProbeTracking:
    """Takes a device's measurements and gives the probe's, each once and with its own stamp.

    Args:
        registration: the device's frame in ``patient``.
        calibration: the probe in the tracked body's frame.
        filter: smooths the probe's poses in ``patient``.
        gate: refuses some of them; None believes all.
        time_offset: s that are added to the device's stamps.
        coast_for: s without a pose after which the state is *coasting*.
        lost_after: s without a pose after which it is *lost*, and the next one starts anew.

    Examples:
        >>> from us_sim.geometry.pose import Pose
        >>> from us_sim.tracking.settings import GateSettings
        >>> from us_sim.tracking.measurement import Measurement
        >>> from us_sim.tracking.outlier_gate import OutlierGate
        >>> from us_sim.tracking.filters import create_filter
        >>> camera_above = Pose([0.0, 0.0, -0.4])  # and looks along z, into the tissue
        >>> marker_on_grip = Pose([0.0, 0.0, 0.12])  # the probe's face is 120 mm from it
        >>> filter, gate = create_filter("none"), OutlierGate(GateSettings())
        >>> tracking = ProbeTracking(camera_above, marker_on_grip, filter, gate, time_offset=-0.02)
        >>> seen = Measurement(5_000_000_000, Pose([0.0, 0.0, 0.29]))
        >>> probe = tracking.process_measurement(seen, 5_010_000_000)
        >>> probe.stamp, probe.pose.position.round(6).tolist()
        (4980000000, [0.0, 0.0, 0.01])
        >>> tracking.find_state(5_010_000_000).value
        'tracked'
        >>> leap = Measurement(5_010_000_000, Pose([0.0, 0.0, 0.9]))
        >>> tracking.process_measurement(leap, 5_020_000_000)
        >>> tracking.last_problem
        'the pose is 610.0 mm from the one 10.0 ms before, where 25.0 mm are believed'
    """

    def __init__(
        self,
        registration: Pose,
        calibration: Pose,
        filter: PoseFilter,
        gate: OutlierGate | None = None,
        *,
        time_offset: float = 0.0,
        coast_for: float = 0.3,
        lost_after: float = 1.0,
    ) -> None:
        self._registration, self._calibration = registration, calibration
        self._to_patient = registration.rotation
        self.filter, self._gate = filter, gate
        self._time_offset = round(1e9 * time_offset)
        self._coasts = round(1e9 * coast_for)
        self._seen: int | None = None  # ns, when the newest that was believed arrived
        self._longest_gap = round(1e9 * lost_after)
        self._newest: int | None = None  # ns, stamp of the newest measurement in order
        self._believed: int | None = None  # ns, stamp of the newest that was believed
        self.refused: Counter[str] = Counter()
        self.restarts: Counter[str] = Counter()
        self.last_refused = self.last_problem = ""

    def reset(self) -> None:
        """Forget all poses, and keep the counts."""
        self._newest = self._believed = self._seen = None
        self._start_anew()

    def find_state(self, now_ns: int) -> TrackingState:
        """Return the state of tracking at a time (ns) of the clock of `process_measurement`.

        Where the clock was set back, the last pose's age counts anew.
        """
        if self._seen is None:
            return TrackingState.WAITING
        self._seen = min(self._seen, now_ns)
        age = now_ns - self._seen
        if age < self._coasts:
            return TrackingState.TRACKED
        return TrackingState.COASTING if age < self._longest_gap else TrackingState.LOST

    def count_refusal(self, kind: str, sentence: str) -> None:
        """Count a measurement that cannot be used, also one that never became a pose."""
        self.refused[kind] += 1
        self.last_refused, self.last_problem = kind, sentence

    def process_measurement(self, measurement: Measurement, now_ns: int) -> Measurement | None:
        """Return the probe in ``patient``, or None where the measurement is refused.

        Then `last_problem` has the reason, and `last_refused` the kind under which it is counted in
        `refused`: "order" (not newer than one before) or "gate".

        Args:
            measurement: the tracked body in the device's frame, or the probe in ``patient``.
            now_ns: time of its arrival.
        """
        if not self._in_order(measurement.stamp):
            self.count_refusal("order", "the pose is not newer than the one before it")
            return None
        probe = self._of_probe(measurement)
        found = self._believed is not None and probe.stamp - self._believed > self._longest_gap
        if found:
            self.filter.reset()
        if self._gate is not None:
            verdict = self._gate.judge_measurement(probe)
            if verdict is Verdict.REFUSED:
                self.count_refusal("gate", self._gate.reason)
                return None
            if verdict is Verdict.NEW_PLACE:
                self.restarts["place"] += 1
                self.filter.reset()
        if found:
            self.restarts["gap"] += 1
        self._believed = probe.stamp
        self._seen = now_ns
        return self.filter.update(probe)

    def _in_order(self, stamp: int) -> bool:
        """Return whether a stamp is newer, or so much older that the source was started again."""
        if self._newest is not None:
            step = stamp - self._newest
            if -RESTART_NS < step <= 0:
                return False
            if step <= 0:
                self.restarts["stamp"] += 1
                self._believed = None
                self._start_anew()
            elif step > self._longest_gap:
                self._start_anew()
        self._newest = stamp
        return True

    def _start_anew(self) -> None:
        self.filter.reset()
        if self._gate is not None:
            self._gate.reset()

    def _of_probe(self, measurement: Measurement) -> Measurement:
        """Return the probe in ``patient`` as measured, with the covariance there."""
        if measurement.of_probe:
            return measurement
        body = measurement.pose
        lever = body.rotation @ self._calibration.position
        turned = multiply_quaternions(self._registration.orientation, body.orientation)
        pose = Pose(
            self._registration.position + self._to_patient @ (body.position + lever),
            multiply_quaternions(turned, self._calibration.orientation),
        )
        covariance = measurement.covariance
        if covariance is not None and not covariance.any():
            covariance = None  # ROS's way to say that nothing is known
        if covariance is not None:
            # From the body's origin to the probe's, and from the device's axes to the patient's.
            moved = adjoint(Pose(-(self._to_patient @ lever), self._registration.orientation))
            covariance = moved @ covariance @ moved.T
            covariance = 0.5 * (covariance + covariance.T)
        return dataclasses.replace(
            measurement,
            stamp=measurement.stamp + self._time_offset,
            pose=pose,
            covariance=covariance,
        )
