"""How many small markers are kept of those that OpenCV finds, and how exact their corners are.

>>> from us_sim.evaluation.tracking.small_markers import small_marker_point
>>> point = small_marker_point("APRILTAG_36h11", 32.0, 4)
>>> point.views, point.kept == point.found_by_opencv > 0, point.median_px < 0.2
(4, True, True)
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.row import Row
from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import product, rotation_exp
from us_sim.tracking.camera.fiducial_detector import FiducialDetector
from us_sim.tracking.camera.markers import dictionary, square
from us_sim.tracking.camera.model import CameraModel
from us_sim.tracking.camera.rendered_views import Conditions, RenderedView
from us_sim.tracking.camera.rigid_body import RigidBody

_CAMERA = CameraModel(
    200,
    160,
    np.array([[600.0, 0.0, 99.3], [0.0, 601.0, 80.2], [0.0, 0.0, 1.0]]),
    np.array([-0.2, 0.06, 0.0, 0.0, 0.0]),
)
_SIZE = 0.04  # m, of the marker
_STEEPEST = 60.0  # degrees, to which a marker is tilted
_BLURS = (0.5, 1.2)  # pixels, of the lens
_NOISE = (1.0, 4.0)  # grey
_PLACES = 5.0  # pixels from the middle


@dataclass(frozen=True)
class SmallMarkerPoint(Row):
    """A row of small_markers.csv."""

    dictionary: str
    edge_px: float  # of a marker that faces the camera
    views: int
    found_by_opencv: int
    kept: int  # of those
    median_px: float  # error of a kept marker's worst corner
    p95_px: float
    worst_px: float
    opencv_p95_px: float  # the same of OpenCV's own corners, as it gives them


def small_marker_trials(quick: bool) -> Iterator[tuple[str, float, int]]:
    """What `small_marker_point` is asked for: dictionaries, edges in pixels, and views of each."""
    for name in ("APRILTAG_36h11", "APRILTAG_25h9", "4X4_50"):
        for edge in (14.0, 18.0, 24.0, 32.0, 44.0):
            yield name, edge, 40 if quick else 200


def small_marker_point(name: str, edge: float, views: int) -> SmallMarkerPoint:
    """Markers of a dictionary in views of a size, tilted by up to 60° and turned anyhow.

    Args:
        name: of the dictionary.
        edge: pixels, of a marker that faces the camera.
        views: how many.
    """
    random = np.random.default_rng([zlib.crc32(name.encode()), round(10 * edge)])
    plain = cv2.aruco.ArucoDetector(dictionary(name), cv2.aruco.DetectorParameters())
    found, ours, theirs = 0, [], []
    for number in range(views):
        body = RigidBody.single(name, int(random.integers(0, 30)), _SIZE)
        pose = _pose(random, edge)
        conditions = Conditions(defocus=random.uniform(*_BLURS), read_noise=random.uniform(*_NOISE))
        image = RenderedView(_CAMERA, body, number).render(pose, conditions, number)
        corners, ids, _ = plain.detectMarkers(image)
        seen = [] if ids is None else np.asarray(ids).ravel().tolist()
        if body.ids[0] not in seen:
            continue
        found += 1
        true = _CAMERA.project(pose.apply(square(_SIZE)))
        theirs.append(_error(np.reshape(corners[seen.index(body.ids[0])], (4, 2)), true))
        detection = FiducialDetector(body).detect(image)
        if len(detection.ids):
            ours.append(_error(detection.corners[0], true))
    median, most, worst = np.percentile(ours, [50, 95, 100]) if ours else 3 * [np.nan]
    by_opencv = float(np.percentile(theirs, 95)) if theirs else np.nan
    return SmallMarkerPoint(
        name, edge, views, found, len(ours), float(median), float(most), float(worst), by_opencv
    )


def _pose(random: np.random.Generator, edge: float) -> Pose:
    """Somewhere near the middle of the image, at the distance of that size."""
    about = random.uniform(0, 2 * np.pi)
    angle = np.radians(random.uniform(0, _STEEPEST))
    tilt = rotation_exp(angle * np.array([np.cos(about), np.sin(about), 0.0]))
    spin = rotation_exp(np.array([0.0, 0.0, random.uniform(0, 2 * np.pi)]))
    facing = rotation_exp(np.array([np.pi, 0.0, 0.0]))
    distance = float(_CAMERA.matrix[0, 0]) * _SIZE / edge
    pixel = np.array([100.0, 80.0]) + random.uniform(-_PLACES, _PLACES, 2)
    place = distance * np.append(_CAMERA.rays(pixel[None])[0], 1.0)
    return Pose(place, product(tilt, product(facing, spin)))


def _error(corners: NDArray[np.floating], true: NDArray[np.float64]) -> float:
    """Pixels, of the corner that is off by most."""
    return float(np.linalg.norm(corners - true, axis=1).max())
