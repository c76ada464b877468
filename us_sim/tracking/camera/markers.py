"""Fiducial markers: their dictionaries, their corners, and a fit of a small marker's whole pattern.

An edge of a small marker is too few pixels to fit by itself. So the pattern, which is known, is
drawn as the camera would see it, and its homography, blur, greys and the light's slope across it
are changed until image and drawing differ least: Gauss-Newton with steps composed onto the
homography (Lucas and Kanade 1981; Baker and Matthews 2004, section 3). The residual tells whether
all of the marker is in view.

>>> from us_sim.tracking.camera.markers import load_dictionary, compute_square_corners
>>> load_dictionary("6X6_250").bytesList.shape[0]
250
>>> compute_square_corners(0.04)[0]
array([-0.02,  0.02,  0.  ])
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.errors import TrackingError
from us_sim.tracking.settings import DICTIONARIES


@lru_cache(maxsize=32)
def load_dictionary(name: str) -> cv2.aruco.Dictionary:
    """Load OpenCV's dictionary of a name, with or without ``DICT_``.

    Raises:
        TrackingError: there is no such dictionary, or OpenCV is too old to find markers.
    """
    if not hasattr(getattr(cv2, "aruco", None), "ArucoDetector"):
        raise TrackingError(
            f"fiducial markers need OpenCV 4.8 or newer, and OpenCV {cv2.__version__} is "
            f"installed: run pip install 'opencv-python-headless>=4.8', where ROS 2 is with "
            f"--break-system-packages and '<4.12'"
        )
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{normalise_name(name)}"))


def normalise_name(name: str) -> str:
    """Return the name as `DICTIONARIES` writes it.

    Raises:
        TrackingError: there is no such dictionary.
    """
    plain = str(name).upper().removeprefix("DICT_")
    for known in DICTIONARIES:
        if known.upper() == plain:
            return known
    raise TrackingError(
        f"there is no marker dictionary '{name}'; choose one of {', '.join(DICTIONARIES)}"
    )


def count_markers(name: str) -> int:
    """Count the markers of a dictionary; they are numbered from 0."""
    return int(load_dictionary(name).bytesList.shape[0])


def find_largest_dictionary(name: str) -> str:
    """Return the largest dictionary that has this one's markers under the same numbers."""
    bits, _, count = name.rpartition("_")
    return f"{bits}_1000" if count.isdigit() else name


def compute_square_corners(size: float) -> NDArray[np.float64]:
    """Return the corners (4, 3) m of a marker's black square about its middle, in OpenCV's order.

    x is to its right, y up and z out of the paper, towards who looks at it; the corners are the
    upper left one and on, clockwise.
    """
    half = 0.5 * size
    return np.array([[-half, half, 0.0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])


_DRAWN = 4  # pixels a cell of the drawing from which views are made
_FINER = 3  # times as many pixels along a side, of which each of a view is the mean
_BEYOND = 0.5  # cells of white about the marker, to which the drawing is fitted
_JUDGED = 0.1  # cells about the marker, in which what is left over is judged
_MARGIN = 3  # pixels about that, for steps
_STEPS = 16
_NEAR, _STEADY = 0.1, 0.01  # pixels
_FARTHEST = 4.0  # pixels that a corner may move
_BLURS = (0.4, 2.0)  # pixels, standard deviations
_LEAST_CONTRAST = 10.0  # grey
_DOUBTED = 0.15  # of the contrast, left over, from which a pixel pulls less
_UNEXPLAINED = 0.2  # of the contrast, root mean square, of a marker that is all in view
_COVERED = 0.5  # the same about any place: more is a hand, or another thing before the marker


@lru_cache(maxsize=1024)
def compute_marker_cells(name: str, number: int) -> NDArray[np.uint8]:
    """Return the cells (n, n) of a marker of a dictionary, 0 or 1, with one of white about it."""
    marker = load_dictionary(name)
    cells = cv2.aruco.generateImageMarker(marker, number, marker.markerSize + 2)
    found = np.pad(np.asarray(cells, dtype=np.uint8) // 255, 1, constant_values=1)
    found.flags.writeable = False
    return found


def fit_corners(
    image: NDArray[np.uint8], corners: NDArray[np.float64], cells: NDArray[np.uint8]
) -> NDArray[np.float64] | None:
    """Fit the corners (4, 2) pixels of a marker's black square.

    Args:
        image: (rows, columns) grey.
        corners: (4, 2) pixels, to about two pixels, in the pattern's order.
        cells: (n, n) as `compute_marker_cells` gives them.

    Returns:
        None where image and pattern differ: covered, cut, or another thing.
    """
    view = _View(image, corners, cells)
    before = view.corners
    # Only once drawing and image lie on one another can it be told what does not belong there.
    doubting = False
    for number in range(_STEPS):
        if not view.step(doubting):
            return None
        moved = float(np.abs(view.corners - before).max())
        if not np.abs(view.corners - corners).max() < _FARTHEST:
            return None
        if moved < _STEADY and doubting:
            break
        doubting = doubting or moved < _NEAR or number >= _STEPS // 2
        before = view.corners
    last = np.array([image.shape[1], image.shape[0]]) - 0.5
    if not (view.corners.min() > -0.5 and (view.corners < last).all()):
        return None
    return view.corners if view.is_explained() else None


class _View:
    """A marker's pattern drawn over a part of an image, and their difference."""

    def __init__(
        self, image: NDArray[np.uint8], corners: NDArray[np.float64], cells: NDArray[np.uint8]
    ) -> None:
        count = len(cells)
        self._drawing = np.kron(cells, np.ones((_DRAWN, _DRAWN), np.float32))
        self._square = _square(1.0, count - 1.0)
        self._seen = _square(1.0 - _BEYOND, count - 1.0 + _BEYOND)
        self._judged = _square(1.0 - _JUDGED, count - 1.0 + _JUDGED)
        self._cells = count
        homography = cv2.getPerspectiveTransform(
            self._square.astype(np.float32), corners.astype(np.float32)
        )
        around = _mapped(np.array(homography), self._seen)
        size = np.array([image.shape[1], image.shape[0]])
        first = np.clip(np.floor(around.min(axis=0)) - _MARGIN, 0, size - 2).astype(int)
        last = np.clip(np.ceil(around.max(axis=0)) + _MARGIN + 1, first + 2, size).astype(int)
        self._first = first
        self._part = image[first[1] : last[1], first[0] : last[0]].astype(np.float32)
        # Coordinates from -1 to 1, so that all of a homography's numbers are of one size.
        middle, half = 0.5 * (last - first), 0.5 * float((last - first).max())
        self._to_unit = np.array(
            [[1 / half, 0, -middle[0] / half], [0, 1 / half, -middle[1] / half], [0, 0, 1]]
        )
        self._half = half
        rows, columns = np.indices(self._part.shape, dtype=np.float32)
        self._x, self._y = (columns - middle[0]) / half, (rows - middle[1]) / half
        shift = np.array([[1.0, 0, -first[0]], [0, 1, -first[1]], [0, 0, 1]])
        self._homography = shift @ homography
        self._blur = 0.7
        self._left = np.zeros_like(self._part)
        self._contrast = 0.0

    @property
    def corners(self) -> NDArray[np.float64]:
        """(4, 2) pixels of the image."""
        return _mapped(self._homography, self._square) + self._first

    def step(self, doubting: bool) -> bool:
        """Take a step of Gauss and Newton; return whether it leads anywhere.

        When doubting, a pixel that differs by far is a hand's, or a gleam's: it pulls less
        (Cauchy's weights).
        """
        drawn = self._draw()
        within = self._within(self._seen)
        down, right = (np.asarray(np.gradient(drawn, axis=axis)) for axis in (0, 1))
        x, y = self._x[within], self._y[within]
        dx, dy = self._half * right[within], self._half * down[within]
        inwards = -(dx * x + dy * y)
        moves = (dx * x, dx * y, dx, dy * x, dy * y, dy, inwards * x, inwards * y)
        blurring = self._blur * cv2.Laplacian(drawn, cv2.CV_32F)[within]
        white = drawn[within]
        greys = np.stack((white, white * x, white * y, np.ones_like(white)), axis=1)
        seen = self._part[within]
        weights = np.ones_like(white)
        if doubting:
            weights /= 1.0 + (self._left[within] / (_DOUBTED * self._contrast)) ** 2
        light = _least_squares(greys, seen, weights)
        if light is None or not light[0] > _LEAST_CONTRAST:
            return False
        left = seen - greys @ light
        self._contrast = float(light[0])
        self._left = np.zeros_like(self._part)
        self._left[within] = left
        contrast = (np.stack((np.ones_like(x), x, y)) * light[:3, None]).sum(axis=0)
        slopes = (np.stack((*moves, -blurring)) * -contrast).T
        change = _least_squares(np.concatenate([slopes, greys], axis=1), left, weights)
        if change is None:
            return False
        warp = np.eye(3) + np.append(change[:8], 0.0).reshape(3, 3)
        self._homography = np.linalg.solve(self._to_unit, warp @ self._to_unit @ self._homography)
        self._blur = float(np.clip(self._blur + np.clip(change[8], -0.3, 0.3), *_BLURS))
        return True

    def is_explained(self) -> bool:
        """Return whether the residual is small, overall and everywhere."""
        inside = self._within(self._judged).astype(np.float32)
        squares = inside * self._left**2
        if squares.sum() > (_UNEXPLAINED * self._contrast) ** 2 * inside.sum():
            return False
        # A place is about a cell.
        width = max(1.0, float(np.sqrt(inside.sum())) / self._cells)
        near = cv2.GaussianBlur(squares, (0, 0), width)
        weight = cv2.GaussianBlur(inside, (0, 0), width)
        worst = float((near * inside / np.maximum(weight, 1e-3)).max())
        return worst < (_COVERED * self._contrast) ** 2

    def _within(self, square: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Mark the pixels of the part that a square of the pattern (4, 2) covers."""
        inside = np.zeros(self._part.shape, np.uint8)
        outline = 16 * np.nan_to_num(_mapped(self._homography, square))
        outline = np.clip(np.round(outline), -(2**20), 2**20)
        cv2.fillConvexPoly(inside, outline.astype(np.int32), 1, shift=4)
        return inside > 0

    def _draw(self) -> NDArray[np.float32]:
        """Draw the pattern, black 0 and white 1, as the homography and the blur make it appear."""
        rows, columns = self._part.shape
        cell = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, _DRAWN]]) / _DRAWN
        middle = 0.5 * (_FINER - 1)
        fine = np.array([[_FINER, 0, middle], [0, _FINER, middle], [0, 0, 1.0]])
        large = cv2.warpPerspective(
            self._drawing,
            fine @ self._homography @ cell,
            (columns * _FINER, rows * _FINER),
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        drawn = cv2.resize(large, (columns, rows), interpolation=cv2.INTER_AREA)
        blurred = cv2.GaussianBlur(drawn, (0, 0), self._blur, borderType=cv2.BORDER_REPLICATE)
        return np.asarray(blurred, dtype=np.float32)


def _square(low: float, high: float) -> NDArray[np.float64]:
    return np.array([[low, low], [high, low], [high, high], [low, high]])


def _mapped(homography: NDArray[Any], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Map points (N, 2) by a homography (3, 3)."""
    places = np.column_stack([points, np.ones(len(points))]) @ homography.T
    return np.asarray(places[:, :2] / places[:, 2:])


def _least_squares(
    columns: NDArray[np.floating], right: NDArray[np.floating], weights: NDArray[np.floating]
) -> NDArray[np.float32] | None:
    """Return the solution (P,) for columns (N, P) and weights (N,); None where there is none."""
    weighted = columns.T * weights
    normal = (weighted @ columns).astype(np.float64)
    normal[np.diag_indices(len(normal))] *= 1.0 + 1e-6
    try:
        found = np.linalg.solve(normal, (weighted @ right).astype(np.float64))
    except np.linalg.LinAlgError:
        return None
    return found.astype(np.float32) if np.isfinite(found).all() else None
