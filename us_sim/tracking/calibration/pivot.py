"""Pivot calibration of a stylus, and the landmarks that it touches.

A pose (R, p) of the body puts the tip t at R t + p, which is the same point c for all of them:
[R  -I] [t; c] = -p, solved at once ("algebraic one-step", Yaniv 2015, Which pivot calibration?).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import CalibrationError
from us_sim.geometry.pose import Pose

Array = NDArray[np.float64]

_WINDOW = 0.2  # s, over which the tip is averaged
_STEADY = 5  # windows of the shortest stay
_STILLNESS = 1.5e-3  # m, diagonal of the box in which the averages stay
_SWING = 0.3  # rad, least swing of one of the stylus' axes meanwhile
_APART = 5e-3  # m; nearer places are the same one, of which the first counts


@dataclass(frozen=True, eq=False)
class Dwell:
    """A place where the tip stayed."""

    position: Array  # (3,) m, mean of the first steady second
    deviations: Array  # (3,) m, of its samples
    start: float  # s


def find_dwells(times: Array, tips: Array, rotations: Array) -> list[Dwell]:
    """Find the places where the tip stayed, in the order in which it came there first.

    Args:
        times: (K,) s, ascending.
        tips: (K, 3) m.
        rotations: (K, 3, 3) of the stylus.
    """
    if len(times) < 2:
        return []
    size = max(1, round(_WINDOW / float(np.median(np.diff(times)))))
    count = len(times) // size
    means = tips[: count * size].reshape(count, size, 3).mean(axis=1)
    axes = rotations[size - 1 : count * size : size]
    dwells: list[Dwell] = []
    start = 0
    for end in range(1, count + 1):
        if np.linalg.norm(np.ptp(means[start:end], axis=0)) > _STILLNESS:
            start = end
        elif end - start >= _STEADY and _swing(axes[start:end]) >= _SWING:
            samples = tips[start * size : (start + _STEADY) * size]
            position = samples.mean(axis=0)
            if all(np.linalg.norm(known.position - position) >= _APART for known in dwells):
                dwells.append(Dwell(position, samples.std(axis=0), float(times[start * size])))
            start = end
    return dwells


def _swing(rotations: Array) -> float:
    """Return the largest swing of an axis, about in rad."""
    return float(np.linalg.norm(np.ptp(rotations, axis=0), axis=0).max())


_FEWEST = 10  # poses
_SMALLEST_SWING = math.radians(5.0)  # of the direction that moves least, root mean square
_LARGEST_RMS = 5e-3  # m, above which the tip did not stay in one place
_ROUNDS = 30
_EXACT = 1e-14  # m², a distance that counts as none
_MEDIAN_SQUARE = 2.366  # median of chi-square with three degrees of freedom
_LARGEST_SQUARE = 16.27  # its 99.9th percentile


@dataclass(frozen=True, eq=False)
class PivotCalibration:
    """A tip and how well the poses determine it."""

    tip: Array  # (3,) m, in the body's frame
    pivot: Array  # (3,) m, the fixed point in the device's frame
    rms: float  # m, root mean square distance of the poses' tips from the fixed point
    deviations: Array  # (3,) m, standard deviations of the tip's coordinates
    swing: float  # rad, of the direction that turns least, root mean square
    inliers: NDArray[np.bool_]  # (K,) poses that were used

    @property
    def rejected(self) -> int:
        """Number of poses that lie too far from the others' fixed point."""
        return int((~self.inliers).sum())


def calibrate_pivot(poses: Sequence[Pose]) -> PivotCalibration:
    """Find the tip that stays in one place, from poses of the body in the device's frame.

    A third of the poses may be wrong (the tip slipped, the tracker saw a reflection): a start by
    the least sum of distances leaves them out.

    Raises:
        CalibrationError: there are too few poses, they turn about one axis only, or the tip did
            not stay in one place.

    Examples:
        >>> tip, hole = np.array([0.0, 0.0, 0.15]), np.array([0.1, 0.2, 0.3])
        >>> turns = [Pose(orientation=[np.sin(a), np.cos(3 * a) - 1, 0, 4]) for a in range(20)]
        >>> poses = [Pose(hole - turn.transform_points(tip), turn.orientation) for turn in turns]
        >>> calibrate_pivot(poses).tip.round(6) + 0.0
        array([0.  , 0.  , 0.15])
    """
    if len(poses) < _FEWEST:
        raise CalibrationError(
            f"a pivot calibration needs at least {_FEWEST} poses, not {len(poses)}: tilt the "
            f"stylus in all directions for ten seconds with its tip in a dimple"
        )
    rotations = np.array([pose.rotation for pose in poses])
    positions = np.array([pose.position for pose in poses])
    _check_swing(rotations)
    inliers = _consistent(rotations, positions)
    swing = _check_swing(rotations[inliers])
    solution, covariance, rms = _least_squares(rotations[inliers], positions[inliers])
    if rms > _LARGEST_RMS:
        raise CalibrationError(
            f"the poses have no point in common (RMS {1e3 * rms:.0f} mm): keep the tip in one "
            f"dimple during the whole recording"
        )
    return PivotCalibration(
        solution[:3], solution[3:], rms, np.sqrt(np.diag(covariance)[:3]), swing, inliers
    )


def _check_swing(rotations: Array) -> float:
    """Return the turn (rad) of the direction that turns least.

    Raises:
        CalibrationError: it is so small that the tip's place along that direction stays open.
    """
    # The least-squares matrix is [I, -mean(R)ᵀ; -mean(R), I]: it is singular exactly when some
    # direction of the body is the same in all poses, for which the mean shortens nothing.
    longest = min(float(np.linalg.svd(rotations.mean(axis=0), compute_uv=False)[0]), 1.0)
    swing = math.sqrt(2.0 * (1.0 - longest))
    if swing < _SMALLEST_SWING:
        raise CalibrationError(
            f"the poses turn about one axis only (another direction moves by "
            f"{math.degrees(swing):.1f}°, and {math.degrees(_SMALLEST_SWING):.0f}° is the least): "
            f"tilt the stylus forwards and sideways by 20° or more with its tip in the dimple"
        )
    return swing


def _least_squares(
    rotations: Array, positions: Array, weights: Array | float = 1.0
) -> tuple[Array, Array, float]:
    """Fit tip and fixed point (6,) m; return also their covariance (6, 6) and the RMS distance."""
    count = len(rotations)
    rows = np.concatenate([rotations, np.tile(-np.eye(3), (count, 1, 1))], axis=2)
    scale = np.sqrt(np.broadcast_to(weights, count))
    matrix = (rows * scale[:, None, None]).reshape(-1, 6)
    right = -(positions * scale[:, None]).ravel()
    solution = np.asarray(np.linalg.lstsq(matrix, right, rcond=None)[0], np.float64)
    squares = float(((matrix @ solution - right) ** 2).sum())
    covariance = np.linalg.inv(matrix.T @ matrix) * squares / (3 * count - 6)
    return solution, covariance, math.sqrt(squares / count)


def _consistent(rotations: Array, positions: Array) -> NDArray[np.bool_]:
    """Mark the poses (K,) that agree with most others on a fixed point.

    The start is the least sum of distances, by weights of their inverses (Weiszfeld 1937).
    """
    weights = np.ones(len(rotations))
    for _ in range(_ROUNDS):
        solution = _least_squares(rotations, positions, weights)[0]
        squares = _squared_distances(rotations, positions, solution)
        weights = 1.0 / np.sqrt(squares + _EXACT)
    inliers = _near(squares)
    for _ in range(10):
        solution = _least_squares(rotations[inliers], positions[inliers])[0]
        again = _near(_squared_distances(rotations, positions, solution))
        if (again == inliers).all():
            break
        inliers = again
    return inliers


def _squared_distances(rotations: Array, positions: Array, solution: Array) -> Array:
    return np.asarray(((rotations @ solution[:3] + positions - solution[3:]) ** 2).sum(axis=1))


def _near(squares: Array) -> NDArray[np.bool_]:
    """Mark squared distances that a normal error of the median's size, or of rounding, may have."""
    variance = float(np.median(squares)) / _MEDIAN_SQUARE
    return np.asarray(squares <= max(variance * _LARGEST_SQUARE, 1e-18))
