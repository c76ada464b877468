"""A body's pose from where its points are in one image: both of a plane's two, refined.

>>> import numpy as np
>>> from us_sim.pose import Pose
>>> from us_sim.tracking.body_pose import body_poses
>>> from us_sim.tracking.camera_model import CameraModel
>>> from us_sim.tracking.markers import square
>>> camera = CameraModel(640, 480, [[600, 0, 320], [0, 600, 240], [0, 0, 1]])
>>> true = Pose([0.02, 0.01, 0.4], [1.0, 0.2, 0.1, 0.0])
>>> poses = body_poses(camera, square(0.04), camera.project(true.apply(square(0.04))))
>>> poses[0].pose.position.round(6)
array([0.02, 0.01, 0.4 ])
>>> [round(each.error, 3) for each in poses]  # pixels, of the pose and of the other one
[0.0, 0.856]
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.pose import Pose
from us_sim.tracking.camera_model import CameraModel
from us_sim.tracking.plane_pose import plane_poses

__all__ = ["BodyPose", "body_poses", "rotation_angle"]

CORNER_DEVIATION = 0.1
"""Pixels, of a corner's coordinates in a sharp image with little noise."""

_FLAT = 1e-3  # thickness of a body, of its extent, up to which one homography shows all of it
_DISTINCT = np.radians(1.0)
_TRIED = 3  # markers from which a pose is guessed
_REFINED = 3  # guesses that are refined
_ITERATIONS = 25
_HUBER = 2.0  # standard deviations beyond which a corner pulls no harder


@dataclass(frozen=True, eq=False)
class BodyPose:
    """A pose of a body that explains an image, at least as well as any near it."""

    pose: Pose  # of the body in camera_optical
    covariance: NDArray[np.float64]  # (6, 6), as Measurement has it
    error: float  # pixels, root mean square over points of their distance
    deviation: float  # pixels, of a coordinate, by what is left over; at least what was assumed
    residuals: NDArray[np.float64]  # (N, 2) pixels, of the points as they were given
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

    A square seen from afar looks nearly the same when it is tilted the other way about its line
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
        camera, or fewer than four have a line of sight.
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
    """Levenberg-Marquardt on SE(3) with Huber's weights, from a first pose.

    The step is a shift and a rotation about the camera's axes through the body's origin, so that
    the inverse of the normal matrix is the covariance as ROS has it.
    """
    damping = 1e-4
    arms = points @ rotation.T
    seen, slopes = camera.linearise(arms + position)
    residuals = seen - pixels
    misfit = _misfit(residuals, deviation)
    normal = np.empty((6, 6))
    for _ in range(_ITERATIONS):
        if not np.isfinite(misfit):
            return None
        normal, gradient = _normal_equations(arms, slopes, residuals, deviation)
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -gradient)
        turn = np.asarray(cv2.Rodrigues(step[3:])[0])
        new_rotation, new_position = turn @ rotation, position + step[:3]
        new_arms = points @ new_rotation.T
        new_seen, new_slopes = camera.linearise(new_arms + new_position)
        new_misfit = _misfit(new_seen - pixels, deviation)
        if not new_misfit <= misfit:
            damping *= 10.0
            if damping > 1e8:
                break
            continue
        gain = misfit - new_misfit
        rotation, position, arms, slopes = new_rotation, new_position, new_arms, new_slopes
        residuals, misfit = new_seen - pixels, new_misfit
        damping = max(damping * 0.1, 1e-9)
        if gain <= 1e-9 * misfit + 1e-12:
            break
    normal, _ = _normal_equations(arms, slopes, residuals, deviation)
    squares = float((residuals**2).sum())
    freedom = max(1, residuals.size - 6)
    found = max(deviation, float(np.sqrt(min(squares, misfit * deviation**2) / freedom)))
    covariance = np.linalg.pinv(normal, hermitian=True) * (found / deviation) ** 2
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, position
    return BodyPose(
        Pose.from_matrix(matrix),
        0.5 * (covariance + covariance.T),
        float(np.sqrt(squares / len(points))),
        found,
        residuals,
        misfit,
    )


def _normal_equations(
    arms: NDArray[np.float64],
    slopes: NDArray[np.float64],
    residuals: NDArray[np.float64],
    deviation: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """JᵀWJ (6, 6) and JᵀWr (6,) in deviations, of the shift and then the rotation."""
    lengths = np.sqrt(np.einsum("ij,ij->i", residuals, residuals))
    weights = np.sqrt(np.minimum(1.0, _HUBER * deviation / np.maximum(lengths, 1e-12))) / deviation
    jacobian = np.empty((len(arms), 2, 6))
    jacobian[..., :3] = slopes
    # A rotation w moves a point by w × arm: the slope of that is (arm × slope) · w.
    jacobian[..., 3:] = np.cross(arms[:, None], slopes)
    jacobian *= weights[:, None, None]
    flat = jacobian.reshape(-1, 6)
    return flat.T @ flat, flat.T @ (residuals * weights[:, None]).ravel()
