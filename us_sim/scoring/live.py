"""A scan that is scored while it is done, at a cost that does not grow with it.

Samples that later ones cannot change any more are added to the tally and the attempt once; only
those of the last seconds are added anew each time, to a copy.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from copy import deepcopy
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import ScoreError
from us_sim.geometry.pose import Pose
from us_sim.scoring.exercise import Attempt, Exercise, Fault, Step
from us_sim.scoring.lumen import LumenMeter, find_lumen_labels, find_vessels
from us_sim.scoring.metrics import Force, Metric, Scan, Tally
from us_sim.scoring.motion import Motion
from us_sim.scoring.settings import ScoreSettings
from us_sim.slicing.b_mode import BMode
from us_sim.volume.volume import Volume

_LATE = 2.0  # s after its pose, from which on a force or an image that comes is passed over


class Score(NamedTuple):
    """The metrics of a scan, and the progress of an attempt."""

    metrics: list[Metric]
    steps: Sequence[Step] = ()
    faults: Sequence[Fault] = ()
    seconds: float | None = None  # from the first touch to the end, or so far; None before
    has_ended: bool = False  # all was done, or the time is over
    was_in_air: bool = True  # the probe, since the scene was loaded; nothing counts before


class LiveScan:
    """A scan that grows while it is done, its metrics, and the steps of an exercise.

    Args:
        volume: its vessels are measured, if it has labels.
        scanner: of that volume at rest, with the probe that scans.
        exercise: that the learner does.
        limits: of the metrics.

    Raises:
        ScoreError: the volume lacks a vessel that the exercise needs.
    """

    def __init__(
        self,
        volume: Volume,
        scanner: BMode,
        exercise: Exercise | None = None,
        limits: ScoreSettings | None = None,
    ) -> None:
        self.lines, self._thrombi = find_vessels(volume)
        labels = find_lumen_labels(volume.label_names)
        self._lumens = {name: labels[name] for name in self.lines}
        self._scanner, self._exercise, self._limits = scanner, exercise, limits
        self._is_felt = False  # a force has been told
        self.clear()

    def clear(self) -> None:
        """Begin anew."""
        self._pose_times: list[float] = []
        self._poses: list[Pose] = []
        self._force_times: list[float] = []
        self._newtons: list[float] = []
        self._meter = LumenMeter(self._lumens, self._scanner, lines=self.lines)
        self._settled = -np.inf  # s, until when samples are in the tally and the attempt
        self._final: Score | None = None  # of an attempt that has ended: nothing more counts
        self._tally = Tally(self._limits)
        exercise = self._exercise
        self._attempt = exercise.begin_attempt(self.lines) if exercise is not None else None

    def add_pose(self, time: float, pose: Pose) -> None:
        """Add a pose of the probe at a time (s); one that is not after those before is ignored."""
        if self._is_next(self._pose_times, time):
            self._pose_times.append(time)
            self._poses.append(pose)

    def add_force(self, time: float, force: NDArray[np.float64]) -> None:
        """Add the force (3,) N on the probe, as `add_pose` a pose."""
        self._is_felt = True
        if self._is_next(self._force_times, time):
            self._force_times.append(time)
            self._newtons.append(float(np.linalg.norm(force)))

    def add_labels(self, time: float, pose: Pose, labels: NDArray[np.uint8]) -> None:
        """Add the labels (rows, columns) of an image, as `add_pose` a pose."""
        if self._lumens and self._is_next(self._meter.times, time):
            self._meter.add_image(time, pose, labels)

    def set_answers(self, points: Sequence[str], thrombus: str) -> None:
        """Set the learner's answers so far, see `Attempt.set_answers`."""
        if self._attempt is None:
            raise ScoreError("answers: no exercise is followed")
        self.compute_score()  # of what has come since
        self._attempt.set_answers(points, thrombus, max(self._pose_times, default=0.0))

    def _is_next(self, times: list[float], time: float) -> bool:
        return self._final is None and time > max([self._settled, *times[-1:]])

    def build_scan(self, since: float = -np.inf, until: float = np.inf) -> Scan | None:
        """Return the scan so far, or a piece of it, after a time until another (s).

        It is None before there is a motion, or where the piece has one force and none before it.
        """
        span = _span(self._pose_times, since, until)
        times, poses = self._pose_times[span], self._poses[span]
        if len(times) < 2:
            return None
        positions = np.array([pose.position for pose in poses])
        motion = Motion(np.array(times), positions, np.array([pose.orientation for pose in poses]))
        span, force = _span(self._force_times, since, until), None
        times = self._force_times[span]
        if len(times) > 1:
            force = Force(np.array(times), np.array(self._newtons[span]))
        elif times and times[0] > since and until < np.inf:
            return None
        sections = self._meter.collect_sections(_span(self._meter.times, since, until))
        return Scan(motion, force, sections, self.lines, self._thrombi, since=since)

    def compute_score(self) -> Score | None:
        """Return the score so far; None before there is a motion, and a force if one is told."""
        if self._final is not None or (self._is_felt and not self._force_times):
            return self._final
        until = self._find_end()
        piece = self.build_scan(self._settled, until) if until > self._settled else None
        if piece is not None:
            _add(self._tally, self._attempt, piece)
            self._settled = until
        scan = self.build_scan(self._settled)
        if scan is None:
            return None
        tally, attempt = deepcopy((self._tally, self._attempt))
        _add(tally, attempt, scan)
        metrics = list(tally.list_metrics())
        if attempt is None:
            return Score(metrics)
        begin = attempt.touched or 0.0
        score = Score(
            metrics,
            attempt.list_steps(),
            [fault._replace(time=fault.time - begin) for fault in attempt.faults],
            attempt.compute_duration(),
            attempt.ended is not None,
            attempt.was_in_air,
        )
        if score.has_ended:
            self._final, self._attempt = score, attempt
        return score

    def _find_end(self) -> float:
        """Return the last time (s) after which a piece may begin.

        It is a force's, so that the force at a pose lies between two of one piece; and the image
        before it shows of every vessel that it is in view or not.
        """
        if not self._pose_times:
            return self._settled
        latest = self._pose_times[-1] - _LATE
        times = self._force_times
        if not times or times[-1] <= latest:
            times = self._pose_times
        new = times[bisect_right(times, self._settled) : bisect_right(times, latest)]
        for time in reversed(new):
            image = bisect_right(self._meter.times, time) - 1
            if image < 0 or self._meter.is_settled(image):
                return time
        return self._settled


def _span(times: list[float], since: float, until: float) -> slice:
    """Return the slice of a piece's samples, from the last sample before it on."""
    return slice(max(bisect_right(times, since) - 1, 0), bisect_right(times, until))


def _add(tally: Tally, attempt: Attempt | None, scan: Scan) -> None:
    counted = scan if attempt is None else attempt.add_scan(scan)
    if counted is not None:
        tally.add_scan(counted)
