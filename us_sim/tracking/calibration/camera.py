"""Calibration of a camera from photos of a ChArUco board, a grid of markers, or a chessboard.

Zhang, "A flexible new technique for camera calibration" (2000), with OpenCV; with it goes how much
the photos leave open.

>>> from us_sim.tracking.calibration.camera import Board
>>> board = Board("chessboard", 6, 5, 0.02)
>>> squares = np.add.outer(np.arange(5), np.arange(6)) % 2 * 255
>>> photo = cv2.copyMakeBorder(np.kron(squares, np.ones((40, 40))).astype(np.uint8),
...                            60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)
>>> seen = board.find(photo)
>>> len(seen), round(float(np.linalg.norm(seen.pixels[1] - seen.pixels[0])), 1)
(20, 40.0)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import compress
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.errors import CalibrationError, TrackingError
from us_sim.settings.spelling import counted
from us_sim.tracking.camera.markers import dictionary
from us_sim.tracking.camera.model import CameraModel
from us_sim.tracking.settings import BOARD_LENGTH, BOARDS

_SEARCHED = 1600  # pixels, largest side of an image that is searched for a chessboard
_FEWEST_CORNERS = 6  # of a view: fewer do not determine the board's pose and an error


@dataclass(frozen=True, eq=False)
class BoardView:
    """The corners of a board that a photo shows."""

    points: NDArray[np.float32]  # (N, 3) m, on the board; z is 0
    pixels: NDArray[np.float32]  # (N, 2) column and row

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True)
class Board:
    """A printed pattern with known lengths.

    Raises:
        CalibrationError: it is of no known kind, too small, or a length is missing or impossible.
    """

    kind: str  # one of BOARDS
    columns: int  # squares, or of a grid markers
    rows: int
    square: float = 0.0  # m, of a chessboard and ChArUco
    marker: float = 0.0  # m, of a grid and ChArUco
    separation: float = 0.0  # m, between the markers of a grid
    dictionary: str = ""  # of the markers, e.g. 6X6_250
    legacy: bool = False  # white upper left square where the rows are even, as before OpenCV 4.6

    def __post_init__(self) -> None:
        if self.kind not in BOARDS:
            raise CalibrationError(f"there is no board '{self.kind}'; choose {', '.join(BOARDS)}")
        fewest = 1 if self.kind == "grid" else 3
        if min(self.columns, self.rows) < fewest or self.columns * self.rows < 4:
            raise CalibrationError(
                f"a board of {self.columns}x{self.rows} has too few corners; it needs at least "
                f"{'2x2 markers' if self.kind == 'grid' else '3x3 squares'}"
            )
        needed = {
            "charuco": ("square", "marker"),
            "grid": ("marker", "separation"),
            "chessboard": ("square",),
        }[self.kind]
        for name in needed:
            if not 0.0 < getattr(self, name) <= BOARD_LENGTH.maximum:
                raise CalibrationError(
                    f"a board of kind {self.kind} needs its {name} in metres or with a unit, as "
                    f"measured on the print"
                )
        if self.kind == "charuco" and self.marker >= self.square:
            raise CalibrationError(
                f"the board's marker ({1e3 * self.marker:g} mm) must be smaller than its square "
                f"({1e3 * self.square:g} mm)"
            )
        if self.kind != "chessboard":
            if not self.dictionary:
                raise CalibrationError(
                    f"a board of kind {self.kind} needs the dictionary of its markers, such as "
                    f"6X6_250: it is printed below a board of `us-sim print-marker`"
                )
            try:
                dictionary(self.dictionary)
            except TrackingError as error:
                raise CalibrationError(str(error)) from error

    def find(self, image: NDArray[np.uint8]) -> BoardView | None:
        """The board's corners in a grey image (rows, columns), to a part of a pixel.

        None where it shows fewer than six, or they are all in one row.
        """
        find = self._find_chessboard if self.kind == "chessboard" else self._find_markers
        seen = find(image)
        if seen is None or len(seen) < _FEWEST_CORNERS:
            return None
        places = seen.points[:, :2] - seen.points[:, :2].mean(axis=0)
        return seen if np.linalg.matrix_rank(places, tol=1e-6) == 2 else None

    def _find_chessboard(self, image: NDArray[np.uint8]) -> BoardView | None:
        size = (self.columns - 1, self.rows - 1)
        # A large photo is searched at a smaller size, since that takes its pixels' time.
        shrink = min(1.0, _SEARCHED / max(image.shape))
        searched = cv2.resize(image, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
        found, pixels = cv2.findChessboardCornersSB(
            searched if shrink < 1.0 else image,
            size,
            flags=cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY,
        )
        if not found:
            return None
        if shrink < 1.0:
            window = 2 + round(2.0 / shrink)
            pixels = cv2.cornerSubPix(
                image,
                ((_pixels(pixels) + 0.5) / shrink - 0.5).astype(np.float32),
                (window, window),
                (-1, -1),
                (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 1e-3),
            )
        rows, columns = np.indices(size[::-1])
        points = np.stack([columns, rows, np.zeros_like(rows)], axis=-1).reshape(-1, 3)
        return BoardView(np.float32(self.square) * points.astype(np.float32), _pixels(pixels))

    def _find_markers(self, image: NDArray[np.uint8]) -> BoardView | None:
        corners: Any
        if self.kind == "charuco":
            corners, ids, _, _ = self._charuco_detector.detectBoard(image)
        else:
            seen = self._marker_detector.detectMarkers(image)
            corners, ids, _, _ = self._marker_detector.refineDetectedMarkers(
                image, self._printed, *seen
            )
        if ids is None or not len(ids):
            return None
        points, pixels = self._printed.matchImagePoints(corners, ids)
        return None if points is None else BoardView(points.reshape(-1, 3), _pixels(pixels))

    @cached_property
    def _printed(self) -> Any:
        size = (self.columns, self.rows)
        markers = dictionary(self.dictionary)
        if self.kind == "charuco":
            board = cv2.aruco.CharucoBoard(size, self.square, self.marker, markers)
            board.setLegacyPattern(self.legacy)
            return board
        return cv2.aruco.GridBoard(size, self.marker, self.separation, markers)

    @cached_property
    def _marker_detector(self) -> cv2.aruco.ArucoDetector:
        settings = cv2.aruco.DetectorParameters()
        settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        return cv2.aruco.ArucoDetector(dictionary(self.dictionary), settings)

    @cached_property
    def _charuco_detector(self) -> cv2.aruco.CharucoDetector:
        settings = cv2.aruco.CharucoParameters()
        settings.tryRefineMarkers = True  # a marker missed at first is looked for where it must be
        return cv2.aruco.CharucoDetector(self._printed, settings)


def _pixels(found: Any) -> NDArray[np.float32]:
    """(N, 2), of OpenCV's (N, 1, 2)."""
    return np.asarray(found, np.float32).reshape(-1, 2)


INTRINSICS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")

_FEWEST_VIEWS = 3
_SMALLEST_TILT = math.radians(2.0)  # between two of the boards
_SMALL_TILT = math.radians(10.0)  # below which the tilt is to blame for what stays open
_SMALLEST_REACH = 0.3  # fraction of the distance from the middle to the image's corners
_GOOD_REACH = 0.7
_LARGEST_DEVIATION = 0.05  # of the focal lengths
_GOOD_DEVIATION = 0.01
_LARGEST_RMS = 5.0  # pixels, above which the board is not the one that was described
_GOOD_RMS = 1.0  # pixels; of images wider than this, more
_USUAL_WIDTH = 1280
_FAR_OFF = 3.0  # times the median residual of all views, for one that misleads
_MOST_LEFT_OUT = 0.25  # of the views


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """A camera and how well its photos determine it."""

    camera: CameraModel
    rms: float  # pixels, root mean square distance of all corners from where they should be
    residuals: NDArray[np.float64]  # (K,) pixels, the same of each view that was used
    used: NDArray[np.bool_]  # (N,) which of the views; the others fit far worse
    deviations: NDArray[np.float64]  # (9,) standard deviations of INTRINSICS
    tilt: float  # rad, the largest angle between two boards
    reach: float  # how far the corners go from the middle (0) to the image's corners (1)

    @property
    def note(self) -> str:
        """A sentence on parameters that the photos do not determine, or ""."""
        notes = []
        if self.rms > _GOOD_RMS * _scale(self.camera.width):
            notes.append(
                f"an RMS of {self.rms:.1f} pixels is large: hold the camera and the board still, "
                f"and the print flat"
            )
        if self.focal_deviation > _GOOD_DEVIATION:
            notes.append(
                f"the focal length is known to {100 * self.focal_deviation:.1f} % only: tilt the "
                f"board more, to all sides"
            )
        if self.reach < _GOOD_REACH:
            notes.append(
                f"what the lens does beyond {100 * self.reach:.0f} % of the way from the image's "
                f"middle to its corners is a guess: take photos with the board near each edge"
            )
        return "; ".join(notes)

    @property
    def focal_deviation(self) -> float:
        """Standard deviation of the focal lengths, relative, the larger."""
        return float((self.deviations[:2] / np.diag(self.camera.matrix)[:2]).max())


def calibrate_camera(views: Sequence[BoardView], width: int, height: int) -> CameraCalibration:
    """The camera whose pinhole and lens explain the views of one board from many places best.

    Width and height are those of all photos, in pixels.

    Raises:
        CalibrationError: the views are too few or too alike to determine the camera.
    """
    if len(views) < _FEWEST_VIEWS:
        raise CalibrationError(
            f"the board is seen in {counted(len(views), 'photo')}, and {_FEWEST_VIEWS} are the "
            f"least (20 are good): take more, tilted to all sides"
        )
    reach = _reach(views, width, height)
    if reach < _SMALLEST_REACH:
        raise CalibrationError(
            f"the board is always in the middle of the image ({100 * reach:.0f} % of the way to "
            f"its corners), so the lens cannot be told: take photos with the board near each edge"
        )
    used = np.ones(len(views), dtype=np.bool_)
    found = _solve(views, width, height)
    # A blurred photo or a wrong corner stands out; more than a few are the rule.
    off = found.residuals > max(_FAR_OFF * float(np.median(found.residuals)), _GOOD_RMS)
    if off.any() and off.sum() <= min(_MOST_LEFT_OUT * len(views), len(views) - _FEWEST_VIEWS):
        used = ~off
        found = _solve(list(compress(views, used)), width, height)
    if found.rms > _LARGEST_RMS * _scale(width):
        raise CalibrationError(
            f"no camera fits the photos (RMS {found.rms:.1f} pixels): check the board's kind, size "
            f"and lengths"
        )
    tilt = _largest_tilt(found.rotations)
    _check(found.matrix, found.deviations, tilt)
    camera = CameraModel(width, height, found.matrix, found.lens)
    fit = (found.rms, found.residuals, used, found.deviations)
    return CameraCalibration(camera, *fit, tilt, reach)


@dataclass(frozen=True, eq=False)
class _Solution:
    """OpenCV's solution."""

    rms: float
    matrix: NDArray[np.float64]  # (3, 3)
    lens: NDArray[np.float64]  # (5,)
    rotations: list[NDArray[np.float64]]  # (3, 3) of each view
    deviations: NDArray[np.float64]  # (9,)
    residuals: NDArray[np.float64]  # (K,)


def _solve(views: Sequence[BoardView], width: int, height: int) -> _Solution:
    start: Any = None  # no camera to start from, which OpenCV's type hints do not know
    try:
        points, pixels = [view.points for view in views], [view.pixels for view in views]
        rms, matrix, lens, turns, _, deviations, _, residuals = cv2.calibrateCameraExtended(
            points, pixels, (width, height), start, start
        )
    except cv2.error as error:
        raise CalibrationError(
            "no camera fits the photos: check the board's kind, size and lengths"
        ) from error
    return _Solution(
        float(rms),
        np.array(matrix, np.float64),
        np.array(lens, np.float64).ravel()[:5],
        [np.asarray(cv2.Rodrigues(turn)[0], np.float64) for turn in turns],
        np.array(deviations, np.float64).ravel()[: len(INTRINSICS)],
        np.array(residuals, np.float64).ravel(),
    )


def _check(matrix: NDArray[np.float64], deviations: NDArray[np.float64], tilt: float) -> None:
    if not np.isfinite(matrix).all() or not np.isfinite(deviations).all():
        raise CalibrationError(
            "the photos do not determine the camera: take 20, tilted to all sides by 30° or more"
        )
    relative = float((deviations[:2] / np.diag(matrix)[:2]).max())
    if tilt >= _SMALLEST_TILT and relative <= _LARGEST_DEVIATION:
        return
    if tilt < _SMALL_TILT:
        raise CalibrationError(
            f"the boards are all parallel (to {math.degrees(tilt):.1f}°), which leaves the focal "
            f"length open: take photos tilted to all sides by 30° or more"
        )
    raise CalibrationError(
        f"the photos leave the focal length open by {100 * relative:.0f} % (standard deviation): "
        f"take more, nearer, and tilted to all sides by 30° or more"
    )


def _scale(width: int) -> float:
    return max(1.0, width / _USUAL_WIDTH)


def _reach(views: Sequence[BoardView], width: int, height: int) -> float:
    """How far corners go from the image's middle: 0 not at all, 1 to its corners."""
    middle = 0.5 * np.array([width - 1, height - 1])
    pixels = np.concatenate([view.pixels for view in views])
    return float(np.linalg.norm(pixels - middle, axis=1).max() / np.linalg.norm(middle))


def _largest_tilt(rotations: Sequence[NDArray[np.float64]]) -> float:
    """rad, the largest angle between the normals of two boards."""
    normals = np.array([rotation[:, 2] for rotation in rotations])
    return float(np.arccos(np.clip(normals @ normals.T, -1.0, 1.0)).max())
