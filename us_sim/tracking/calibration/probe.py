"""Probe calibration: where the image lies in the frame of the marker on the probe.

A pixel (column c, row r) lies at a c + b r + t in the body's frame, so at P (a c + b r + t) in the
phantom's, P being the body's pose: linear in a, b and t (Prager 1998). It must be where the point
lies that the pixel shows, or anywhere on its wire. The linear solution starts the nonlinear one,
in which a and b are perpendicular and have lengths, the pixels' sizes.

>>> import numpy as np
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tracking.calibration.probe import PixelSighting, calibrate_probe
>>> rng = np.random.default_rng(0)
>>> seen, pin = [], np.zeros((1, 3))
>>> for _ in range(30):
...     pixel = rng.uniform(0, 400, 2)
...     at = np.array([2e-4 * pixel[0], 0.05, 1e-4 * pixel[1]])
...     turn = Pose(orientation=rng.standard_normal(4))
...     seen.append(PixelSighting("pin", *pixel, Pose(-turn.apply(at), turn.orientation)))
>>> found = calibrate_probe(seen, {"pin": pin})
>>> found.spacing.round(6), found.image_to_body[:3, 3].round(6)
(array([0.0002, 0.0001]), array([0.  , 0.05, 0.  ]))
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from us_sim.errors import CalibrationError
from us_sim.geometry.pose import Pose
from us_sim.tracking.calibration.pivot import cluster_numbers, clustered_covariance

_FEWEST = 8
_LARGEST_GAIN = 3.0  # error at the image's edge over the error of one sighting
_TOO_FAR = 4.0  # deviations from the others, beyond which a sighting is wrong
_SINGULAR = 1e-7
_OPEN = (
    "the sightings do not determine where the image is: turn the probe about all axes, and let "
    "the features appear all over the image"
)
_STEP = [3, 4, 5, 0, 1, 2, 6, 7]  # rows of the covariance that a step's parameters have
_PIXEL_SIZES = (1e-6, 5e-3)  # m, that make sense


@dataclass(frozen=True, eq=False)
class PixelSighting:
    """A feature of the phantom in an image, and where the body was."""

    feature: str
    column: float  # pixels
    row: float
    pose: Pose  # of the body in the phantom's frame


@dataclass(frozen=True, eq=False)
class ProbeCalibration:
    """Where the image lies in the body's frame, and how well the sightings determine it."""

    image_to_body: NDArray[np.float64]  # (4, 4) m, from (column, row, 0, 1)
    spacing: NDArray[np.float64]  # (2,) m, between columns and between rows
    rms: float  # m, root mean square distance of the used sightings from their features
    residuals: NDArray[np.float64]  # (N,) m, of all sightings
    inliers: NDArray[np.bool_]  # (N,)
    covariance: NDArray[np.float64]  # (8, 8) of position, rotation (about the body's axes), spacing
    edge_deviation: float  # m, standard deviation of the outermost sightings' place, at the worst
    clusters: NDArray[np.intp]  # (N,) of sightings whose errors are taken to be related
    turned: float  # rad, by which the body turned: about the largest angle between two poses
    points: Mapping[str, NDArray[np.float64]]  # (3,) m, where features were found to be

    @property
    def turn_deviation(self) -> float:
        """Standard deviation, rad, of the turn about the axis that is determined worst."""
        return math.sqrt(float(np.linalg.eigvalsh(self.covariance[3:6, 3:6]).max()))

    def probe_pose(self, column: float, row: float) -> Pose:
        """The pose of ``probe`` in the body's frame, from the pixel at the face's middle."""
        matrix = np.eye(4)
        x, z = (self.image_to_body[:3, k] / self.spacing[k] for k in range(2))
        matrix[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
        matrix[:3, 3] = self.image_to_body[:3] @ [column, row, 0.0, 1.0]
        return Pose.from_matrix(matrix)


def calibrate_probe(
    sightings: Sequence[PixelSighting],
    phantom: Mapping[str, NDArray[np.float64]],
    *,
    spacing: NDArray[np.float64] | None = None,
) -> ProbeCalibration:
    """Where the image lies in the body's frame.

    Args:
        sightings: of the phantom's features.
        phantom: points (1, 3) m and wires (2, 3) m, both ends, in the phantom's frame. A feature
            that is not there is a point at an unknown place, which is found too.
        spacing: (2,) m between columns and between rows, where it is known.

    Raises:
        CalibrationError: the sightings are too few, or do not determine the image's place.
    """
    if len(sightings) < _FEWEST:
        raise CalibrationError(
            f"a probe calibration needs at least {_FEWEST} sightings, not {len(sightings)}: "
            f"a hundred from all sides are good"
        )
    unknown = sorted({sighting.feature for sighting in sightings} - set(phantom))
    seen = _Sightings.of(sightings, phantom, unknown, spacing)
    start = _start(seen)
    rough = _fit(seen, start, loss="soft_l1", f_scale=1e-3)[0]
    distances = np.linalg.norm(seen.distances(rough), axis=1)
    # A sighting at a wire errs in two directions, whose distance has this median.
    inliers = distances <= max(_TOO_FAR * float(np.median(distances)) / 1.1774, 1e-9)
    used = seen.only(inliers)
    image, jacobian = _fit(used, rough)
    if not _gain(used, image, jacobian) <= _LARGEST_GAIN:
        raise CalibrationError(_OPEN)
    if not (_PIXEL_SIZES[0] < image.spacing.min() and image.spacing.max() < _PIXEL_SIZES[1]):
        raise CalibrationError(
            f"the pixels come out as {1e3 * image.spacing[0]:.3g} × {1e3 * image.spacing[1]:.3g} "
            f"mm: give the poses and the phantom in metres"
        )
    residuals = np.linalg.norm(seen.distances(image), axis=1)
    clusters = cluster_numbers([sighting.feature for sighting in sightings])
    _, of_used = np.unique(clusters[inliers], return_inverse=True)
    covariance = _covariance(used, image, jacobian, of_used.astype(np.intp))
    return ProbeCalibration(
        image.matrix,
        image.spacing,
        math.sqrt(float((residuals[inliers] ** 2).mean())),
        residuals,
        inliers,
        covariance,
        _edge(used, image, covariance[np.ix_(_STEP, _STEP)]),
        clusters,
        _turned(used.rotations),
        dict(zip(unknown, image.points, strict=True)),
    )


@dataclass(frozen=True, eq=False)
class _Image:
    """An image in the body's frame, and the points whose places were unknown."""

    rotation: NDArray[np.float64]  # (3, 3): directions of columns, rows, and out of the plane
    position: NDArray[np.float64]  # (3,) m
    spacing: NDArray[np.float64]  # (2,) m
    points: NDArray[np.float64]  # (U, 3) m, in the phantom's frame

    @property
    def matrix(self) -> NDArray[np.float64]:
        """(4, 4) m, from (column, row, 0, 1)."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation * [*self.spacing, 1.0]
        matrix[:3, 3] = self.position
        return matrix

    def moved(self, step: NDArray[np.float64], free: bool) -> _Image:
        """The image turned by step[:3] about the body's axes, moved by [3:6], scaled if free."""
        first = 8 if free else 6
        return _Image(
            Rotation.from_rotvec(step[:3]).as_matrix() @ self.rotation,
            self.position + step[3:6],
            self.spacing + (step[6:8] if free else 0.0),
            self.points + step[first:].reshape(-1, 3),
        )

    def slope(self, pixel: NDArray[np.float64], free: bool) -> NDArray[np.float64]:
        """(3, 6 or 8) derivative of a pixel's place in the body's frame to a step."""
        x, y, z = self.rotation[:, :2] @ (pixel * self.spacing)
        turn = np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
        grow = [self.rotation[:, :2] * pixel] if free else []
        return np.concatenate([turn, np.eye(3), *grow], axis=1)


@dataclass(frozen=True, eq=False)
class _Sightings:
    """Sightings as arrays."""

    pixels: NDArray[np.float64]  # (N, 2)
    rotations: NDArray[np.float64]  # (N, 3, 3)
    positions: NDArray[np.float64]  # (N, 3)
    targets: NDArray[np.float64]  # (N, 3) m, a point of the feature; 0 of an unknown one
    across: NDArray[np.float64]  # (N, 3, 3), removes what is along the wire
    unknown: NDArray[np.intp]  # (N,) which unknown point it is; -1 of a known feature
    unknowns: int
    spacing: NDArray[np.float64] | None  # (2,) m, where it is known

    @classmethod
    def of(
        cls,
        sightings: Sequence[PixelSighting],
        phantom: Mapping[str, NDArray[np.float64]],
        unknown: Sequence[str],
        spacing: NDArray[np.float64] | None,
    ) -> _Sightings:
        numbers = {name: k for k, name in enumerate(unknown)}
        targets, across = np.zeros((len(sightings), 3)), np.zeros((len(sightings), 3, 3))
        for k, sighting in enumerate(sightings):
            feature = np.asarray(phantom.get(sighting.feature, np.zeros((1, 3))), np.float64)
            feature = feature.reshape(-1, 3)
            targets[k], across[k] = feature[0], np.eye(3)
            if len(feature) == 2:
                along = feature[1] - feature[0]
                across[k] -= np.outer(along, along) / (along @ along)
        return cls(
            np.array([[sighting.column, sighting.row] for sighting in sightings], np.float64),
            np.array([sighting.pose.rotation for sighting in sightings]),
            np.array([sighting.pose.position for sighting in sightings]),
            targets,
            across,
            np.array([numbers.get(sighting.feature, -1) for sighting in sightings], np.intp),
            len(unknown),
            spacing,
        )

    def only(self, which: NDArray[np.bool_]) -> _Sightings:
        """The sightings that a mask selects."""
        arrays = ("pixels", "rotations", "positions", "targets", "across", "unknown")
        return replace(self, **{name: getattr(self, name)[which] for name in arrays})

    def distances(self, image: _Image) -> NDArray[np.float64]:
        """(N, 3) m from the features to their pixels, across wires."""
        body = self.pixels @ image.matrix[:3, :2].T + image.position
        found = np.einsum("nij,nj->ni", self.rotations, body) + self.positions
        targets = self.targets.copy()
        rows = self.unknown >= 0
        targets[rows] = image.points[self.unknown[rows]]
        return np.asarray(np.einsum("nij,nj->ni", self.across, found - targets))


def _start(seen: _Sightings) -> _Image:
    """The linear solution, its a and b made perpendicular.

    Raises:
        CalibrationError: the linear equations determine none.
    """
    count = len(seen.pixels)
    width = max(float(np.ptp(seen.pixels)), 1.0)
    # Unknowns: a and b times the width, t, and the unknown points; all in metres.
    terms = np.concatenate([seen.pixels / width, np.ones((count, 1))], axis=1)
    places = np.einsum("nk,nij->nikj", terms, seen.rotations).reshape(count, 3, 9)
    points = np.zeros((count, 3, seen.unknowns, 3))
    rows = np.flatnonzero(seen.unknown >= 0)
    points[rows, :, seen.unknown[rows]] = -np.eye(3)
    left = seen.across @ np.concatenate([places, points.reshape(count, 3, -1)], axis=2)
    right = seen.across @ (seen.targets - seen.positions)[..., None]
    solution, _, rank, _ = np.linalg.lstsq(
        left.reshape(3 * count, -1), right.ravel(), rcond=_SINGULAR
    )
    a, b, t = solution[:9].reshape(3, 3)
    if rank < len(solution) or np.linalg.norm(np.cross(a, b)) < 1e-6 * (a @ a + b @ b):
        raise CalibrationError(_OPEN)
    # The rotation nearest to both directions (polar decomposition).
    u, v = a / np.linalg.norm(a), b / np.linalg.norm(b)
    w = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
    first, _, second = np.linalg.svd(np.stack([u, v, w], axis=1))
    sizes = np.array([np.linalg.norm(a), np.linalg.norm(b)]) / width
    return _Image(
        first @ second,
        t,
        sizes if seen.spacing is None else np.asarray(seen.spacing, np.float64),
        solution[9:].reshape(-1, 3),
    )


def _fit(seen: _Sightings, start: _Image, **robust: Any) -> tuple[_Image, NDArray[np.float64]]:
    """The image with the least squares, and the residuals' derivative (3 N, P) to a step there."""
    free = seen.spacing is None

    def residuals(step: NDArray[np.float64]) -> NDArray[np.float64]:
        return seen.distances(start.moved(step, free)).ravel()

    step = np.zeros((8 if free else 6) + 3 * seen.unknowns)
    found = least_squares(residuals, step, x_scale="jac", **robust)
    return start.moved(found.x, free), np.asarray(found.jac)


def _gain(seen: _Sightings, image: _Image, jacobian: NDArray[np.float64]) -> float:
    """The image's error at the outermost sightings, for an error of 1 in every sighting."""
    scale = np.linalg.norm(jacobian, axis=0)
    if not scale.all():
        return math.inf
    # With columns of one length the values tell what is open.
    values, vectors = np.linalg.eigh((jacobian / scale).T @ (jacobian / scale))
    if values[0] <= _SINGULAR:
        return math.inf
    return _edge(seen, image, ((vectors / values) @ vectors.T) / np.outer(scale, scale))


def _edge(seen: _Sightings, image: _Image, covariance: NDArray[np.float64]) -> float:
    """m, deviation of the outermost sightings for the covariance of a step."""
    free = seen.spacing is None
    lower, upper = seen.pixels.min(axis=0), seen.pixels.max(axis=0)
    worst = 0.0
    for corner in ((0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0)):
        slope = image.slope(lower + np.array(corner) * (upper - lower), free)
        block = covariance[: slope.shape[1], : slope.shape[1]]
        worst = max(worst, float(np.trace(slope @ block @ slope.T)))
    return math.sqrt(worst)


def _covariance(
    seen: _Sightings, image: _Image, jacobian: NDArray[np.float64], clusters: NDArray[np.intp]
) -> NDArray[np.float64]:
    """(8, 8) of position, rotation and spacing, from errors that are related within clusters."""
    slopes = jacobian.reshape(len(seen.pixels), 3, -1)
    full = clustered_covariance(slopes, seen.distances(image), clusters)
    order = [3, 4, 5, 0, 1, 2] + ([6, 7] if seen.spacing is None else [])
    covariance = np.zeros((8, 8))
    covariance[: len(order), : len(order)] = full[np.ix_(order, order)]
    return covariance


def _turned(rotations: NDArray[np.float64]) -> float:
    """About the largest angle, rad, between two of the rotations (N, 3, 3)."""
    turns = Rotation.from_matrix(rotations)
    farthest = turns[int((turns * turns[0].inv()).magnitude().argmax())]
    return float((turns * farthest.inv()).magnitude().max())
