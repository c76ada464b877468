"""The two poses of a plane that its perspective image leaves: IPPE.

Collins and Bartoli, "Infinitesimal plane-based pose estimation", IJCV 109 (2014).

>>> import numpy as np
>>> from us_sim.pose import Pose
>>> from us_sim.tracking.markers import square
>>> from us_sim.tracking.plane_pose import plane_poses
>>> true = Pose([0.02, 0.01, 0.4], [1.0, 0.2, 0.1, 0.0])
>>> seen = true.apply(square(0.04))
>>> for rotation, position in plane_poses(square(0.04), seen[:, :2] / seen[:, 2:]):
...     print(np.abs(rotation - true.rotation).max().round(6), position.round(4))
0.0 [0.02 0.01 0.4 ]
0.488948 [0.0195 0.0099 0.3999]
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["plane_poses"]


def plane_poses(
    points: NDArray[np.float64], rays: NDArray[np.float64]
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Rotations (3, 3) and positions (3,) m that take points in a plane before their rays.

    Args:
        points: (N, 3) m, N at least 4, no three of the four outermost in a line.
        rays: (N, 2), x / z and y / z of each in the camera's frame.

    Returns:
        Two, that with the lesser error first; none where the points do not determine them, or
        the plane would be behind the camera.
    """
    turns = np.empty((2, 3, 3))
    shifts = np.empty((2, 3))
    errors = np.empty(2)
    points = np.ascontiguousarray(points, dtype=np.float64)
    if not _solve(points, np.ascontiguousarray(rays, dtype=np.float64), turns, shifts, errors):
        return []
    return [(turns[i], shifts[i]) for i in np.argsort(errors) if np.isfinite(errors[i])]


@njit(cache=True, nogil=True, error_model="numpy")
def _solve(points, rays, turns, shifts, errors):
    """Fill in both rotations, positions and errors, infinite of what is no pose; whether there
    are any.
    """
    count = len(points)
    centre = np.zeros(3)
    for i in range(count):
        centre += points[i] / count
    arms = points - centre
    axes = np.linalg.eigh(arms.T @ arms)[1].T.copy()
    across, along = axes[1].copy(), axes[2].copy()
    axes[0], axes[1] = along, across
    axes[2, 0] = along[1] * across[2] - along[2] * across[1]
    axes[2, 1] = along[2] * across[0] - along[0] * across[2]
    axes[2, 2] = along[0] * across[1] - along[1] * across[0]
    plane = arms @ axes[:2].T
    homography = np.empty((3, 3))
    if not _homography(plane, rays, homography):
        return False
    if not _rotations(homography, turns):
        return False
    for k in range(2):
        shift = _shift(plane @ turns[k, :, :2].copy().T, rays)
        turns[k] = turns[k].copy() @ axes
        shifts[k] = shift - turns[k] @ centre
        errors[k] = 0.0
        for i in range(count):
            before = turns[k] @ points[i] + shifts[k]
            x, y = before[0] / before[2] - rays[i, 0], before[1] / before[2] - rays[i, 1]
            errors[k] += x * x + y * y
        if not (np.isfinite(errors[k]) and shift[2] > 0):
            errors[k] = np.inf
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _homography(plane, rays, homography):
    """Fill in (3, 3) that takes the plane's coordinates (N, 2) to rays (N, 2), by least squares;
    whether they determine it.
    """
    size = np.abs(plane).max()
    middle = np.array([rays[:, 0].mean(), rays[:, 1].mean()])
    spread = np.abs(rays - middle).max()
    if not (size > 0 and spread > 0):
        return False
    squares = np.zeros((9, 9))
    row = np.zeros(9)
    for i in range(len(plane)):
        u, v = plane[i] / size
        for side in range(2):
            value = (rays[i, side] - middle[side]) / spread
            row[:] = 0.0
            row[3 * side], row[3 * side + 1], row[3 * side + 2] = u, v, 1.0
            row[6], row[7], row[8] = -value * u, -value * v, -value
            squares += np.outer(row, row)
    values, vectors = np.linalg.eigh(squares)
    if values[1] < 1e-10 * values[8]:
        return False
    flat = vectors[:, 0]
    for a in range(3):
        for b in range(3):
            scale = 1.0 if b == 2 else 1.0 / size
            value = flat[3 * a + b]
            if a < 2:
                value = spread * value + middle[a] * flat[6 + b]
            homography[a, b] = value * scale
    last = homography[2, 2]
    if abs(last) < 1e-12 * np.abs(homography).max():
        return False
    homography /= last
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _rotations(homography, turns):
    """Fill in both rotations of the plane by the homography's slope at the plane's middle
    (section 3); whether there are any.
    """
    place = homography[:2, 2].copy()
    slope = homography[:2, :2] - np.outer(place, homography[2, :2])
    # The rotation that takes the optical axis to the ray of the plane's middle.
    square = place @ place
    length = np.sqrt(square)
    scale = np.sqrt(1.0 + square)
    aim = np.eye(3)
    if length > 1e-12:
        turn = np.zeros((3, 3))
        for a in range(2):
            turn[a, 2] = place[a] / length
            turn[2, a] = -place[a] / length
        aim += (length / scale) * turn + (1 - 1 / scale) * (turn @ turn)
    basis = aim[:2, :2] - np.outer(place, aim[2, :2])
    corner = np.linalg.solve(basis, slope)
    largest = np.linalg.svd(corner)[1][0]
    if not largest > 0:
        return False
    corner /= largest
    first = np.sqrt(max(0.0, 1 - corner[0, 0] ** 2 - corner[1, 0] ** 2))
    second = np.sqrt(max(0.0, 1 - corner[0, 1] ** 2 - corner[1, 1] ** 2))
    if corner[0, 0] * corner[0, 1] + corner[1, 0] * corner[1, 1] > 0:
        second = -second
    columns = np.empty((3, 2))
    for k in range(2):
        sign = 1.0 - 2.0 * k
        columns[:2] = corner
        columns[2, 0], columns[2, 1] = sign * first, sign * second
        # Rounding leaves the columns a little off a rotation's.
        left, _, right = np.linalg.svd(aim @ columns, False)
        turned = left @ right
        turns[k, :, :2] = turned
        turns[k, 0, 2] = turned[1, 0] * turned[2, 1] - turned[2, 0] * turned[1, 1]
        turns[k, 1, 2] = turned[2, 0] * turned[0, 1] - turned[0, 0] * turned[2, 1]
        turns[k, 2, 2] = turned[0, 0] * turned[1, 1] - turned[1, 0] * turned[0, 1]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _shift(turned, rays):
    """(3,) m that brings points (N, 3), turned already, before their rays, by least squares."""
    squares = np.zeros((3, 3))
    right = np.zeros(3)
    row = np.zeros(3)
    for i in range(len(rays)):
        for side in range(2):
            row[:] = 0.0
            row[side], row[2] = 1.0, -rays[i, side]
            wanted = rays[i, side] * turned[i, 2] - turned[i, side]
            squares += np.outer(row, row)
            right += wanted * row
    return np.linalg.solve(squares, right)
