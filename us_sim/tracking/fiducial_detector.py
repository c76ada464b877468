"""Finds a body's markers in grey images, to a fraction of a pixel.

>>> import cv2, numpy as np
>>> from us_sim.tracking.fiducial_detector import FiducialDetector
>>> from us_sim.tracking.markers import dictionary
>>> from us_sim.tracking.rigid_body import RigidBody
>>> image = np.full((200, 200), 255, np.uint8)
>>> image[50:150, 60:160] = cv2.aruco.generateImageMarker(dictionary("4X4_50"), 7, 100)
>>> found = FiducialDetector(RigidBody.single("4X4_50", 7, 0.04)).detect(image)
>>> found.ids
array([7])
>>> np.allclose(found.corners[0, [0, 2]], [[59.5, 49.5], [159.5, 149.5]], atol=0.1)
True
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.tracking.marker_edges import refined_corners
from us_sim.tracking.markers import dictionary
from us_sim.tracking.rigid_body import RigidBody

__all__ = ["Detection", "FiducialDetector", "detect_corners"]


@dataclass(frozen=True, eq=False)
class Detection:
    """What was found of a body in one image; pixel (0, 0) is the middle of the upper left one."""

    ids: NDArray[np.int64]  # (n,), each once
    corners: NDArray[np.float64]  # (n, 4, 2) pixels, of the markers' black squares
    chessboard_ids: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    chessboard_corners: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 2)))
    doubled: tuple[int, ...] = ()  # markers of which the image has more than one: not used
    unclear: tuple[int, ...] = ()  # markers of which an edge is covered, cut or blurred: not used

    def correspondences(
        self, body: RigidBody
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
        """Points of the body (N, 3) m, of the image (N, 2) pixels, and whose they are (N,).

        The last is the marker's row in the body; all are 0 for a ChArUco board of which at least
        four chessboard corners are seen, since those then stand for the markers.
        """
        if body.chessboard is not None and len(self.chessboard_ids) >= 4:
            points = body.chessboard.corners[self.chessboard_ids]
            return points, self.chessboard_corners, np.zeros(len(points), dtype=np.int64)
        rows = np.array([body.rows[int(number)] for number in self.ids], dtype=np.int64)
        points = body.corners[rows].reshape(-1, 3)
        return points, self.corners.reshape(-1, 2), np.repeat(rows, 4)


def detect_corners(
    image: NDArray[np.uint8], body: RigidBody
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points of the body (N, 3) m and where they are in the image (N, 2) pixels; N may be 0."""
    points, pixels, _ = FiducialDetector(body).detect(image).correspondences(body)
    return points, pixels


class FiducialDetector:
    """Looks for the markers of one body."""

    def __init__(self, body: RigidBody) -> None:
        self.body = body
        parameters = cv2.aruco.DetectorParameters()
        self._detector = cv2.aruco.ArucoDetector(dictionary(body.dictionary), parameters)
        self._cells = dictionary(body.dictionary).markerSize + 2
        self._chessboard_detector = None
        if body.chessboard is not None:
            beside = cv2.aruco.CharucoParameters()
            beside.minMarkers = 1  # a corner beside one that is found, since it is refined itself
            self._chessboard_detector = cv2.aruco.CharucoDetector(body.chessboard.board, beside)

    def detect(
        self,
        image: NDArray[np.uint8],
        window: tuple[int, int, int, int] | None = None,
        reduction: int = 1,
    ) -> Detection:
        """The body's markers in an image (rows, columns).

        Args:
            image: grey.
            window: left, top, right and bottom pixel of where to look; default: everywhere.
            reduction: look in an image so many times smaller, which is faster and misses small
                markers; the corners are still those of the whole image.
        """
        left, top, right, bottom = window or (0, 0, image.shape[1], image.shape[0])
        part = image[top:bottom, left:right]
        if reduction > 1:
            size = (part.shape[1] // reduction, part.shape[0] // reduction)
            part = part[: size[1] * reduction, : size[0] * reduction]
            part = np.asarray(cv2.resize(part, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        corners, ids, _ = self._detector.detectMarkers(part)
        if ids is None or not len(ids):
            return Detection(np.empty(0, np.int64), np.empty((0, 4, 2)))
        numbers = np.asarray(ids, dtype=np.int64).ravel()
        places = np.asarray(corners, dtype=np.float32).reshape(-1, 4, 2)
        places = (places + 0.5) * reduction + np.array([left - 0.5, top - 0.5])
        places = places.astype(np.float32)
        wanted = np.isin(numbers, self.body.ids)
        numbers, places = numbers[wanted], places[wanted]
        unique, counts = np.unique(numbers, return_counts=True)
        doubled = unique[counts > 1]
        single = ~np.isin(numbers, doubled)
        numbers, places = numbers[single], places[single]
        order = np.argsort(numbers)
        numbers, places = numbers[order], places[order]
        refused = tuple(doubled.tolist())
        if self._chessboard_detector is not None:
            return self._with_chessboard(image, numbers, places, refused)
        refined = [_refine(image, each, self._cells) for each in places]
        sure = [i for i, each in enumerate(refined) if each is not None]
        kept = np.array([refined[i] for i in sure], dtype=np.float64).reshape(-1, 4, 2)
        unclear = tuple(np.delete(numbers, sure).tolist())
        return Detection(numbers[sure], kept, doubled=refused, unclear=unclear)

    def _with_chessboard(
        self,
        image: NDArray[np.uint8],
        numbers: NDArray[np.int64],
        places: NDArray[np.float32],
        doubled: tuple[int, ...],
    ) -> Detection:
        """Detection with the chessboard's corners, which lie between the markers."""
        assert self._chessboard_detector is not None
        if not len(numbers):
            return Detection(numbers, places.astype(np.float64), doubled=doubled)
        corners, ids, *_ = self._chessboard_detector.detectBoard(
            image, markerCorners=list(places[:, None]), markerIds=numbers.astype(np.int32)[:, None]
        )
        if ids is None or not len(ids):
            return Detection(numbers, places.astype(np.float64), doubled=doubled)
        return Detection(
            numbers,
            places.astype(np.float64),
            np.asarray(ids, dtype=np.int64).ravel(),
            np.asarray(corners, dtype=np.float64).reshape(-1, 2),
            doubled,
        )


def _refine(
    image: NDArray[np.uint8], corners: NDArray[np.float32], cells: int
) -> NDArray[np.float64] | None:
    """Corners (4, 2) of one marker where its edges really meet; None where those are not seen."""
    edge = float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).min())
    half = int(np.clip(edge / 20, 1, 5))
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)
    near = cv2.cornerSubPix(image, corners.copy(), (half, half), (-1, -1), stop)
    return refined_corners(image, np.array(near, dtype=np.float64), cells)
