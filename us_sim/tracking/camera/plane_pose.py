"""The two poses of a plane that its perspective image leaves: IPPE.

Collins and Bartoli, "Infinitesimal plane-based pose estimation", IJCV 109 (2014).

>>> import numpy as np
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tracking.camera.markers import square
>>> from us_sim.tracking.camera.plane_pose import plane_poses
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

from us_sim.kernels import njit
from us_sim.tracking.camera.definite_system import solve_definite


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
    points = np.ascontiguousarray(points, dtype=np.float64).view()
    points.flags.writeable = False  # as a marker's are, or numba would compile the kernel twice
    if not _solve(points, np.ascontiguousarray(rays, dtype=np.float64), turns, shifts, errors):
        return []
    return [(turns[i], shifts[i]) for i in np.argsort(errors) if np.isfinite(errors[i])]


# The kernels below need no linear algebra library, which would take long to compile.


@njit(cache=True, nogil=True, error_model="numpy")
def _solve(points, rays, turns, shifts, errors):
    """Fill in both rotations, positions and errors, infinite of what is no pose; whether there
    are any.
    """
    count = len(points)
    centre = np.zeros(3)
    for i in range(count):
        for a in range(3):
            centre[a] += points[i, a] / count
    axes = np.empty((3, 3))
    plane = np.empty((count, 2))
    if not _plane(points, centre, axes, plane):
        return False
    homography = np.ones(9)
    if not _homography(plane, rays, homography):
        return False
    columns = np.empty((2, 3, 3))
    if not _rotations(homography, columns):
        return False
    shift = np.empty(3)
    place = np.empty(3)
    for k in range(2):
        errors[k] = np.inf
        if not _shift(plane, columns[k], rays, shift) or not shift[2] > 0:
            continue
        for a in range(3):
            for b in range(3):
                turns[k, a, b] = 0.0
                for c in range(3):
                    turns[k, a, b] += columns[k, a, c] * axes[c, b]
        for a in range(3):
            shifts[k, a] = shift[a]
            for b in range(3):
                shifts[k, a] -= turns[k, a, b] * centre[b]
        error = 0.0
        for i in range(count):
            for a in range(3):
                place[a] = shifts[k, a]
                for b in range(3):
                    place[a] += turns[k, a, b] * points[i, b]
            x, y = place[0] / place[2] - rays[i, 0], place[1] / place[2] - rays[i, 1]
            error += x * x + y * y
        if np.isfinite(error):
            errors[k] = error
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _cross(ax, ay, az, bx, by, bz):
    """The cross product's three components, and its length."""
    x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    return x, y, z, np.sqrt(x * x + y * y + z * z)


@njit(cache=True, nogil=True, error_model="numpy")
def _plane(points, centre, axes, plane):
    """Fill in the plane's two axes and its normal (3, 3), and the points' coordinates (N, 2);
    whether they span a plane.
    """
    longest, largest = 0.0, 0.0
    for i in range(len(points)):
        x, y, z = points[i, 0] - centre[0], points[i, 1] - centre[1], points[i, 2] - centre[2]
        length = np.sqrt(x * x + y * y + z * z)
        if length > longest:
            longest = length
            axes[0, 0], axes[0, 1], axes[0, 2] = x / length, y / length, z / length
    for i in range(len(points)):
        x, y, z = points[i, 0] - centre[0], points[i, 1] - centre[1], points[i, 2] - centre[2]
        x, y, z, area = _cross(axes[0, 0], axes[0, 1], axes[0, 2], x, y, z)
        if area > largest:
            largest = area
            axes[2, 0], axes[2, 1], axes[2, 2] = x / area, y / area, z / area
    if not largest > 1e-6 * longest:
        return False
    x, y, z, _ = _cross(axes[2, 0], axes[2, 1], axes[2, 2], axes[0, 0], axes[0, 1], axes[0, 2])
    axes[1, 0], axes[1, 1], axes[1, 2] = x, y, z
    for i in range(len(points)):
        for a in range(2):
            plane[i, a] = 0.0
            for b in range(3):
                plane[i, a] += axes[a, b] * (points[i, b] - centre[b])
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _homography(plane, rays, homography):
    """Fill in (9,) that takes the plane's coordinates (N, 2) to rays (N, 2), by least squares,
    with a last entry of 1; whether they determine it.
    """
    count = len(plane)
    size, spread = 0.0, 0.0
    middle = np.zeros(2)
    for i in range(count):
        for side in range(2):
            size = max(size, abs(plane[i, side]))
            middle[side] += rays[i, side] / count
    for i in range(count):
        for side in range(2):
            spread = max(spread, abs(rays[i, side] - middle[side]))
    if not (size > 0 and spread > 0):
        return False
    squares = np.zeros((8, 8))
    right = np.zeros(8)
    row = np.empty(8)
    for i in range(count):
        u, v = plane[i, 0] / size, plane[i, 1] / size
        for side in range(2):
            value = (rays[i, side] - middle[side]) / spread
            row[:] = 0.0
            row[3 * side], row[3 * side + 1], row[3 * side + 2] = u, v, 1.0
            row[6], row[7] = -value * u, -value * v
            for a in range(8):
                right[a] += row[a] * value
                for b in range(8):
                    squares[a, b] += row[a] * row[b]
    trace = 0.0
    for a in range(8):
        trace += squares[a, a]
    if not solve_definite(squares, right):
        return False
    # What is left of the diagonal by Cholesky's factor tells whether the points are enough.
    for a in range(8):
        if not squares[a, a] * squares[a, a] > 1e-10 * trace:
            return False
    for b in range(3):
        scale = 1.0 if b == 2 else 1.0 / size
        last = 1.0 if b == 2 else right[6 + b]
        for a in range(2):
            homography[3 * a + b] = (spread * right[3 * a + b] + middle[a] * last) * scale
        homography[6 + b] = last * scale
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _rotations(homography, turns):
    """Fill in both rotations of the plane by the homography's slope at the plane's middle
    (section 3); whether there are any.
    """
    px, py = homography[2], homography[5]
    # The rotation that takes the optical axis to the ray of the plane's middle.
    square = px * px + py * py
    scale = np.sqrt(1.0 + square)
    bend = 1.0 / (scale * (scale + 1.0))  # (1 - 1 / scale) / square
    aim = np.empty((3, 3))
    aim[0, 0], aim[0, 1], aim[0, 2] = 1.0 - bend * px * px, -bend * px * py, px / scale
    aim[1, 0], aim[1, 1], aim[1, 2] = -bend * px * py, 1.0 - bend * py * py, py / scale
    aim[2, 0], aim[2, 1], aim[2, 2] = -px / scale, -py / scale, 1.0 / scale
    ba, bb = aim[0, 0] - px * aim[2, 0], aim[0, 1] - px * aim[2, 1]
    bc, bd = aim[1, 0] - py * aim[2, 0], aim[1, 1] - py * aim[2, 1]
    inverse = 1.0 / (ba * bd - bb * bc)
    x, y = homography[0] - px * homography[6], homography[3] - py * homography[6]
    ca, cc = (bd * x - bb * y) * inverse, (ba * y - bc * x) * inverse
    x, y = homography[1] - px * homography[7], homography[4] - py * homography[7]
    cb, cd = (bd * x - bb * y) * inverse, (ba * y - bc * x) * inverse
    # The largest singular value, which is that of the plane's size over its distance.
    total, area = ca * ca + cb * cb + cc * cc + cd * cd, ca * cd - cb * cc
    largest = np.sqrt(0.5 * (total + np.sqrt(max(0.0, total * total - 4 * area * area))))
    if not (largest > 0 and np.isfinite(largest)):
        return False
    ca, cb, cc, cd = ca / largest, cb / largest, cc / largest, cd / largest
    first = np.sqrt(max(0.0, 1 - ca * ca - cc * cc))
    second = np.sqrt(max(0.0, 1 - cb * cb - cd * cd))
    if ca * cb + cc * cd > 0:
        second = -second
    for k in range(2):
        sign = 1.0 - 2.0 * k
        for a in range(3):
            turns[k, a, 0] = aim[a, 0] * ca + aim[a, 1] * cc + aim[a, 2] * sign * first
            turns[k, a, 1] = aim[a, 0] * cb + aim[a, 1] * cd + aim[a, 2] * sign * second
        # Rounding leaves the columns a little off a rotation's.
        x, y, z = turns[k, 0, 0], turns[k, 1, 0], turns[k, 2, 0]
        length = np.sqrt(x * x + y * y + z * z)
        x, y, z = x / length, y / length, z / length
        nx, ny, nz, area = _cross(x, y, z, turns[k, 0, 1], turns[k, 1, 1], turns[k, 2, 1])
        nx, ny, nz = nx / area, ny / area, nz / area
        turns[k, 0, 0], turns[k, 1, 0], turns[k, 2, 0] = x, y, z
        turns[k, 0, 2], turns[k, 1, 2], turns[k, 2, 2] = nx, ny, nz
        x, y, z, _ = _cross(nx, ny, nz, x, y, z)
        turns[k, 0, 1], turns[k, 1, 1], turns[k, 2, 1] = x, y, z
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _shift(plane, turn, rays, shift):
    """Fill in (3,) m that brings a turned plane's points before their rays, by least squares;
    whether they determine it.
    """
    squares = np.zeros((3, 3))
    shift[:] = 0.0
    row = np.empty(3)
    for i in range(len(rays)):
        depth = turn[2, 0] * plane[i, 0] + turn[2, 1] * plane[i, 1]
        for side in range(2):
            row[:] = 0.0
            row[side], row[2] = 1.0, -rays[i, side]
            aside = turn[side, 0] * plane[i, 0] + turn[side, 1] * plane[i, 1]
            wanted = rays[i, side] * depth - aside
            for a in range(3):
                shift[a] += wanted * row[a]
                for b in range(3):
                    squares[a, b] += row[a] * row[b]
    return solve_definite(squares, shift)
