"""The pose of a body of markers from the places of its points in one image.

A plane has two poses in a perspective image: IPPE (Collins and Bartoli, "Infinitesimal plane-based
pose estimation", IJCV 109, 2014) gives both, Gauss-Newton refines them, and the evidence of all
images so far chooses one.

>>> from us_sim.tracking.camera.body_pose import estimate_body_poses
>>> from us_sim.tracking.camera.markers import compute_square_corners
>>> camera = CameraModel(640, 480, [[600, 0, 320], [0, 600, 240], [0, 0, 1]])
>>> true = Pose([0.02, 0.01, 0.4], [1.0, 0.2, 0.1, 0.0])
>>> corners = compute_square_corners(0.04)
>>> pixels = camera.project_points(true.transform_points(corners))
>>> poses = estimate_body_poses(camera, corners, pixels)
>>> poses[0].pose.position.round(6)
array([0.02, 0.01, 0.4 ])
>>> [round(each.error, 1) for each in poses]  # pixels, of the pose and of the other one
[0.0, 0.9]
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import rotation_between
from us_sim.tracking.camera.model import CameraModel

_TURN = cv2.Rodrigues(np.array([0.3, 0.5, 0.7]))[0]
"""Turns points before OpenCV sees them: its rotation vectors fail at half a turn, which every
marker that faces the camera has."""


_Guess = tuple[NDArray[np.float64], NDArray[np.float64]]  # rotation (3, 3), position (3,) m


def solve_plane_poses(points: NDArray[np.float64], rays: NDArray[np.float64]) -> list[_Guess]:
    """Find rotations (3, 3) and positions (3,) m that take points in a plane to their rays.

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
    """

    def __init__(self) -> None:
        self._evidence = 0.0  # log likelihood ratio of the pose that is followed to the other

    def reset(self) -> None:
        """Forget all images."""
        self._evidence = 0.0

    def choose_pose(self, found: list[BodyPose], before: Pose | None) -> BodyPose:
        """Choose the pose that follows the last one, unless by now the images favour the other."""
        if len(found) == 1 or before is None:
            return found[0]
        near, far = _by_nearness(found, before)
        return near if _FORGETTING * self._evidence + self._ratio(near, far) >= 0 else far

    def record_choice(
        self, found: list[BodyPose], pose: BodyPose, before: Pose | None
    ) -> NDArray[np.float64]:
        """Learn from an image of which a pose was chosen.

        Returns:
            Its covariance (6, 6), that of the mixture of both poses about the chosen one: the
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
        """Return the log likelihood ratio, with the noise estimated from the better of both."""
        better = one if one.misfit <= other.misfit else other
        return 0.5 * (other.misfit - one.misfit) * (CORNER_DEVIATION / better.deviation) ** 2


def _by_nearness(found: list[BodyPose], before: Pose) -> list[BodyPose]:
    return sorted(found, key=lambda each: rotation_angle(each.pose, before))


CORNER_DEVIATION = 0.1  # pixels, of a corner's coordinates in a sharp image with little noise

_FLAT = 1e-3  # thickness of a body, of its extent, up to which one homography shows all of it
_SAME = 1.0 + 2.0 * np.cos(np.radians(1.0))  # trace of the rotation between poses that are one
_TRIED = 3  # markers from which a pose is guessed
_REFINED = 3  # guesses that are refined
_ITERATIONS = 25
_STEADY = 1e-5  # of the misfit: a gain after which a pose moves by less than a hundredth deviation
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


def estimate_body_poses(
    camera: CameraModel,
    points: NDArray[np.float64],
    pixels: NDArray[np.float64],
    owners: NDArray[np.int64] | None = None,
    *,
    guess: Pose | None = None,
) -> list[BodyPose]:
    """Estimate the pose of a body of which points are seen, and the other that a plane may have.

    A square seen from afar looks nearly the same when it is tilted the opposite way about its line
    of sight. So both solutions of every marker (Collins and Bartoli 2014, IPPE) and the guess are
    held against all points, the best are refined, and what differs is returned.

    Args:
        camera: of the image.
        points: (N, 3) m, in the body's frame; four or more of each owner, in one plane.
        pixels: (N, 2), where the image has them.
        owners: (N,) the marker that each point is of; default: all are of one plane.
        guess: of the pose, for instance from the last image.

    Returns:
        At most two, that of the least error first; none where no pose has all points before the
        camera, fewer than four have a line of sight, or these do not determine a pose.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    pixels = np.ascontiguousarray(pixels, dtype=np.float64)
    rays = camera.compute_rays(pixels)
    if len(points) < 4 or not np.isfinite(rays).all():
        return []
    guesses = _guesses(points, rays, pixels, owners)
    if guess is not None:
        guesses.append((guess.rotation, guess.position))
    if not guesses:
        return []
    places = np.concatenate([points @ turn.T + place for turn, place in guesses])
    offsets = camera.project_points(places).reshape(-1, len(points), 2) - pixels
    misfits = [_misfit(_lengths(each)) for each in offsets]
    found: list[BodyPose] = []
    for i in np.argsort(misfits, kind="stable")[: _REFINED + 1].tolist():
        if not np.isfinite(misfits[i]):
            break
        turn, place = guesses[i]
        known = [each.pose.rotation for each in found]
        pose = _refine_pose(camera, points, pixels, turn, place, known)
        if pose is not None:
            found.append(pose)
    return sorted(found, key=lambda each: each.misfit)[:2]


def rotation_angle(one: Pose, other: Pose) -> float:
    """Return the angle (rad) of the rotation from one pose to another."""
    cosine = abs(float(one.orientation @ other.orientation))
    return 2.0 * float(np.arccos(min(1.0, cosine)))


def _guesses(
    points: NDArray[np.float64],
    rays: NDArray[np.float64],
    pixels: NDArray[np.float64],
    owners: NDArray[np.int64] | None,
) -> list[_Guess]:
    """Guess rotations and positions from the whole body if it is flat, or else from its markers."""
    spread = points - points.mean(axis=0)
    extents = np.linalg.svd(spread, compute_uv=False)
    flat = extents[2] <= _FLAT * extents[0]
    if owners is None or flat:
        return solve_plane_poses(points, rays)
    groups = [np.flatnonzero(owners == owner) for owner in np.unique(owners)]
    # The largest in the image tell most.
    groups.sort(key=lambda group: -float(np.ptp(pixels[group], axis=0).prod()))
    return [
        each for group in groups[:_TRIED] for each in solve_plane_poses(points[group], rays[group])
    ]


def _lengths(residuals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the lengths (N,) of residuals (N, 2), in deviations."""
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", residuals, residuals)) / CORNER_DEVIATION)


def _misfit(lengths: NDArray[np.float64]) -> float:
    """Return Huber's loss; infinite where a point is not before the camera."""
    near = np.minimum(lengths, _HUBER)
    total = float((near * (2.0 * lengths - near)).sum())
    return total if np.isfinite(total) else np.inf


def _refine_pose(
    camera: CameraModel,
    points: NDArray[np.float64],
    pixels: NDArray[np.float64],
    rotation: NDArray[np.float64],
    position: NDArray[np.float64],
    known: list[NDArray[np.float64]],
) -> BodyPose | None:
    """Descend to the pose of least misfit: Levenberg-Marquardt on SE(3) with Huber's weights.

    A step is a shift and a rotation about the camera's axes through the body's origin, so that
    the inverse of the normal matrix is the covariance as ROS has it.

    Returns:
        None where that leads to a known rotation or behind the camera, or the points do not
        determine a pose.
    """
    misfit, damping = np.inf, 1e-4
    for _ in range(_ITERATIONS + 1):
        if any(np.vdot(rotation, other) > _SAME for other in known):
            return None
        seen, slopes = camera.linearise_projection(points @ rotation.T, position)
        offsets = seen - pixels
        lengths = _lengths(offsets)
        loss = _misfit(lengths)
        if loss < misfit:
            gain, misfit, damping = misfit - loss, loss, max(damping * 0.1, 1e-9)
            matrix, residuals = np.eye(4), offsets
            matrix[:3, :3], matrix[:3, 3] = rotation, position
            weights = np.minimum(1.0, _HUBER / np.maximum(lengths, 1e-12))
            weighted = slopes.T * np.repeat(weights / CORNER_DEVIATION**2, 2)
            normal, gradient = weighted @ slopes, weighted @ residuals.ravel()
            if gain <= _STEADY * misfit + 1e-12:
                break
        elif not np.isfinite(misfit) or damping > 1e7:
            break
        else:
            damping *= 10.0
        try:
            step = -np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
        except np.linalg.LinAlgError:
            break
        position = matrix[:3, 3] + step[:3]
        rotation = np.asarray(cv2.Rodrigues(step[3:])[0]) @ matrix[:3, :3]
    if not np.isfinite(misfit):
        return None
    squares = float((residuals**2).sum())
    freedom = max(1, residuals.size - 6)
    left = min(squares, misfit * CORNER_DEVIATION**2)
    noise = max(CORNER_DEVIATION, float(np.sqrt(left / freedom)))
    scale = 1.0 / np.sqrt(np.diag(normal))
    values, vectors = np.linalg.eigh(normal * np.outer(scale, scale))
    if not values[0] > _DETERMINED:
        return None
    half = scale[:, None] * vectors / np.sqrt(values)
    covariance = half @ half.T * (noise / CORNER_DEVIATION) ** 2
    return BodyPose(
        Pose.from_matrix(matrix),
        0.5 * (covariance + covariance.T),
        float(np.sqrt(squares / len(points))),
        noise,
        residuals,
        misfit,
    )
