"""A tracker's errors, failures and run time in one case, and small markers' corners.

>>> from us_sim.evaluation.tracking.measure import mirrored, small_marker_row
>>> tilted = Pose([0.0, 0.0, 0.4], [np.sin(0.1), 0.0, 0.0, np.cos(0.1)])
>>> mirrored(tilted, np.zeros(3), np.array([0.0, 0.0, 1.0])).orientation.round(4) + 0.0
array([-0.0998,  0.    ,  0.    ,  0.995 ])
>>> (row,) = small_marker_row("APRILTAG_36h11", 32.0, 4)
>>> row["kept"] == row["found_by_opencv"] > 0, row["median_px"] < 0.2
(True, True)
"""

from __future__ import annotations

import time
import zlib
from typing import Any

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from us_sim.evaluation.report import percentile
from us_sim.evaluation.tracking.cases import CONDITIONS, MARKERS, Case, Marker
from us_sim.geometry.pose import Pose, product
from us_sim.geometry.se3 import rotation_between, rotation_exp
from us_sim.tracking.camera.body_pose import body_poses, rotation_angle
from us_sim.tracking.camera.fiducial_detector import FiducialDetector
from us_sim.tracking.camera.markers import dictionary, square
from us_sim.tracking.camera.model import CameraModel
from us_sim.tracking.camera.rendered_views import WEBCAMS, Conditions, RenderedView
from us_sim.tracking.camera.rigid_body import RigidBody
from us_sim.tracking.camera.source import CameraSource
from us_sim.tracking.measurement import Measurement
from us_sim.tracking.settings import CameraSettings

_INSIDE = 12.5916  # chi-square of six degrees of freedom, that 95 % of errors stay below


class Tracking:
    """Renders cases and tracks them; keeps the room of the last body."""

    def __init__(self) -> None:
        self._rooms: dict[tuple[str, str], RenderedView] = {}

    def row(self, case: Case, sequences: int) -> list[dict[str, Any]]:
        """Row of a case, from so many sequences of images; its ``shots`` are a row a view."""
        seen, camera = MARKERS[case.marker], WEBCAMS[case.image_size]
        key = (case.marker, case.image_size)
        is_new = key not in self._rooms
        if is_new:
            self._rooms = {key: RenderedView(camera, seen.body)}
        room = self._rooms[key]
        conditions, _ = CONDITIONS[case.condition]
        rows: list[dict[str, Any]] = []
        parts: list[tuple[float, float]] = []
        threads = cv2.getNumThreads()
        cv2.setNumThreads(1)
        try:
            for number in range(sequences):
                source = CameraSource(camera, seen.body)
                seed = zlib.crc32(f"{case} {number}".encode())
                for frame, pose in enumerate(case.sequence(number)):
                    # The hand and the light stay as they are through a sequence, not the noise.
                    image = room.render(pose, conditions, seed, case.motion(number), frame)
                    if is_new:  # what is compiled now must not count
                        CameraSource(camera, seen.body).measure(image, 0)
                        _time_parts(camera, seen, image)
                        is_new = False
                    rows.append(_view(source, seen, frame, pose, image))
                    if frame == 0:
                        parts.append(_time_parts(camera, seen, image))
        finally:
            cv2.setNumThreads(threads)
        views = pd.DataFrame(rows)
        found = views[views["detected"]]
        detector, solver = np.array(parts).T
        return [
            {
                "views": len(views),
                "detected": len(found),
                "flipped": int(found["flipped"].sum()),
                "median_mm": found["mm"].median(),
                "p95_mm": found["mm"].quantile(0.95),
                "median_deg": found["degrees"].median(),
                "p95_deg": found["degrees"].quantile(0.95),
                "ms_median": views["ms"].median(),
                "ms_first": views["ms"][views["first"]].median(),
                "cpu_ms_median": views["cpu_ms"].median(),
                "detector_cpu_ms": percentile(detector, 50),
                "pose_cpu_ms": percentile(solver[np.isfinite(solver)], 50),
                "markers_used": found["used"].mean(),
                "expected_mm": found["expected_mm"].median(),
                "within_95": found["inside"].mean(),
                "shots": views,
            }
        ]


def _view(
    source: CameraSource, seen: Marker, frame: int, true: Pose, image: NDArray[np.uint8]
) -> dict[str, Any]:
    """What the tracker says of one image, and how far it is off."""
    begin, processor = time.perf_counter(), time.thread_time()
    measured = source.measure(image, round(frame * 1e9 / 30))
    processor, wall = time.thread_time() - processor, time.perf_counter() - begin
    return {
        "first": frame == 0,  # of a sequence: nothing was known before
        "ms": 1e3 * wall,
        "cpu_ms": 1e3 * processor,
        "visible": visible(seen, true),
        "detected": measured is not None,
        "used": source.seen if measured else 0,
        **_compared(measured, seen, true),
    }


def visible(seen: Marker, pose: Pose) -> int:
    """How many markers of a body face the camera, by less than its usual limit of the angle."""
    centres = pose.apply(seen.body.centres)
    cosines = -((seen.body.normals @ pose.rotation.T) * centres).sum(axis=1)
    cosines /= np.linalg.norm(centres, axis=1)
    return int((cosines > np.cos(CameraSettings().view_angle_limit)).sum())


def _compared(measured: Measurement | None, seen: Marker, true: Pose) -> dict[str, Any]:
    """Errors of the body's middle and turn, and what the covariance says of the origin's."""
    if measured is None:
        unknown = dict.fromkeys(("mm", "degrees", "expected_mm"), np.nan)
        return {"flipped": False, **unknown, "inside": False}
    found = measured.pose
    middle = seen.body.centres.mean(axis=0)
    off = (found.apply(middle[None]) - true.apply(middle[None]))[0]
    angle = rotation_angle(found, true)
    other = rotation_angle(found, mirrored(true, middle, seen.front))
    turn = rotation_between(found.orientation, true.orientation)
    error = np.concatenate([true.position - found.position, turn])
    square = np.nan  # of the error in its own standard deviations (Mahalanobis)
    if measured.covariance is not None:
        square = float(error @ np.linalg.pinv(measured.covariance, hermitian=True) @ error)
    return {
        "flipped": bool(other < angle and angle > np.radians(5.0)),
        "mm": 1e3 * float(np.linalg.norm(off)),
        "degrees": float(np.degrees(angle)),
        "expected_mm": 1e3 * (measured.position_deviation or np.nan),
        "inside": square < _INSIDE,
    }


def mirrored(pose: Pose, middle: NDArray[np.float64], front: NDArray[np.float64]) -> Pose:
    """The pose that a plane seen from afar may be taken for: tilted to the other side.

    The pose is of the body in ``camera_optical``; its middle (3,) m, and the unit normal (3,) of
    its front, are in its own frame.
    """
    sight = pose.apply(middle[None])[0]
    sight = sight / np.linalg.norm(sight)
    matrix = np.eye(4)
    before, behind = np.eye(3) - 2 * np.outer(sight, sight), np.eye(3) - 2 * np.outer(front, front)
    matrix[:3, :3] = before @ pose.rotation @ behind
    matrix[:3, 3] = pose.position
    return Pose.from_matrix(matrix)


def _time_parts(camera: CameraModel, seen: Marker, image: NDArray[np.uint8]) -> tuple[float, float]:
    """Time (ms, processor) the search for markers in a whole image, and a pose from them."""
    detector = FiducialDetector(seen.body)
    begin = time.thread_time()
    detection = detector.detect(image)
    points, pixels, owners = detection.correspondences(seen.body)
    between = time.thread_time()
    if not len(points):
        return 1e3 * (between - begin), np.nan
    body_poses(camera, points, pixels, owners)
    return 1e3 * (between - begin), 1e3 * (time.thread_time() - between)


_CAMERA = CameraModel(
    200,
    160,
    np.array([[600.0, 0.0, 99.3], [0.0, 601.0, 80.2], [0.0, 0.0, 1.0]]),
    np.array([-0.2, 0.06, 0.0, 0.0, 0.0]),
)
_SIZE = 0.04  # m, of the marker


def small_marker_row(name: str, edge: float, views: int) -> list[dict[str, Any]]:
    """Row of the dictionary's markers in so many views, tilted by up to 60° towards any side.

    The ``edge`` of a marker that faces the camera is in pixels; errors are of a marker's worst
    corner.
    """
    random = np.random.default_rng([zlib.crc32(name.encode()), round(10 * edge)])
    plain = cv2.aruco.ArucoDetector(dictionary(name), cv2.aruco.DetectorParameters())
    ours: list[float] = []
    theirs: list[float] = []
    for number in range(views):
        body = RigidBody.single(name, int(random.integers(0, 30)), _SIZE)
        pose = _pose(random, edge)
        conditions = Conditions(
            defocus=random.uniform(0.5, 1.2), read_noise=random.uniform(1.0, 4.0)
        )
        image = RenderedView(_CAMERA, body, number).render(pose, conditions, number)
        corners, ids, _ = plain.detectMarkers(image)
        seen = [] if ids is None else np.asarray(ids).ravel().tolist()
        if body.ids[0] not in seen:
            continue
        true = _CAMERA.project(pose.apply(square(_SIZE)))
        theirs.append(_error(np.reshape(corners[seen.index(body.ids[0])], (4, 2)), true))
        detection = FiducialDetector(body).detect(image)
        if len(detection.ids):
            ours.append(_error(detection.corners[0], true))
    return [
        {
            "views": views,
            "found_by_opencv": len(theirs),
            "kept": len(ours),
            "median_px": percentile(ours, 50),
            "p95_px": percentile(ours, 95),
            "worst_px": percentile(ours, 100),
            "opencv_p95_px": percentile(theirs, 95),
        }
    ]


def _pose(random: np.random.Generator, edge: float) -> Pose:
    """Somewhere near the middle of the image, at the distance of that size."""
    about = random.uniform(0, 2 * np.pi)
    angle = np.radians(random.uniform(0, 60.0))
    tilt = rotation_exp(angle * np.array([np.cos(about), np.sin(about), 0.0]))
    spin = rotation_exp(np.array([0.0, 0.0, random.uniform(0, 2 * np.pi)]))
    facing = rotation_exp(np.array([np.pi, 0.0, 0.0]))
    distance = float(_CAMERA.matrix[0, 0]) * _SIZE / edge
    pixel = np.array([100.0, 80.0]) + random.uniform(-5.0, 5.0, 2)
    place = distance * np.append(_CAMERA.rays(pixel[None])[0], 1.0)
    return Pose(place, product(tilt, product(facing, spin)))


def _error(corners: NDArray[np.floating], true: NDArray[np.float64]) -> float:
    """Pixels, of the corner that is off by most."""
    return float(np.linalg.norm(corners - true, axis=1).max())
