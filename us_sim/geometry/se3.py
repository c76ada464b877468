"""Rigid motions as vectors: exponential, adjoint and interpolation on SE(3).

A twist is (6,): translation (m), then rotation (rad), the order of a measurement's covariance.
"""

from __future__ import annotations

from math import atan2, cos, sin, sqrt

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose, multiply_quaternions

_SMALL = 1e-3  # rad: below it series to the fourth order are exact to rounding


def exp(twist: NDArray[np.float64]) -> Pose:
    """Return the motion of a twist (6,) m, rad, done for one unit of time (Barfoot 2017, 7.86)."""
    rotation = twist[3:]
    return Pose(left_jacobian(rotation) @ twist[:3], rotation_exp(rotation))


def adjoint(pose: Pose) -> NDArray[np.float64]:
    """Return the (6, 6) map of twists from the child's frame to the parent's (ibid., 7.43)."""
    rotation = pose.rotation
    matrix = np.zeros((6, 6))
    matrix[:3, :3] = matrix[3:, 3:] = rotation
    matrix[:3, 3:] = cross_matrix(pose.position) @ rotation
    return matrix


def interpolate_poses(first: Pose, second: Pose, fraction: float) -> Pose:
    """Return the pose at a fraction (0 to 1) of the straight path with the shorter turn."""
    turn = fraction * rotation_between(first.orientation, second.orientation)
    return Pose(
        first.position + fraction * (second.position - first.position),
        multiply_quaternions(rotation_exp(turn), first.orientation),
    )


def rotation_exp(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unit quaternion (4,) x, y, z, w of a rotation vector (3,) rad."""
    x, y, z = vector.tolist()
    square = x * x + y * y + z * z
    angle = sqrt(square)
    factor = 0.5 - square / 48.0 if angle < _SMALL else sin(0.5 * angle) / angle
    return np.array([factor * x, factor * y, factor * z, cos(0.5 * angle)])


def rotation_log(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation vector (3,) rad, of at most pi, of a unit quaternion (4,) x, y, z, w."""
    x, y, z, w = quaternion.tolist()
    if w < 0.0:
        x, y, z, w = -x, -y, -z, -w
    half_sine = sqrt(x * x + y * y + z * z)
    factor = 2.0 / w if half_sine < 1e-12 else 2.0 * atan2(half_sine, w) / half_sine
    return np.array([factor * x, factor * y, factor * z])


def rotation_between(
    first: NDArray[np.float64], second: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Rotation vector (3,) rad about the parent's axes that turns the first into the second."""
    return rotation_log(multiply_quaternions(second, first * [-1.0, -1.0, -1.0, 1.0]))


def left_jacobian(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (3, 3) J: exp(v + d) = exp(J d) exp(v) to first order in d (Barfoot 2017, 7.37)."""
    x, y, z = vector.tolist()
    square = x * x + y * y + z * z
    angle = sqrt(square)
    if angle < _SMALL:
        first, second = 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
    else:
        first, second = (1.0 - cos(angle)) / square, (angle - sin(angle)) / (square * angle)
    xy, yz, zx = second * x * y, second * y * z, second * z * x
    x1, y1, z1 = first * x, first * y, first * z
    return np.array(
        [
            [1.0 - second * (y * y + z * z), xy - z1, zx + y1],
            [xy + z1, 1.0 - second * (z * z + x * x), yz - x1],
            [zx - y1, yz + x1, 1.0 - second * (x * x + y * y)],
        ]
    )


def cross_matrix(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (3, 3) matrix that takes any u to vector × u."""
    x, y, z = vector.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
