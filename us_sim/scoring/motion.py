"""Metrics of a tracked motion, as PerkTutor defines them, and jerk after Hogan and Sternad.

Sources: Ungi et al., "Perk Tutor: an open-source training platform for ultrasound-guided needle
insertions", IEEE Trans. Biomed. Eng. 59 (2012), and its code, github.com/PerkTutor; Hogan and
Sternad, "Sensitivity of smoothness measures to movement duration, amplitude, and arrests", J. Motor
Behavior 41 (2009).

A step is the way from one sample to the next. It counts as being where its end is, as PerkTutor's
`Path in Tissue` and `Time in Tissue` have it.

>>> from us_sim.scoring.motion import Motion
>>> motion = Motion([0.0, 1.0, 2.0], [[0, 0, 0], [3, 0, 0], [3, 4, 0]], [[0, 0, 0, 1]] * 3)
>>> motion.steps.tolist(), motion.speeds.tolist()
([1.0, 1.0], [3.0, 4.0])
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from us_sim.errors import ScoreError

ACTION_SPEED = 0.05  # m/s, of PerkTutor's translational actions
ACTION_TURN = np.deg2rad(50.0)  # rad/s, of its rotational actions
ACTION_PAUSE = 0.2  # s; what is shorter begins or ends no action

_Array = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """Poses over time; samples whose time is not later than the last one's are left out.

    Raises:
        ScoreError: fewer than two samples are left, or the arrays do not fit or are not finite.
    """

    times: _Array  # (K,) s
    positions: _Array  # (K, 3) m
    orientations: _Array  # (K, 4) quaternions x, y, z, w; of any length but 0

    def __post_init__(self) -> None:
        times, positions, orientations = (
            np.asarray(each, float) for each in (self.times, self.positions, self.orientations)
        )
        count = len(times)
        if positions.shape != (count, 3) or orientations.shape != (count, 4):
            raise ScoreError(f"{count} times need as many positions (K, 3) and orientations (K, 4)")
        norms = np.linalg.norm(orientations, axis=1, keepdims=True)
        if not all(np.isfinite(each).all() for each in (times, positions, norms)) or 0 in norms:
            raise ScoreError("a pose is not finite or has no orientation: leave it out")
        later = np.r_[True, times[1:] > np.maximum.accumulate(times)[:-1]][:count]
        if np.count_nonzero(later) < 2:
            raise ScoreError("a motion needs two poses with different times")
        object.__setattr__(self, "times", times[later])
        object.__setattr__(self, "positions", positions[later])
        object.__setattr__(self, "orientations", (orientations / norms)[later])

    def __len__(self) -> int:
        return len(self.times)

    @cached_property
    def steps(self) -> _Array:
        """(K-1,) s."""
        return np.diff(self.times)

    @cached_property
    def velocities(self) -> _Array:
        """(K-1, 3) m/s, of the steps."""
        return np.diff(self.positions, axis=0) / self.steps[:, None]

    @cached_property
    def speeds(self) -> _Array:
        """(K-1,) m/s, of the steps. PerkTutor's translational actions take the origin's instead."""
        return np.asarray(np.linalg.norm(self.velocities, axis=1))

    @cached_property
    def angular_speeds(self) -> _Array:
        """(K-1,) rad/s, of the shorter turn of each step."""
        a, b = self.orientations[:-1], self.orientations[1:]
        apart = np.minimum(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
        return np.asarray(4.0 * np.arcsin(np.clip(0.5 * apart, 0.0, 1.0)) / self.steps)

    @cached_property
    def accelerations(self) -> _Array:
        """(K-2, 3) m/s², by backward differences."""
        return np.diff(self.velocities, axis=0) / self.steps[1:, None]

    @cached_property
    def squared_jerks(self) -> _Array:
        """(K-3,) m²/s⁵, squared jerk of each step times its length, by backward differences."""
        steps = self.steps[2:]
        jerk = np.diff(self.accelerations, axis=0) / steps[:, None]
        return np.asarray((jerk**2).sum(axis=1) * steps)

    def compute_swept_area(
        self, ends: ArrayLike, where: ArrayLike | None = None, facing: _Array | None = None
    ) -> float:
        """Area m² that a line sweeps which leads from each position to an end (K, 3) m.

        Two triangles a step, as PerkTutor's `Tissue Damage` has of a needle; only steps both of
        whose samples are true count. With unit vectors ``facing`` (K, 3), their projection across
        them.
        """
        near, far = self.positions, np.asarray(ends, float)
        inside = np.ones(len(self), bool) if where is None else np.asarray(where, bool)
        area = np.zeros(len(self) - 1)
        for a, b, c in ((near[1:], far[1:], near[:-1]), (far[1:], near[:-1], far[:-1])):
            normal = 0.5 * np.cross(b - a, c - a)
            if facing is None:
                area += np.linalg.norm(normal, axis=1)
            else:
                area += np.abs((normal * facing[1:]).sum(axis=1))
        return float(area[inside[1:] & inside[:-1]].sum())

    def compute_face_area(self, width: float, where: ArrayLike | None = None) -> float:
        """Area m² of the skin over which a probe's face of this width (m, along x) slides."""
        rotation = Rotation.from_quat(self.orientations)
        half = 0.5 * width * rotation.apply([1.0, 0.0, 0.0])
        side = Motion(self.times, self.positions - half, self.orientations)
        return side.compute_swept_area(
            self.positions + half, where, rotation.apply([0.0, 0.0, 1.0])
        )


class ActionCounter:
    """Number of actions of a motion that comes in pieces.

    A change counts once it has lasted longer than the pause.
    """

    def __init__(self) -> None:
        self.count = 0
        self._is_acting = False
        self._since: float | None = None  # s

    def add_steps(self, times: _Array, is_fast: NDArray[np.bool_], begin: float) -> ActionCounter:
        """Take the ends (K,) s of steps, the begin of the first, and whether each was fast."""
        since = begin if self._since is None else self._since
        for time, fast in zip(times.tolist(), is_fast.tolist(), strict=True):
            if fast == self._is_acting:
                since = time
            elif time - since > ACTION_PAUSE:
                self._is_acting, since = fast, time
                self.count += fast
        self._since = since
        return self
