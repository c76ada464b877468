"""Calibration of a camera from photos of a ChArUco board or a grid of markers.

Zhang, "A flexible new technique for camera calibration" (2000), with OpenCV; with it goes how much
the photos leave open.

>>> from us_sim.tracking.calibration.camera import find_board
>>> from us_sim.tracking.camera.rigid_body import RigidBody
>>> board = RigidBody.create_charuco("4X4_50", 5, 4, 0.02, 0.015)
>>> photo = np.full((320, 400), 255, np.uint8)
>>> photo[40:280, 50:350] = board.chessboard.board.generateImage((300, 240))
>>> seen = find_board(photo, board)
>>> len(seen), round(float(np.linalg.norm(seen.pixels[1] - seen.pixels[0])), 1)
(12, 60.0)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.errors import CalibrationError
from us_sim.settings.spelling import format_count
from us_sim.tracking.camera.fiducial_detector import FiducialDetector
from us_sim.tracking.camera.model import CameraModel
from us_sim.tracking.camera.rigid_body import RigidBody

_FEWEST_CORNERS = 6  # of a view: fewer do not determine the board's pose and an error


@dataclass(frozen=True, eq=False)
class BoardView:
    """The corners of a board that a photo shows."""

    points: NDArray[np.float32]  # (N, 3) m, on the board; z is 0
    pixels: NDArray[np.float32]  # (N, 2) column and row

    def __len__(self) -> int:
        return len(self.points)


def find_board(image: NDArray[np.uint8], board: RigidBody) -> BoardView | None:
    """Find a flat board's corners in a grey image (rows, columns), to a part of a pixel.

    Returns:
        None where it shows fewer than six, or they are all in one row.
    """
    seen = FiducialDetector(board).detect_markers(image)
    if board.chessboard is not None:
        # Where its markers are depends on how the board was drawn; where its squares meet does not.
        points, pixels = board.chessboard.corners[seen.chessboard_ids], seen.chessboard_corners
    else:
        points, pixels, _ = seen.match_points(board)
    if len(points) < _FEWEST_CORNERS:
        return None
    if np.linalg.matrix_rank(points[:, :2] - points[:, :2].mean(axis=0), tol=1e-6) < 2:
        return None
    return BoardView(points.astype(np.float32), pixels.astype(np.float32))


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
    """Find the camera whose pinhole and lens explain the views of one board best.

    Args:
        views: of the board from many places.
        width: pixels, of every photo.
        height: pixels, of every photo.

    Raises:
        CalibrationError: the views are too few or too alike to determine the camera.
    """
    if len(views) < _FEWEST_VIEWS:
        raise CalibrationError(
            f"the board is seen in {format_count(len(views), 'photo')}, and {_FEWEST_VIEWS} are "
            f"the least (20 are good): take more, tilted to all sides"
        )
    reach = _reach(views, width, height)
    if reach < _SMALLEST_REACH:
        raise CalibrationError(
            f"the board is always in the middle of the image ({100 * reach:.0f} % of the way to "
            f"its corners), so the lens cannot be told: take photos with the board near each edge"
        )
    found = _solve(views, np.ones(len(views), dtype=np.bool_), width, height, reach)
    # A blurred photo or a wrong corner stands out; more than a few are the rule.
    off = found.residuals > max(_FAR_OFF * float(np.median(found.residuals)), _GOOD_RMS)
    if off.any() and off.sum() <= min(_MOST_LEFT_OUT * len(views), len(views) - _FEWEST_VIEWS):
        found = _solve(views, ~off, width, height, reach)
    if found.rms > _LARGEST_RMS * _scale(width):
        raise CalibrationError(
            f"no camera fits the photos (RMS {found.rms:.1f} pixels): check the board's kind, size "
            f"and lengths"
        )
    if found.tilt >= _SMALLEST_TILT and found.focal_deviation <= _LARGEST_DEVIATION:
        return found
    if found.tilt < _SMALL_TILT:
        raise CalibrationError(
            f"the boards are all parallel (to {math.degrees(found.tilt):.1f}°), which leaves the "
            f"focal length open: take photos tilted to all sides by 30° or more"
        )
    raise CalibrationError(
        f"the photos leave the focal length open by {100 * found.focal_deviation:.0f} % (standard "
        f"deviation): take more, nearer, and tilted to all sides by 30° or more"
    )


def _solve(
    views: Sequence[BoardView], used: NDArray[np.bool_], width: int, height: int, reach: float
) -> CameraCalibration:
    """Solve for the camera by OpenCV, from the views that are used."""
    start: Any = None  # no camera to start from, which OpenCV's type hints do not know
    chosen = list(compress(views, used))
    try:
        points, pixels = [view.points for view in chosen], [view.pixels for view in chosen]
        rms, matrix, lens, turns, _, deviations, _, residuals = cv2.calibrateCameraExtended(
            points, pixels, (width, height), start, start
        )
    except cv2.error as error:
        raise CalibrationError(
            "no camera fits the photos: check the board's kind, size and lengths"
        ) from error
    if not np.isfinite(matrix).all() or not np.isfinite(deviations).all():
        raise CalibrationError(
            "the photos do not determine the camera: take 20, tilted to all sides by 30° or more"
        )
    camera = CameraModel(width, height, np.array(matrix), np.array(lens, np.float64).ravel()[:5])
    normals = np.array([cv2.Rodrigues(turn)[0][:, 2] for turn in turns])
    return CameraCalibration(
        camera,
        float(rms),
        np.array(residuals, np.float64).ravel(),
        used,
        np.array(deviations, np.float64).ravel()[: len(INTRINSICS)],
        float(np.arccos(np.clip(normals @ normals.T, -1.0, 1.0)).max()),
        reach,
    )


def _scale(width: int) -> float:
    return max(1.0, width / _USUAL_WIDTH)


def _reach(views: Sequence[BoardView], width: int, height: int) -> float:
    """Return the farthest corner's distance from the middle, over that of the image's corners."""
    middle = 0.5 * np.array([width - 1, height - 1])
    pixels = np.concatenate([view.pixels for view in views])
    return float(np.linalg.norm(pixels - middle, axis=1).max() / np.linalg.norm(middle))
