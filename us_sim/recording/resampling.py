"""Recorded values at the moments of a constant rate, as a learner wants them.

Numbers are interpolated linearly, orientations on the shortest arc at constant angular velocity
(slerp; K. Shoemake, Animating rotation with quaternion curves, 1985), and of images the latest is
shown.

>>> import numpy as np
>>> from us_sim.recording.resampling import latest, linear
>>> times = np.array([0, 100, 300])
>>> linear(times, np.array([[0.0], [1.0], [3.0]]), np.array([50, 200]))
array([[0.5],
       [2. ]])
>>> latest(times, np.array([99, 100, 500]))
array([0, 1, 2])
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Times = NDArray[np.int64]
"""ns, strictly increasing."""


def linear(times: Times, values: NDArray[np.float64], moments: Times) -> NDArray[np.float64]:
    """Values (K, N) at moments (M,), each number between the nearest that are finite: (M, N)."""
    made = np.empty((len(moments), values.shape[1]))
    for column, series in enumerate(values.T):
        there = np.isfinite(series)
        since = (times[there] - moments[0]) * 1e-9  # doubles count no ns since 1970
        made[:, column] = np.interp((moments - moments[0]) * 1e-9, since, series[there])
    return made


def slerp(times: Times, poses: NDArray[np.float64], moments: Times) -> NDArray[np.float64]:
    """Poses (K, 7), position and quaternion, at moments (M,) within their times: (M, 7).

    From one moment to the next a quaternion does not change its sign without need; the first has
    w of 0 or more.
    """
    from scipy.spatial.transform import Rotation, Slerp  # players do without

    since, wanted = (times - moments[0]) * 1e-9, (moments - moments[0]) * 1e-9
    turns = Slerp(since, Rotation.from_quat(poses[:, 3:]))(wanted).as_quat()
    along = np.einsum("ij,ij->i", turns[1:], turns[:-1]) < 0
    flips = np.cumsum(np.concatenate([[turns[0, 3] < 0], along])) % 2 == 1
    turns[flips] *= -1
    return np.hstack([linear(times, poses[:, :3], moments), turns])


def latest(times: Times, moments: Times) -> NDArray[np.int64]:
    """The number of the last of the times at or before each moment; none is before the first."""
    return np.searchsorted(times, moments, side="right") - 1
