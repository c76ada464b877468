"""The pose of a body of markers from where its points are in one image.

A plane has two poses in a perspective image: IPPE (Collins and Bartoli, "Infinitesimal plane-based
pose estimation", IJCV 109, 2014) gives both, Gauss-Newton refines them, and the evidence of all
images so far chooses one.

>>> from us_sim.tracking.camera.body_pose import body_poses
>>> from us_sim.tracking.camera.markers import square
>>> camera = CameraModel(640, 480, [[600, 0, 320], [0, 600, 240], [0, 0, 1]])
>>> true = Pose([0.02, 0.01, 0.4], [1.0, 0.2, 0.1, 0.0])
>>> poses = body_poses(camera, square(0.04), camera.project(true.apply(square(0.04))))
>>> poses[0].pose.position.round(6)
array([0.02, 0.01, 0.4 ])
>>> [round(each.error, 3) for each in poses]  # pixels, of the pose and of the other one
[0.0, 0.856]
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import rotation_between
from us_sim.kernels import njit
from us_sim.tracking.camera.model import CameraModel, project_points

_TURN = cv2.Rodrigues(np.array([0.3, 0.5, 0.7]))[0]
"""Turns points before OpenCV sees them: its rotation vectors fail at half a turn, which every
marker that faces the camera has."""


def plane_poses(
    points: NDArray[np.float64], rays: NDArray[np.float64]
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Rotations (3, 3) and positions (3,) m that take points in a plane before their rays.

    OpenCV's SQPNP, which needs no plane, gives one of the two poses only.

    Args:
        points: (N, 3) m, N at least 4, no three of the four outermost in a line.
        rays: (N, 2), x / z and y / z of each in the camera's frame.

    Returns:
        Two, that with the lesser error first; none where the points do not determine them, or
        the plane would be behind the camera.
    """
    middle = points.mean(axis=0)
    turned = np.ascontiguousarray(points @ _TURN.T)
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(
            turned, np.ascontiguousarray(rays), np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
        )
    except cv2.error:  # the points are in a line, or at one place
        return []
    found = []
    for turn, shift in zip(turns, shifts, strict=True):
        rotation = np.asarray(cv2.Rodrigues(turn)[0] @ _TURN, dtype=np.float64)
        position = np.asarray(shift, dtype=np.float64).ravel()
        if rotation[2] @ middle + position[2] > 0 and np.isfinite(rotation).all():
            found.append((rotation, position))
    return found


_FORGETTING = 0.9  # factor of the evidence of earlier images, from one to the next
_SURE = 12.0  # log likelihood ratio beyond which more does not count: so that it can be unlearned


class PlaneAmbiguity:
    """Chooses between two poses that a plane's image leaves.

    The right one moves as the last one did, and fits the images better in the long run; a single
    image of a small marker may fit the wrong one better by chance.

    Args:
        deviation: pixels, with which the poses were estimated.
    """

    def __init__(self, deviation: float) -> None:
        self._deviation = deviation
        self._evidence = 0.0  # log likelihood ratio of the pose that is followed to the other

    def reset(self) -> None:
        """Forget all images."""
        self._evidence = 0.0

    def chosen(self, found: list[BodyPose], before: Pose | None) -> BodyPose:
        """The pose that follows the one before, unless by now the images speak for the other."""
        if len(found) == 1 or before is None:
            return found[0]
        near, far = _by_nearness(found, before)
        return near if _FORGETTING * self._evidence + self._ratio(near, far) >= 0 else far

    def settled(
        self, found: list[BodyPose], pose: BodyPose, before: Pose | None
    ) -> NDArray[np.float64]:
        """Learn from an image of which a pose was chosen.

        Returns:
            (6, 6) its covariance, that of the mixture of both poses about the chosen one: the
            likelier the other is, the wider.
        """
        self._evidence *= _FORGETTING
        if len(found) == 1:
            return pose.covariance
        other = found[1] if pose is found[0] else found[0]
        if before is not None and _by_nearness(found, before)[0] is not pose:
            self._evidence = -self._evidence
        evidence = self._evidence + self._ratio(pose, other)
        self._evidence = float(np.clip(evidence, -_SURE, _SURE))
        probability = 1.0 / (1.0 + np.exp(self._evidence))
        turn = rotation_between(pose.pose.orientation, other.pose.orientation)
        apart = np.concatenate([other.pose.position - pose.pose.position, turn])
        return np.asarray(pose.covariance + probability * np.outer(apart, apart))

    def _ratio(self, one: BodyPose, other: BodyPose) -> float:
        """Log likelihood ratio, with the noise estimated from the better of both."""
        better = one if one.misfit <= other.misfit else other
        return 0.5 * (other.misfit - one.misfit) * (self._deviation / better.deviation) ** 2


def _by_nearness(found: list[BodyPose], before: Pose) -> list[BodyPose]:
    return sorted(found, key=lambda each: rotation_angle(each.pose, before))


CORNER_DEVIATION = 0.1  # pixels, of a corner's coordinates in a sharp image with little noise

_FLAT = 1e-3  # thickness of a body, of its extent, up to which one homography shows all of it
_DISTINCT = np.radians(1.0)
_TRIED = 3  # markers from which a pose is guessed
_REFINED = 3  # guesses that are refined
_ITERATIONS = 25
_DETERMINED = 1e-9  # least eigenvalue of the normal matrix with a unit diagonal
_HUBER = 2.0  # standard deviations beyond which a corner pulls no harder


@dataclass(frozen=True, eq=False)
class BodyPose:
    """A pose of a body that explains an image, at least as well as any near it."""

    pose: Pose  # of the body in camera_optical
    covariance: NDArray[np.float64]  # (6, 6), as Measurement has it
    error: float  # pixels, root mean square over points of their distance
    deviation: float  # pixels, of a coordinate, by what is left over; at least what was assumed
    residuals: NDArray[np.float64]  # (N, 2) pixels, of the points in their order
    misfit: float  # twice the negative log likelihood of Huber's distribution, and a constant


def body_poses(
    camera: CameraModel,
    points: NDArray[np.float64],
    pixels: NDArray[np.float64],
    owners: NDArray[np.int64] | None = None,
    *,
    guess: Pose | None = None,
    deviation: float = CORNER_DEVIATION,
) -> list[BodyPose]:
    """The pose of a body of which points are seen, and the other one that a plane may have.

    A square seen from afar looks nearly the same when it is tilted the opposite way about its line
    of sight. So both solutions of every marker (Collins and Bartoli 2014, IPPE) and the guess are
    held against all points, the best are refined, and what differs is returned.

    Args:
        camera: of the image.
        points: (N, 3) m, in the body's frame; four or more of each owner, in one plane.
        pixels: (N, 2), where the image has them.
        owners: (N,) the marker that each point is of; default: all are of one plane.
        guess: of the pose, for instance from the last image.
        deviation: pixels, the least standard deviation of a coordinate.

    Returns:
        At most two, that of the least error first; none where no pose has all points before the
        camera, fewer than four have a line of sight, or these do not determine a pose.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    pixels = np.ascontiguousarray(pixels, dtype=np.float64)
    rays = camera.rays(pixels)
    if len(points) < 4 or not np.isfinite(rays).all():
        return []
    guesses = _guesses(points, rays, pixels, owners)
    if guess is not None:
        guesses.append((guess.rotation, guess.position))
    ranked = sorted(
        (_misfit(camera.project(points @ turn.T + place) - pixels, deviation), i)
        for i, (turn, place) in enumerate(guesses)
    )
    found: list[BodyPose] = []
    for misfit, i in ranked[: _REFINED + 1]:
        if not np.isfinite(misfit):
            break
        pose = _refined(camera, points, pixels, *guesses[i], deviation)
        if pose is not None and all(
            rotation_angle(pose.pose, other.pose) > _DISTINCT for other in found
        ):
            found.append(pose)
    return sorted(found, key=lambda each: each.misfit)[:2]


def rotation_angle(one: Pose, other: Pose) -> float:
    """rad, of the rotation from one pose to another."""
    cosine = abs(float(one.orientation @ other.orientation))
    return 2.0 * float(np.arccos(min(1.0, cosine)))


_Guess = tuple[NDArray[np.float64], NDArray[np.float64]]


def _guesses(
    points: NDArray[np.float64],
    rays: NDArray[np.float64],
    pixels: NDArray[np.float64],
    owners: NDArray[np.int64] | None,
) -> list[_Guess]:
    """Rotations and positions from the whole body where it is flat, or else from its markers."""
    spread = points - points.mean(axis=0)
    extents = np.linalg.svd(spread, compute_uv=False)
    flat = extents[2] <= _FLAT * extents[0]
    if owners is None or flat:
        return plane_poses(points, rays)
    groups = [np.flatnonzero(owners == owner) for owner in np.unique(owners)]
    # The largest in the image tell most.
    groups.sort(key=lambda group: -float(np.ptp(pixels[group], axis=0).prod()))
    return [each for group in groups[:_TRIED] for each in plane_poses(points[group], rays[group])]


def _misfit(residuals: NDArray[np.float64], deviation: float) -> float:
    """Huber's loss, in deviations; infinite where a point is not before the camera."""
    squares = np.einsum("ij,ij->i", residuals, residuals) / deviation**2
    lengths = np.sqrt(squares)
    loss = np.where(lengths <= _HUBER, squares, 2 * _HUBER * lengths - _HUBER**2)
    total = float(loss.sum())
    return total if np.isfinite(total) else np.inf


def _refined(
    camera: CameraModel,
    points: NDArray[np.float64],
    pixels: NDArray[np.float64],
    rotation: NDArray[np.float64],
    position: NDArray[np.float64],
    deviation: float,
) -> BodyPose | None:
    """The pose of least misfit near a first one; None where that leads behind the camera, or
    the points do not determine a pose."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, position
    normal = np.empty((6, 6))
    residuals = np.empty_like(pixels)
    points = points.view()
    points.flags.writeable = False  # as a body's are, or numba would compile the kernel twice
    misfit = _descend(points, pixels, *camera.lens, deviation, matrix, normal, residuals)
    if not np.isfinite(misfit):
        return None
    squares = float((residuals**2).sum())
    freedom = max(1, residuals.size - 6)
    found = max(deviation, float(np.sqrt(min(squares, misfit * deviation**2) / freedom)))
    scale = 1.0 / np.sqrt(np.diag(normal))
    values, vectors = np.linalg.eigh(normal * np.outer(scale, scale))
    if not values[0] > _DETERMINED:
        return None
    half = scale[:, None] * vectors / np.sqrt(values)
    covariance = half @ half.T * (found / deviation) ** 2
    return BodyPose(
        Pose.from_matrix(matrix),
        0.5 * (covariance + covariance.T),
        float(np.sqrt(squares / len(points))),
        found,
        residuals,
        misfit,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _descend(points, pixels, lens, fisheye, deviation, matrix, normal, residuals):
    """Levenberg-Marquardt on SE(3) with Huber's weights, from the pose in ``matrix`` (4, 4).

    A step is a shift and a rotation about the camera's axes through the body's origin, so that
    the inverse of the normal matrix is the covariance as ROS has it.

    Returns:
        The misfit, infinite where points are not before the camera; the pose, the normal matrix
        (6, 6) in deviations and the residuals (N, 2) pixels in place.
    """
    count = len(points)
    arms = np.empty((count, 3))
    seen = np.empty((count, 2))
    slopes = np.empty((count, 2, 3))
    gradient = np.empty(6)
    damped = np.empty((6, 6))
    step = np.empty(6)
    turn = np.empty((3, 3))
    trial = matrix.copy()
    damping = 1e-4
    misfit = np.inf
    for iteration in range(_ITERATIONS + 1):
        _turn_points(points, trial, arms, seen, slopes, lens, fisheye)
        new_misfit = 0.0
        for i in range(count):
            x, y = seen[i, 0] - pixels[i, 0], seen[i, 1] - pixels[i, 1]
            square = (x * x + y * y) / (deviation * deviation)
            if square <= _HUBER * _HUBER:
                new_misfit += square
            else:
                new_misfit += 2 * _HUBER * np.sqrt(square) - _HUBER * _HUBER
        if new_misfit < misfit or (iteration == 0 and np.isfinite(new_misfit)):
            gain = misfit - new_misfit
            misfit = new_misfit
            for a in range(3):
                for b in range(4):
                    matrix[a, b] = trial[a, b]
            for i in range(count):
                residuals[i, 0] = seen[i, 0] - pixels[i, 0]
                residuals[i, 1] = seen[i, 1] - pixels[i, 1]
            _normal_equations(arms, slopes, residuals, deviation, normal, gradient)
            damping = max(damping * 0.1, 1e-9)
            if gain <= 1e-9 * misfit + 1e-12:
                break
        else:
            if iteration == 0:
                return np.inf
            damping *= 10.0
            if damping > 1e8:
                break
        if iteration == _ITERATIONS:
            break
        for a in range(6):
            for b in range(6):
                damped[a, b] = normal[a, b]
            damped[a, a] *= 1.0 + damping
            step[a] = -gradient[a]
        if not solve_definite(damped, step):
            break
        _rotation(step[3], step[4], step[5], turn)
        for a in range(3):
            trial[a, 3] = matrix[a, 3] + step[a]
            for b in range(3):
                trial[a, b] = 0.0
                for c in range(3):
                    trial[a, b] += turn[a, c] * matrix[c, b]
    return misfit


@njit(cache=True, nogil=True, error_model="numpy")
def _turn_points(points, matrix, arms, seen, slopes, lens, fisheye):
    """The points turned (``arms``), and where they are seen at the pose, with derivatives."""
    places = np.empty((len(points), 3))
    for i in range(len(points)):
        for a in range(3):
            arms[i, a] = 0.0
            for b in range(3):
                arms[i, a] += matrix[a, b] * points[i, b]
            places[i, a] = arms[i, a] + matrix[a, 3]
    project_points(places, lens, fisheye, seen, slopes)


@njit(cache=True, nogil=True, error_model="numpy")
def _normal_equations(arms, slopes, residuals, deviation, normal, gradient):
    """JᵀWJ (6, 6) and JᵀWr (6,) in deviations, of the shift and then the rotation."""
    row = np.empty(6)
    normal[:] = 0.0
    gradient[:] = 0.0
    for i in range(len(arms)):
        length = np.sqrt(residuals[i, 0] ** 2 + residuals[i, 1] ** 2)
        weight = min(1.0, _HUBER * deviation / max(length, 1e-12)) / (deviation * deviation)
        x, y, z = arms[i, 0], arms[i, 1], arms[i, 2]
        for side in range(2):
            a, b, c = slopes[i, side, 0], slopes[i, side, 1], slopes[i, side, 2]
            # A rotation w moves a point by w × arm: the slope of that is (arm × slope) · w.
            row[0], row[1], row[2] = a, b, c
            row[3], row[4], row[5] = y * c - z * b, z * a - x * c, x * b - y * a
            for j in range(6):
                gradient[j] += weight * row[j] * residuals[i, side]
                for k in range(6):
                    normal[j, k] += weight * row[j] * row[k]


@njit(cache=True, nogil=True, error_model="numpy")
def _rotation(x, y, z, turn):
    """Fill in the rotation (3, 3) of a rotation vector (x, y, z) rad, by Rodrigues."""
    square = x * x + y * y + z * z
    angle = np.sqrt(square)
    sine, cosine = 1.0 - square / 6.0, 0.5 - square / 24.0
    if angle > 1e-4:
        sine, cosine = np.sin(angle) / angle, (1.0 - np.cos(angle)) / square
    turn[0, 0] = 1.0 - cosine * (y * y + z * z)
    turn[1, 1] = 1.0 - cosine * (x * x + z * z)
    turn[2, 2] = 1.0 - cosine * (x * x + y * y)
    turn[0, 1], turn[1, 0] = cosine * x * y - sine * z, cosine * x * y + sine * z
    turn[0, 2], turn[2, 0] = cosine * x * z + sine * y, cosine * x * z - sine * y
    turn[1, 2], turn[2, 1] = cosine * y * z - sine * x, cosine * y * z + sine * x


# No linear algebra library is called, which would take long to compile.


@njit(cache=True, nogil=True, error_model="numpy")
def solve_definite(matrix, right):
    """Replace ``right`` (n,) by the solution, with Cholesky's factor of the matrix's (n, n) lower
    triangle, which is overwritten; False, with ``right`` spoilt, where it is not definite.
    """
    size = len(right)
    for i in range(size):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                matrix[i, i] = math.sqrt(total)
            else:
                matrix[i, j] = total / matrix[j, j]
    for i in range(size):
        for j in range(i):
            right[i] -= matrix[i, j] * right[j]
        right[i] /= matrix[i, i]
    for i in range(size - 1, -1, -1):
        for j in range(i + 1, size):
            right[i] -= matrix[j, i] * right[j]
        right[i] /= matrix[i, i]
    return True
