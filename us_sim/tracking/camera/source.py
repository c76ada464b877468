"""Poses of a body by a camera: images from a device, stream or file, a measurement from each.

>>> from us_sim.tracking.camera.source import CameraSource
>>> from us_sim.tracking.camera.markers import load_dictionary
>>> camera = CameraModel(640, 480, [[500, 0, 319.5], [0, 500, 239.5], [0, 0, 1]])
>>> source = CameraSource(camera, RigidBody.create_single("4X4_50", 7, 0.04))
>>> image = np.full((480, 640), 255, np.uint8)
>>> marker = cv2.aruco.generateImageMarker(load_dictionary("4X4_50"), 7, 80)
>>> image[200:280, 280:360] = marker
>>> source.measure_pose(image, 0).pose.position.round(2) + 0.0
array([0.  , 0.  , 0.25])
>>> source.measure_pose(np.zeros_like(image), 33_000_000)
>>> source.last_problem.partition(": ")[2]
'uncover the lens or add light'
"""

from __future__ import annotations

import math
import os
import time
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.errors import TrackingError
from us_sim.geometry.pose import Pose
from us_sim.settings.spelling import format_count
from us_sim.tracking.camera.body_pose import BodyPose, PlaneAmbiguity, estimate_body_poses
from us_sim.tracking.camera.fiducial_detector import Detection, FiducialDetector
from us_sim.tracking.camera.markers import find_largest_dictionary, load_dictionary
from us_sim.tracking.camera.model import CameraModel
from us_sim.tracking.camera.rigid_body import RigidBody
from us_sim.tracking.measurement import Measurement
from us_sim.tracking.settings import CameraSettings

REMEMBERED = 0.5
"""s, how long the last pose helps to find the next one and to tell it from its mirror image."""

VIEW_ANGLE_LIMIT = math.radians(75.0)
"""Angle between a marker's normal and the line of sight, beyond which it is not used."""

_REPROJECTION_LIMIT = 2.0  # pixels, root mean square between the corners seen and the pose's
_BLACK = 24  # grey, below which all of an image is when it shows nothing
_MARGIN = 0.35  # of the body's size in the image, around where it is looked for
_LEAST_MARGIN = 24  # pixels
_SEARCHED = 500_000  # pixels, of an image in which all is looked for at once
_SHORTEST = 40.0  # pixels, of a marker's edge in an image that is reduced to find it


class CameraSource:
    """Tracks one body of markers through the images of one camera."""

    def __init__(
        self, camera: CameraModel, body: RigidBody, settings: CameraSettings | None = None
    ) -> None:
        self.camera = camera
        self.body = body
        self.settings = settings or CameraSettings()
        self.last_problem = ""
        """Reason why the last image gave no measurement, or less; "" when all is well."""
        self.seen = 0
        """Markers of the body that the last measurement is made from."""
        self._detector = FiducialDetector(body)
        self._last: tuple[int, Pose] | None = None
        self._ambiguity = PlaneAmbiguity()

    def reset(self) -> None:
        """Forget the last pose."""
        self._last = None
        self._ambiguity.reset()

    def measure_pose(self, image: NDArray[np.uint8], stamp: int) -> Measurement | None:
        """Measure the body's pose in ``camera_optical``; None with the reason in ``last_problem``.

        Args:
            image: (rows, columns) grey.
            stamp: ns, the image's own.

        Raises:
            TrackingError: the image is not grey or not of the camera's size.
        """
        image = self.camera.require_image(image)
        self.last_problem = ""
        self.seen = 0
        before = self._before(stamp)
        detection = self._detect(image, before)
        if copied := detection.doubled:
            self.last_problem = (
                f"the image has two copies of {'marker' if len(copied) == 1 else 'markers'} "
                f"{', '.join(map(str, copied))}: none is used; show only one"
            )
        measured = self._pose(image, detection, before)
        if measured is None:
            return None
        pose, covariance = measured
        self._last = stamp, pose.pose
        return Measurement(stamp, pose.pose, covariance, pose.error)

    def _before(self, stamp: int) -> Pose | None:
        """Return the last pose, if it is from shortly before."""
        if self._last is None:
            return None
        if not 0 <= stamp - self._last[0] <= REMEMBERED * 1e9:
            self.reset()
            return None
        return self._last[1]

    def _detect(self, image: NDArray[np.uint8], before: Pose | None) -> Detection:
        """Find the body's markers, near their last places or else anywhere."""
        near = self._near(before) if before is not None else None
        if near is not None:
            detection = self._detector.detect_markers(image, *near)
            if self._is_enough(detection):
                return detection
        if image.size >= 4 * _SEARCHED:
            reduction = int(math.sqrt(image.size / _SEARCHED))
            detection = self._detector.detect_markers(image, reduction=reduction)
            if self._is_enough(detection):
                return detection
        return self._detector.detect_markers(image)

    def _is_enough(self, detection: Detection) -> bool:
        """Return whether there is no need to search further."""
        return (
            len(detection.ids) >= self.settings.minimum_markers
            or len(detection.chessboard_ids) >= 4
        )

    def _near(self, pose: Pose) -> tuple[tuple[int, int, int, int], int] | None:
        """Return the window around the body's last place, and the reduction of the image there."""
        corners = self.camera.project_points(
            pose.transform_points(self.body.corners.reshape(-1, 3))
        )
        if not np.isfinite(corners).all():
            return None
        low, high = corners.min(axis=0), corners.max(axis=0)
        margin = max(_LEAST_MARGIN, _MARGIN * float((high - low).max()))
        size = np.array([self.camera.width, self.camera.height])
        left, top = np.clip(np.floor(low - margin), 0, size).astype(int).tolist()
        right, bottom = np.clip(np.ceil(high + margin), 0, size).astype(int).tolist()
        if right - left < _LEAST_MARGIN or bottom - top < _LEAST_MARGIN:
            return None
        squares = corners.reshape(-1, 4, 2)
        edge = float(
            np.linalg.norm(squares[:, [0, 1]] - squares[:, [1, 2]], axis=2).max(axis=1).min()
        )
        return (left, top, right, bottom), max(1, min(4, int(edge / _SHORTEST)))

    def _pose(
        self, image: NDArray[np.uint8], detection: Detection, before: Pose | None
    ) -> tuple[BodyPose, NDArray[np.float64]] | None:
        """Estimate the pose and its covariance; see `measure_pose`."""
        points, pixels, owners = detection.match_points(self.body)
        if not len(points):
            self.last_problem = self.last_problem or self._nothing(image, detection)
            return None
        least = self.settings.minimum_markers
        refusal = ""
        # Each round leaves out what the pose of the round before shows to be unfit.
        while True:
            markers = np.unique(owners[owners >= 0])
            if len(markers) < least and self.body.chessboard is None:
                count = len(markers)
                self.last_problem = refusal or (
                    f"{format_count(count, 'marker of the body is', 'markers of the body are')} "
                    f"seen, fewer than the {least} of camera.minimum_markers"
                )
                return None
            found = estimate_body_poses(self.camera, points, pixels, owners, guess=before)
            if not found:
                self.last_problem = (
                    "what is seen of the body does not tell its pose: show more of it, and check "
                    "the camera info and the body's file"
                )
                return None
            pose = self._ambiguity.choose_pose(found, before)
            unfit, refusal = self._unfit(pose, owners)
            if not len(unfit):
                break
            kept = ~np.isin(owners, unfit)
            if not kept.any():
                self.last_problem = refusal
                return None
            points, pixels, owners = points[kept], pixels[kept], owners[kept]
            self.last_problem = refusal
        board = self.body.chessboard is not None
        self.seen = len(detection.ids) + len(detection.unclear) if board else len(markers)
        return pose, self._ambiguity.record_choice(found, pose, before)

    def _unfit(self, pose: BodyPose, owners: NDArray[np.int64]) -> tuple[NDArray[np.int64], str]:
        """Return the owners of points that cannot be used in a pose, and the reason."""
        markers = np.unique(owners)
        angles = self._view_angles(pose.pose, markers)
        steep = angles > VIEW_ANGLE_LIMIT
        if steep.any():
            worst = int(np.argmax(angles))
            return markers[steep], (
                f"{self._name(markers[worst])} is seen at "
                f"{math.degrees(angles[worst]):.0f}° from its normal, beyond the "
                f"{math.degrees(VIEW_ANGLE_LIMIT):.0f}° up to which its edges tell: it is not used"
            )
        if pose.error <= _REPROJECTION_LIMIT:
            return markers[:0], ""
        squares = (pose.residuals**2).sum(axis=1)
        errors = np.array([math.sqrt(squares[owners == marker].mean()) for marker in markers])
        worst = int(np.argmax(errors))
        if len(markers) > 2:
            return markers[[worst]], (
                f"{self._name(markers[worst])} is {errors[worst]:.1f} pixels from where "
                f"the others say: it is not used; check its place in the body's file"
            )
        return markers, (
            f"the corners are {pose.error:.1f} pixels from those of the best pose, where "
            f"{_REPROJECTION_LIMIT:g} are believed: check the body's file and the camera info"
        )

    def _name(self, row: int) -> str:
        return "the chessboard" if row < 0 else f"marker {self.body.ids[row]}"

    def _view_angles(self, pose: Pose, markers: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the angles (rad) between the markers' normals and the lines to the camera.

        The chessboard (-1) counts as the last marker on it.
        """
        normals = self.body.normals[markers] @ pose.rotation.T
        centres = pose.transform_points(self.body.centres[markers])
        cosines = -(normals * centres).sum(axis=1) / np.linalg.norm(centres, axis=1)
        return np.arccos(np.clip(cosines, -1.0, 1.0))

    def _nothing(self, image: NDArray[np.uint8], detection: Detection) -> str:
        if detection.unclear:
            return (
                f"of marker {detection.unclear[0]} an edge is covered, cut off or blurred: it is "
                f"not used"
            )
        start = f"no marker of the body ({self.body.dictionary}) is in the image"
        if int(image.max()) <= _BLACK:
            return f"{start}, which is black: uncover the lens or add light"
        others = self._find_others(image)
        if not others:
            return start
        listed = ", ".join(str(number) for number in others[:5])
        markers = format_count(len(others), "marker")
        return f"{start}, only {markers} that the body lacks ({listed}): check the body's numbers"

    def _find_others(self, image: NDArray[np.uint8]) -> list[int]:
        """Return the numbers of markers in the image that the body lacks."""
        parameters = cv2.aruco.DetectorParameters()
        parameters.errorCorrectionRate = 0.0
        known = load_dictionary(find_largest_dictionary(self.body.dictionary))
        ids = cv2.aruco.ArucoDetector(known, parameters).detectMarkers(image)[1]
        return [] if ids is None else np.unique(np.asarray(ids, dtype=np.int64)).tolist()


_PATIENCE_MS = 5000  # with a stream that is not there or sends nothing
_USUAL_RATE = 30.0  # Hz, of a file that does not say
_ERRORS_ONLY = 2  # of OpenCV's levels
_OLDEST_S = 1.0  # a camera's own time stamp is believed up to this age


class VideoSource:
    """A source of images, one after the other, that can be opened and closed any number of times.

    Args:
        source: a camera's number ("0"), its device ("/dev/video0"), the address of a stream, or
            a video file.
        size: width and height in pixels that a camera is asked for.
        rate: images a second that a camera is asked for, or at which a file is played; 0 leaves
            it to them.

    Raises:
        TrackingError: the file is not there, or it is a folder or a pipe.
    """

    def __init__(self, source: str, *, size: tuple[int, int] | None = None, rate: float = 0.0):
        self.name = source.strip()
        self._size, self._rate = size, rate
        self._capture: cv2.VideoCapture | None = None
        self._target = os.path.expanduser(self.name)
        may_come = self.name.startswith("/dev/") and not os.path.exists(self._target)
        is_live = self.name.isdigit() or "://" in self.name or may_come
        self.is_file = not is_live and os.path.isfile(self._target)
        if not (is_live or self.is_file or Path(self._target).is_char_device()):
            raise TrackingError(
                f"{source}: there is no such file or device; give a video, a camera's number or a "
                f"stream's address"
            )

    def open(self) -> bool:
        """Begin, or begin again, with the first image; return whether there is one."""
        self.close()
        _hush()
        if self.name.isdigit():
            capture = cv2.VideoCapture(int(self.name))
        elif "://" in self.name:
            patience = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, cv2.CAP_PROP_READ_TIMEOUT_MSEC]
            settings = [number for key in patience for number in (key, _PATIENCE_MS)]
            capture = cv2.VideoCapture(self.name, cv2.CAP_FFMPEG, settings)
        else:
            capture = cv2.VideoCapture(self._target)
        if not capture.isOpened():
            return False
        if not self.is_file:
            if self._size is not None:
                capture.set(cv2.CAP_PROP_FRAME_WIDTH, self._size[0])
                capture.set(cv2.CAP_PROP_FRAME_HEIGHT, self._size[1])
            if self._rate:
                capture.set(cv2.CAP_PROP_FPS, self._rate)
            capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        self._capture = capture
        return True

    def close(self) -> None:
        """Let go of the camera or file."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    @property
    def interval(self) -> float:
        """Time (s) between two images of a file."""
        rate = self._rate
        if not rate and self._capture is not None:
            rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        return 1.0 / (rate if 0.01 < rate < 1e4 else _USUAL_RATE)

    def grab_image(self) -> float | None:
        """Wait for the next image; return its age in s, or None where there is none any more.

        The age is 0 but for cameras under Linux, whose driver stamps its images.
        """
        if self._capture is None or not self._capture.grab():
            return None
        if self.is_file or self._capture.getBackendName() != "V4L2":
            return 0.0
        age = time.monotonic() - 1e-3 * float(self._capture.get(cv2.CAP_PROP_POS_MSEC))
        return age if 0.0 < age < _OLDEST_S else 0.0

    def retrieve_image(self, *, grey: bool) -> NDArray[np.uint8] | None:
        """Return the grabbed image, (rows, columns) or (rows, columns, 3) blue, green, red."""
        if self._capture is None:
            return None
        ok, image = self._capture.retrieve()
        if not ok or image is None or image.dtype != np.uint8:
            return None
        if image.ndim == 3 and image.shape[2] == 1:
            image = image[:, :, 0]
        if grey and image.ndim == 3:
            image = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        elif not grey and image.ndim == 2:
            image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
        return np.asarray(image, dtype=np.uint8)


def _hush() -> None:
    """Silence OpenCV and FFmpeg: the caller's sentence says that nothing is there."""
    # OpenCV 5 has moved it.
    set_level = getattr(cv2, "setLogLevel", None) or cv2.utils.logging.setLogLevel
    set_level(_ERRORS_ONLY)
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


def practise_tracking(body: RigidBody) -> bool:
    """Track a drawn marker or board, from nowhere and from near; return whether it was found."""
    camera = CameraModel(640, 480, np.array([[600.0, 0, 319.5], [0, 600.0, 239.5], [0, 0, 1]]))
    image = np.full((480, 640), 255, dtype=np.uint8)
    if body.chessboard is not None:
        image[40:440, 70:570] = body.chessboard.board.generateImage((500, 400))
    else:
        number = int(body.ids[0])
        body = RigidBody.create_single(body.dictionary, number, 0.04)
        marker = cv2.aruco.generateImageMarker(load_dictionary(body.dictionary), number, 120)
        image[180:300, 260:380] = marker
    source = CameraSource(camera, body)
    return all(source.measure_pose(image, stamp) for stamp in (0, 33_000_000))
