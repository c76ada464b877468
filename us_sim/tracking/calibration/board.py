"""Boards whose photos calibrate a camera: ChArUco, a grid of ArUco markers, a chessboard.

>>> import cv2, numpy as np
>>> from us_sim.tracking.calibration.board import Board
>>> board = Board("chessboard", 6, 5, 0.02)
>>> squares = np.add.outer(np.arange(5), np.arange(6)) % 2 * 255
>>> photo = cv2.copyMakeBorder(np.kron(squares, np.ones((40, 40))).astype(np.uint8),
...                            60, 60, 60, 60, cv2.BORDER_CONSTANT, value=255)
>>> seen = board.find(photo)
>>> len(seen), round(float(np.linalg.norm(seen.pixels[1] - seen.pixels[0])), 1)
(20, 40.0)
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.errors import CalibrationError, TrackingError
from us_sim.tracking.calibration.settings import BOARD_LENGTH, BOARDS
from us_sim.tracking.camera.markers import dictionary

_SEARCHED = 1600  # pixels, largest side of an image that is searched for a chessboard
_Corners = tuple[NDArray[np.float32], NDArray[np.float32]]
"""(N, 3) m on the board and (N, 2) pixels, as of a `BoardView`."""
_NOTHING: _Corners = np.empty((0, 3), np.float32), np.empty((0, 2), np.float32)
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
        points, pixels = find(image)
        if len(points) < _FEWEST_CORNERS:
            return None
        if np.linalg.matrix_rank(points[:, :2] - points[:, :2].mean(axis=0), tol=1e-6) < 2:
            return None
        return BoardView(points, pixels)

    def _find_chessboard(self, image: NDArray[np.uint8]) -> _Corners:
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
            return _NOTHING
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
        return np.float32(self.square) * points.astype(np.float32), _pixels(pixels)

    def _find_markers(self, image: NDArray[np.uint8]) -> _Corners:
        corners: Any
        if self.kind == "charuco":
            corners, ids, _, _ = self._charuco_detector.detectBoard(image)
        else:
            seen = self._marker_detector.detectMarkers(image)
            corners, ids, _, _ = self._marker_detector.refineDetectedMarkers(
                image, self._printed, *seen
            )
        if ids is None or not len(ids):
            return _NOTHING
        points, pixels = self._printed.matchImagePoints(corners, ids)
        if points is None:
            return _NOTHING
        return points.reshape(-1, 3), _pixels(pixels)

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
