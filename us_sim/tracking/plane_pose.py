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
    centre = points.mean(axis=0)
    axes = np.linalg.svd(points - centre)[2]
    axes[2] = np.cross(axes[0], axes[1])
    plane = (points - centre) @ axes[:2].T
    homography = _homography(plane, rays)
    if homography is None:
        return []
    found = []
    for rotation in _rotations(homography):
        shift = _shift(rotation[:, :2] @ plane.T, rays)
        if np.isfinite(shift).all() and shift[2] > 0:
            turned = rotation @ axes
            before = points @ turned.T + (shift - turned @ centre)
            error = float(((before[:, :2] / before[:, 2:] - rays) ** 2).sum())
            found.append((error, turned, shift - turned @ centre))
    found.sort(key=lambda each: each[0])
    return [(rotation, position) for _, rotation, position in found]


def _homography(
    plane: NDArray[np.float64], rays: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """(3, 3) that takes the plane's coordinates (N, 2) to rays (N, 2), by least squares."""
    size = np.abs(plane).max()
    middle = rays.mean(axis=0)
    spread = np.abs(rays - middle).max()
    if not (size > 0 and spread > 0):
        return None
    u, v = (plane / size).T
    x, y = ((rays - middle) / spread).T
    zero, one = np.zeros_like(u), np.ones_like(u)
    rows = np.concatenate(
        [
            np.stack([u, v, one, zero, zero, zero, -x * u, -x * v, -x], axis=1),
            np.stack([zero, zero, zero, u, v, one, -y * u, -y * v, -y], axis=1),
        ]
    )
    _, values, vectors = np.linalg.svd(rows)
    if values[7] < 1e-9 * values[0]:
        return None
    back = np.array([[spread, 0, middle[0]], [0, spread, middle[1]], [0, 0, 1.0]])
    matrix = back @ vectors[8].reshape(3, 3) @ np.diag([1 / size, 1 / size, 1.0])
    if abs(matrix[2, 2]) < 1e-12 * np.abs(matrix).max():
        return None
    return np.asarray(matrix / matrix[2, 2])


def _rotations(homography: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Both rotations of the plane by the homography's slope at the plane's middle (section 3)."""
    place = homography[:2, 2]
    slope = homography[:2, :2] - np.outer(place, homography[2, :2])
    # The rotation that takes the optical axis to the ray of the plane's middle.
    length = np.sqrt(place @ place)
    scale = np.sqrt(1.0 + place @ place)
    aim = np.eye(3)
    if length > 1e-12:
        turn = np.zeros((3, 3))
        turn[:2, 2] = place / length
        turn[2, :2] = -place / length
        aim = np.eye(3) + (length / scale) * turn + (1 - 1 / scale) * (turn @ turn)
    basis = aim[:2, :2] - np.outer(place, aim[2, :2])
    corner = np.linalg.solve(basis, slope)
    largest = np.linalg.svd(corner, compute_uv=False)[0]
    if not largest > 0:
        return []
    corner = corner / largest
    rest = np.eye(2) - corner.T @ corner
    first, second = np.sqrt(np.maximum(np.diag(rest), 0.0))
    if rest[0, 1] < 0:
        second = -second
    found = []
    for sign in (1.0, -1.0):
        columns = np.vstack([corner, [sign * first, sign * second]])
        # Rounding leaves the columns a little off a rotation's.
        left, _, right = np.linalg.svd(aim @ columns, full_matrices=False)
        columns = left @ right
        found.append(np.column_stack([columns, np.cross(columns[:, 0], columns[:, 1])]))
    return found


def _shift(turned: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3,) m that brings points (3, N), turned already, before their rays, by least squares."""
    count = len(rays)
    rows = np.zeros((2 * count, 3))
    rows[:count, 0] = 1.0
    rows[count:, 1] = 1.0
    rows[:count, 2], rows[count:, 2] = -rays[:, 0], -rays[:, 1]
    wanted = np.concatenate(
        [rays[:, 0] * turned[2] - turned[0], rays[:, 1] * turned[2] - turned[1]]
    )
    return np.asarray(np.linalg.lstsq(rows, wanted, rcond=None)[0])
