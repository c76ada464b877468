"""A tracked motion, its speeds and turns, as PerkTutor defines them.

Source: Ungi et al., "Perk Tutor: an open-source training platform for ultrasound-guided needle
insertions", IEEE Trans. Biomed. Eng. 59 (2012), and its code, github.com/PerkTutor.

A step is the way from one sample to the next.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import ScoreError
from us_sim.geometry.pose import Pose

_Array = NDArray[np.float64]


@dataclass(frozen=True)
class Motion:
    """Poses over time, without the samples whose time is not later than that of one before.

    Raises:
        ScoreError: fewer than two samples are left, or the arrays do not fit or are not finite.

    Examples:
        >>> motion = Motion([0.0, 1.0, 2.0], [[0, 0, 0], [3, 0, 0], [3, 4, 0]], [[0, 0, 0, 1]] * 3)
        >>> motion.steps.tolist(), motion.speeds.tolist()
        ([1.0, 1.0], [3.0, 4.0])
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

    def interpolate_positions(self, times: _Array) -> _Array:
        """Return the positions (N, 3) m at times (N,) s; beyond the ends those of the ends."""
        axes = [np.interp(times, self.times, axis) for axis in self.positions.T]
        return np.stack(axes, axis=1)

    def sample_poses(self, times: _Array) -> list[Pose]:
        """Return poses at times (N,) s, turned as the last sample before each."""
        last = np.maximum(np.searchsorted(self.times, times, side="right") - 1, 0)
        return [*map(Pose, self.interpolate_positions(times), self.orientations[last])]

    @cached_property
    def steps(self) -> _Array:
        """(K-1,) s."""
        return np.diff(self.times)

    @cached_property
    def speeds(self) -> _Array:
        """(K-1,) m/s, of the steps."""
        velocities = np.diff(self.positions, axis=0) / self.steps[:, None]
        return np.asarray(np.linalg.norm(velocities, axis=1))

    @cached_property
    def angular_speeds(self) -> _Array:
        """(K-1,) rad/s, of the shorter turn of each step."""
        a, b = self.orientations[:-1], self.orientations[1:]
        apart = np.minimum(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1))
        return np.asarray(4.0 * np.arcsin(np.clip(0.5 * apart, 0.0, 1.0)) / self.steps)
