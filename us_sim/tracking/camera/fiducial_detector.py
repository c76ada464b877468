"""Finds a body's markers in grey images, to a fraction of a pixel."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.tracking.camera.corner_refinement import refine_corners, refine_crossing
from us_sim.tracking.camera.markers import compute_marker_cells, fit_corners, load_dictionary
from us_sim.tracking.camera.rigid_body import RigidBody

_SPREAD = 0.25  # of the longer extent of points: the shorter one, at least
_SMALLEST = 0.03  # of the image's larger side: the length of a marker's outline
_SMALL = 48.0  # pixels, of the longest edge up to which all of a marker's pattern is fitted


@dataclass(frozen=True, eq=False)
class Detection:
    """The markers of a body found in one image; pixel (0, 0) is the upper left one."""

    ids: NDArray[np.int64]  # (n,), each once
    corners: NDArray[np.float64]  # (n, 4, 2) pixels, of the markers' black squares
    chessboard_ids: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    chessboard_corners: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 2)))
    doubled: tuple[int, ...] = ()  # markers of which the image has more than one: not used
    unclear: tuple[int, ...] = ()  # markers of which a part is covered, cut or blurred: not used

    def match_points(
        self, body: RigidBody
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
        """Return points of the body (N, 3) m, of the image (N, 2) pixels, and their owners (N,).

        An owner is the marker's row in the body, or -1 of a ChArUco board's chessboard corner.
        Where those are spread over the board they stand alone, since a crossing of edges is where
        it is however bold the print or bright the light, and the edge of a marker is not.
        """
        rows = np.array([body.rows[int(number)] for number in self.ids], dtype=np.int64)
        points = body.corners[rows].reshape(-1, 3)
        pixels = self.corners.reshape(-1, 2)
        owners = np.repeat(rows, 4)
        if body.chessboard is None:
            return points, pixels, owners
        crossings = body.chessboard.corners[self.chessboard_ids]
        of_board = np.full(len(crossings), -1, dtype=np.int64)
        if _is_spread(crossings):
            return crossings, self.chessboard_corners, of_board
        return (
            np.concatenate([points, crossings]),
            np.concatenate([pixels, self.chessboard_corners]),
            np.concatenate([owners, of_board]),
        )


def _is_spread(points: NDArray[np.float64]) -> bool:
    """Return whether points of a plane are enough for a pose, and not nearly in a line."""
    if len(points) < 4:
        return False
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(extents[1] > _SPREAD * extents[0])


class FiducialDetector:
    """Looks for the markers of one body.

    Examples:
        >>> import cv2, numpy as np
        >>> from us_sim.tracking.camera.markers import load_dictionary
        >>> from us_sim.tracking.camera.rigid_body import RigidBody
        >>> image = np.full((200, 200), 255, np.uint8)
        >>> printed = cv2.aruco.generateImageMarker(load_dictionary("4X4_50"), 7, 100)
        >>> image[50:150, 60:160] = printed
        >>> body = RigidBody.create_single("4X4_50", 7, 0.04)
        >>> found = FiducialDetector(body).detect_markers(image)
        >>> found.ids
        array([7])
        >>> np.allclose(found.corners[0, [0, 2]], [[59.5, 49.5], [159.5, 149.5]], atol=0.1)
        True
    """

    def __init__(self, body: RigidBody) -> None:
        self.body = body
        self._parameters = cv2.aruco.DetectorParameters()
        self._detector = cv2.aruco.ArucoDetector(load_dictionary(body.dictionary), self._parameters)
        self._chessboard_detector = None
        if body.chessboard is not None:
            beside = cv2.aruco.CharucoParameters()
            beside.minMarkers = 1  # a corner beside one that is found, since it is refined itself
            self._chessboard_detector = cv2.aruco.CharucoDetector(body.chessboard.board, beside)

    def detect_markers(
        self,
        image: NDArray[np.uint8],
        window: tuple[int, int, int, int] | None = None,
        reduction: int = 1,
    ) -> Detection:
        """Find the body's markers in an image (rows, columns).

        Args:
            image: grey.
            window: left, top, right and bottom pixel of the part to search; default: all.
            reduction: search an image so many times smaller, which is faster and misses small
                markers; the corners are still those of the whole image.
        """
        left, top, right, bottom = window or (0, 0, image.shape[1], image.shape[0])
        # OpenCV's rate is relative to the part: in a small one it would try specks of noise.
        ratio = max(image.shape) / max(1, right - left, bottom - top)
        self._parameters.minMarkerPerimeterRate = _SMALLEST * ratio
        self._detector.setDetectorParameters(self._parameters)
        part = image[top:bottom, left:right]
        if reduction > 1:
            size = (part.shape[1] // reduction, part.shape[0] // reduction)
            part = part[: size[1] * reduction, : size[0] * reduction]
            part = np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        corners, ids, _ = self._detector.detectMarkers(part)
        if ids is None:
            return Detection(np.empty(0, np.int64), np.empty((0, 4, 2)))
        numbers = np.asarray(ids, dtype=np.int64).ravel()
        places = np.asarray(corners, dtype=np.float32).reshape(-1, 4, 2)
        places = (places + 0.5) * reduction + np.array([left - 0.5, top - 0.5])
        places = places.astype(np.float32)
        wanted = np.isin(numbers, self.body.ids)
        numbers, first, counts = np.unique(numbers[wanted], return_index=True, return_counts=True)
        doubled, numbers = numbers[counts > 1], numbers[counts == 1]
        places = places[wanted][first[counts == 1]]
        crossings = self._crossings(image, numbers, places)
        refined = [
            _refine(image, each, compute_marker_cells(self.body.dictionary, number))
            for each, number in zip(places, numbers.tolist(), strict=True)
        ]
        sure = [i for i, each in enumerate(refined) if each is not None]
        kept = np.array([refined[i] for i in sure], dtype=np.float64).reshape(-1, 4, 2)
        unclear = tuple(np.delete(numbers, sure).tolist())
        return Detection(numbers[sure], kept, *crossings, tuple(doubled.tolist()), unclear)

    def _crossings(
        self, image: NDArray[np.uint8], numbers: NDArray[np.int64], places: NDArray[np.float32]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Find the chessboard corners that are clear: their numbers (k,) and pixels (k, 2).

        Each is fitted between its neighbours.
        """
        none = np.empty(0, np.int64), np.empty((0, 2))
        board = self.body.chessboard
        if self._chessboard_detector is None or board is None or not len(numbers):
            return none
        corners, ids, *_ = self._chessboard_detector.detectBoard(
            image, markerCorners=list(places[:, None]), markerIds=numbers.astype(np.int32)[:, None]
        )
        if ids is None or not len(ids):
            return none
        seen = np.asarray(ids, dtype=np.int64).ravel()
        pixels = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
        rows = [self.body.rows[int(number)] for number in numbers]
        plane = np.concatenate(
            [self.body.corners[rows, :, :2].reshape(-1, 2), board.corners[seen, :2]]
        )
        image_points = np.concatenate([places.reshape(-1, 2).astype(np.float64), pixels])
        homography, _ = cv2.findHomography(plane, image_points, cv2.LMEDS)
        if homography is None:
            return none
        view: NDArray[np.float64] = np.array(homography, dtype=np.float64)
        gap = 0.5 * (board.square - board.size) / board.square
        kept, refined = [], []
        for number, pixel in zip(seen.tolist(), pixels, strict=True):
            middle = board.corners[number, :2]
            half = 0.5 * board.square * np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]])
            ends = np.column_stack([middle + half, np.ones(4)]) @ view.T
            edges = np.diff((ends[:, :2] / ends[:, 2:]).reshape(2, 2, 2), axis=1)[:, 0]
            lengths = np.linalg.norm(edges, axis=1)
            directions = edges / lengths[:, None]
            side = float(lengths.min())
            sine = abs(
                float(directions[0, 0] * directions[1, 1] - directions[0, 1] * directions[1, 0])
            )
            place = refine_crossing(image, pixel, directions, side * sine, gap * side * sine)
            if place is not None:
                kept.append(number)
                refined.append(place)
        return np.array(kept, dtype=np.int64), np.array(refined).reshape(-1, 2)


def _refine(
    image: NDArray[np.uint8], corners: NDArray[np.float32], cells: NDArray[np.uint8]
) -> NDArray[np.float64] | None:
    """Refine a marker's corners (4, 2) to where its edges meet; None where those are not seen.

    Where a small marker's edges tell nothing, its whole pattern does.
    """
    edges = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    half = int(np.clip(edges.min() / 20, 1, 5))
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)
    near = cv2.cornerSubPix(image, corners.copy(), (half, half), (-1, -1), stop)
    refined = refine_corners(image, np.array(near, dtype=np.float64), len(cells) - 2)
    if refined is None and edges.max() <= _SMALL:
        refined = fit_corners(image, np.array(corners, dtype=np.float64), cells)
    return refined
