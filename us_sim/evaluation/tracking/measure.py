"""A tracker's errors, failures and run time in one case, and small markers' corners.

>>> from us_sim.evaluation.tracking.measure import mirrored, small_marker_point
>>> tilted = Pose([0.0, 0.0, 0.4], [np.sin(0.1), 0.0, 0.0, np.cos(0.1)])
>>> mirrored(tilted, np.zeros(3), np.array([0.0, 0.0, 1.0])).orientation.round(4) + 0.0
array([-0.0998,  0.    ,  0.    ,  0.995 ])
>>> point = small_marker_point("APRILTAG_36h11", 32.0, 4)
>>> point.views, point.kept == point.found_by_opencv > 0, point.median_px < 0.2
(4, True, True)
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.report import Row, percentile
from us_sim.evaluation.tracking.cases import CONDITIONS, MARKERS, SMALL, Case, Marker
from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import product, rotation_between, rotation_exp
from us_sim.tracking.camera.body_pose import body_poses, rotation_angle
from us_sim.tracking.camera.fiducial_detector import FiducialDetector
from us_sim.tracking.camera.markers import dictionary, square
from us_sim.tracking.camera.model import CameraModel
from us_sim.tracking.camera.rendered_views import WEBCAMS, Conditions, RenderedView
from us_sim.tracking.camera.rigid_body import RigidBody
from us_sim.tracking.camera.source import CameraSource
from us_sim.tracking.measurement import Measurement
from us_sim.tracking.settings import CameraSettings


@dataclass(frozen=True)
class View:
    """The tracker's result of one image."""

    first: bool  # of a sequence: nothing was known before
    ms: float  # wall clock
    cpu_ms: float
    detected: bool = False
    flipped: bool = False
    mm: float = np.nan  # of the body's middle
    degrees: float = np.nan
    used: int = 0  # markers
    visible: int = 0  # markers that the camera sees at less than the usual limit of the angle
    expected_mm: float = np.nan  # by the covariance, of the body's origin
    square: float = np.nan  # of the error in its own standard deviations (Mahalanobis)

    @property
    def inside(self) -> bool:
        """Whether the error is in the ellipsoid that should hold 95 % of them."""
        return self.square < 12.5916  # chi-square of six degrees of freedom


@dataclass(frozen=True)
class Point(Row):
    """A row of tracking.csv."""

    decimals = 4

    case: Case
    views: tuple[View, ...] = ()
    detector_cpu_ms: float = np.nan  # one whole image
    pose_cpu_ms: float = np.nan
    failure: str = ""

    @property
    def values(self) -> dict[str, object]:
        found = self.found
        return {
            "marker": self.case.marker,
            "image_size": self.case.image_size,
            "distance_m": self.case.distance,
            "angle_deg": self.case.angle,
            "condition": self.case.condition,
            "views": len(self.views),
            "detected": len(found),
            "flipped": self.flipped,
            "median_mm": self.error(50),
            "p95_mm": self.error(95),
            "median_deg": self.turned(50),
            "p95_deg": self.turned(95),
            "ms_median": percentile([view.ms for view in self.views], 50),
            "ms_first": percentile([view.ms for view in self.views if view.first], 50),
            "cpu_ms_median": self.cpu_ms,
            "detector_cpu_ms": self.detector_cpu_ms,
            "pose_cpu_ms": self.pose_cpu_ms,
            "markers_used": _mean([view.used for view in found]),
            "expected_mm": percentile([view.expected_mm for view in found], 50),
            "within_95": _mean([view.inside for view in found]),
            "failure": self.failure,
        }

    @property
    def title(self) -> str:
        return str(self.case)

    @property
    def found(self) -> list[View]:
        """Views in which the body was found."""
        return [view for view in self.views if view.detected]

    @property
    def flipped(self) -> int:
        """Views in which a mirror image of the pose was taken for it."""
        return sum(view.flipped for view in self.views)

    @property
    def cpu_ms(self) -> float:
        """Processor time of an image, median."""
        return percentile([view.cpu_ms for view in self.views], 50)

    def error(self, percent: float) -> float:
        """mm, percentile of the position's error."""
        return percentile([view.mm for view in self.found], percent)

    def turned(self, percent: float) -> float:
        """Degrees, percentile of the rotation's error."""
        return percentile([view.degrees for view in self.found], percent)


def select(points: Sequence[Point], **case: object) -> list[Point]:
    """Points whose case has these values, such as ``marker="aruco_40mm", distance=0.4``."""
    wanted = case.items()
    return [p for p in points if all(getattr(p.case, name) == value for name, value in wanted)]


def views_of(points: Sequence[Point], **case: object) -> list[View]:
    """All views of the points that `select` finds."""
    return [view for point in select(points, **case) for view in point.views]


class Bench:
    """Renders cases and tracks them; keeps the room of the last body."""

    def __init__(self) -> None:
        self._rooms: dict[tuple[str, str], RenderedView] = {}

    def warm_up(self) -> None:
        """Compile everything that is timed later."""
        for name in MARKERS:
            self.point(Case(name, SMALL, 0.4, 30.0), 1)

    def point(self, case: Case, sequences: int) -> Point:
        """Row of a case, from so many sequences of images."""
        seen, camera = MARKERS[case.marker], WEBCAMS[case.image_size]
        key = (case.marker, case.image_size)
        if key not in self._rooms:
            self._rooms = {key: RenderedView(camera, seen.body)}
        room = self._rooms[key]
        conditions, _ = CONDITIONS[case.condition]
        views: list[View] = []
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
                    views.append(_view(source, seen, frame, pose, image))
                    if frame == 0:
                        parts.append(_parts(camera, seen, image))
        finally:
            cv2.setNumThreads(threads)
        detector = percentile([part[0] for part in parts], 50)
        solver = percentile([part[1] for part in parts if np.isfinite(part[1])], 50)
        return Point(case, tuple(views), detector, solver)


def _view(
    source: CameraSource, seen: Marker, frame: int, true: Pose, image: NDArray[np.uint8]
) -> View:
    begin, processor = time.perf_counter(), time.thread_time()
    measured = source.measure(image, round(frame * 1e9 / 30))
    processor, wall = time.thread_time() - processor, time.perf_counter() - begin
    view = View(frame == 0, 1e3 * wall, 1e3 * processor, visible=visible(seen, true))
    if measured is None:
        return view
    return replace(_compared(view, measured, seen, true), used=source.seen)


def visible(seen: Marker, pose: Pose) -> int:
    """How many markers of a body face the camera, by less than its usual limit of the angle."""
    centres = pose.apply(seen.body.centres)
    cosines = -((seen.body.normals @ pose.rotation.T) * centres).sum(axis=1)
    cosines /= np.linalg.norm(centres, axis=1)
    return int((cosines > np.cos(CameraSettings().view_angle_limit)).sum())


def _compared(view: View, measured: Measurement, seen: Marker, true: Pose) -> View:
    found = measured.pose
    middle = seen.body.centres.mean(axis=0)
    off = (found.apply(middle[None]) - true.apply(middle[None]))[0]
    angle = rotation_angle(found, true)
    other = rotation_angle(found, mirrored(true, middle, seen.front))
    turn = rotation_between(found.orientation, true.orientation)
    error = np.concatenate([true.position - found.position, turn])
    square = np.nan
    if measured.covariance is not None:
        square = float(error @ np.linalg.pinv(measured.covariance, hermitian=True) @ error)
    return replace(
        view,
        detected=True,
        flipped=bool(other < angle and angle > np.radians(5.0)),
        mm=1e3 * float(np.linalg.norm(off)),
        degrees=float(np.degrees(angle)),
        expected_mm=1e3 * (measured.position_deviation or np.nan),
        square=square,
    )


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


def _parts(camera: CameraModel, seen: Marker, image: NDArray[np.uint8]) -> tuple[float, float]:
    """ms of processor time: finding markers in the whole image, and a pose from them."""
    detector = FiducialDetector(seen.body)
    begin = time.thread_time()
    detection = detector.detect(image)
    points, pixels, owners = detection.correspondences(seen.body)
    between = time.thread_time()
    if not len(points):
        return 1e3 * (between - begin), np.nan
    body_poses(camera, points, pixels, owners)
    return 1e3 * (between - begin), 1e3 * (time.thread_time() - between)


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


_CAMERA = CameraModel(
    200,
    160,
    np.array([[600.0, 0.0, 99.3], [0.0, 601.0, 80.2], [0.0, 0.0, 1.0]]),
    np.array([-0.2, 0.06, 0.0, 0.0, 0.0]),
)
_SIZE = 0.04  # m, of the marker


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
    """Arguments of `small_marker_point`: dictionaries, edges in pixels, and views of each."""
    for name in ("APRILTAG_36h11", "APRILTAG_25h9", "4X4_50"):
        for edge in (14.0, 18.0, 24.0, 32.0, 44.0):
            yield name, edge, 40 if quick else 200


def small_marker_point(name: str, edge: float, views: int) -> SmallMarkerPoint:
    """Markers of the dictionary ``name`` in so many views, tilted by up to 60° towards any side.

    The ``edge`` of a marker that faces the camera is in pixels.
    """
    random = np.random.default_rng([zlib.crc32(name.encode()), round(10 * edge)])
    plain = cv2.aruco.ArucoDetector(dictionary(name), cv2.aruco.DetectorParameters())
    found, ours, theirs = 0, [], []
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
