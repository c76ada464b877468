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

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import rotation_between
from us_sim.kernels import njit
from us_sim.tracking.camera.model import CameraModel, project_points


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
    """Fill in both rotations, positions and errors (infinite for no pose); return whether there
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
    # The rest of the diagonal by Cholesky's factor tells whether the points are enough.
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


CORNER_DEVIATION = 0.1
"""Pixels, of a corner's coordinates in a sharp image with little noise."""

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
        (_misfit(_residuals(camera, points, pixels, *each), deviation), i)
        for i, each in enumerate(guesses)
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


def _residuals(
    camera: CameraModel,
    points: NDArray[np.float64],
    pixels: NDArray[np.float64],
    rotation: NDArray[np.float64],
    position: NDArray[np.float64],
) -> NDArray[np.float64]:
    return camera.project(points @ rotation.T + position) - pixels


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
