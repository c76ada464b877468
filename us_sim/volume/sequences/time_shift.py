"""Poses of a sweep for images that were stamped early or late.

>>> import numpy as np
>>> from us_sim.volume.sequences.time_shift import poses_at
>>> there = np.stack([np.eye(4), np.eye(4)]); there[1, 0, 3] = 0.01
>>> poses_at(np.array([0.0, 0.1]), there, np.array([0.05, 0.3]), np.zeros(3))[:, 0, 3]
array([0.005,   nan])
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import interpolate
from us_sim.volume.sequences.sweep import Sweep

_LONGEST_GAP = 0.3  # s, between poses that are interpolated; three frames of a slow scanner
_NO_POSE = "no pose at its time"


def shifted(sweep: Sweep, offset: float) -> Sweep:
    """The sweep with each image where the probe was ``offset`` seconds after its time stamp.

    Args:
        sweep: with poses.
        offset: s, to add to the images' times to find their poses.

    Raises:
        VolumeError: no image has a pose at its time.
    """
    centre = np.array([0.5 * (sweep.columns - 1), 0.5 * (sweep.rows - 1), 0.0])
    placed = poses_at(sweep.times, sweep.image_to_reference, sweep.times + offset, centre)
    used = np.isfinite(placed).all(axis=(1, 2))
    if not used.any():
        raise VolumeError(
            f"{sweep.path}: no image has a pose {1e3 * offset:g} ms after its time; give a time "
            f"offset within the {np.ptp(sweep.times):.2g} s of the sweep"
        )
    left_out = dict(sweep.left_out)
    if not used.all():
        left_out[_NO_POSE] = int((~used).sum())
    return dataclasses.replace(
        sweep,
        numbers=sweep.numbers[used],
        times=sweep.times[used],
        image_to_reference=placed[used],
        left_out=left_out,
    )


def poses_at(
    times: NDArray[np.float64],
    matrices: NDArray[np.float64],
    wanted: NDArray[np.float64],
    centre: NDArray[np.float64],
) -> NDArray[np.float64]:
    """(N, 4, 4) transforms between those that were measured; nan where none is near in time.

    A point moves straight from one to the next, and everything turns about it.

    Args:
        times: (K,) s, of the measured.
        matrices: (K, 4, 4) m, each a rigid motion of the others.
        wanted: (N,) s.
        centre: (3,) the point, in the frame that the matrices take points of.
    """
    times, first = np.unique(times, return_index=True)
    matrices = matrices[first]
    placed = np.full((len(wanted), 4, 4), np.nan)
    for k, time in enumerate(wanted):
        after = int(np.searchsorted(times, time))
        if after < len(times) and times[after] == time:
            placed[k] = matrices[after]
        elif 0 < after < len(times) and times[after] - times[after - 1] <= _LONGEST_GAP:
            fraction = (time - times[after - 1]) / (times[after] - times[after - 1])
            placed[k] = _between(matrices[after - 1], matrices[after], fraction, centre)
    return placed


def _between(
    first: NDArray[np.float64],
    second: NDArray[np.float64],
    fraction: float,
    centre: NDArray[np.float64],
) -> NDArray[np.float64]:
    start, end = (matrix[:3, :3] @ centre + matrix[:3, 3] for matrix in (first, second))
    turn = np.eye(4)
    turn[:3, :3] = _nearest_rotation(second[:3, :3] @ np.linalg.inv(first[:3, :3]))
    turn[:3, 3] = end - start
    moved = interpolate(Pose(), Pose.from_matrix(turn), fraction)
    placed = first.copy()
    placed[:3, 3] -= start
    placed = moved.matrix @ placed
    placed[:3, 3] += start
    return np.asarray(placed, dtype=np.float64)


def _nearest_rotation(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right, dtype=np.float64)
