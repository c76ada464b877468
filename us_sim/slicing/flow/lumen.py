"""A vessel's lumen at rest, from its voxels: the centre line, and cross-sections along it.

The centre line joins the centres of slices equally far from one end, along shortest paths within
the lumen (A. Verroust, F. Lazarus, Extracting skeletal curves from 3D scattered data, Visual
Computer 16, 2000). Where a slice falls apart, the vessel branches.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from us_sim.errors import VolumeError

DIRECTIONS = 24  # from a section's centre in which its wall is known, in kernels as well
_ANGLES = np.arange(DIRECTIONS) * (2 * math.pi / DIRECTIONS)
_SOFTENED = 0.7  # standard deviation, in voxels, of what softens the steps of a label's surface
_INTERPOLATED = 1 / 6  # variance, in voxels squared, of what linear interpolation averages over
_WALL_STEP = 0.25  # voxels between the places along a ray where its wall is looked for
_REFINED = 4  # times that the centre line is moved into its sections' centres
_WIDEST = 2.5  # farthest that a wall is looked for, over the vessel's mean width
_HELD = (0.8, 1.2)
"""Fraction of a lumen's volume that its sections may have: outside of it they miss some of it."""


@dataclass(frozen=True, eq=False)
class Lumen:
    """Sections of a tube at S stations, evenly spaced along its centre line."""

    centres: NDArray[np.float64]  # (S, 3) m
    tangents: NDArray[np.float64]  # (S, 3), unit vectors along the centre line
    across: NDArray[np.float64]  # (S, 2, 3), unit vectors that span each section
    radii: NDArray[np.float64]  # (S, DIRECTIONS) m, of the wall

    @cached_property
    def spacing(self) -> float:
        """m, between stations along the centre line."""
        steps = np.linalg.norm(np.diff(self.centres, axis=0), axis=1)
        return float(steps.mean())

    @cached_property
    def areas(self) -> NDArray[np.float64]:
        """(S,) m², of the sections."""
        return np.asarray((self.radii**2).mean(axis=1) * math.pi)

    def compute_rings(self, fractions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Compute (S, F, DIRECTIONS, 3) m: points at F fractions of the wall's distance."""
        return np.asarray(
            self.centres[:, None, None] + fractions[:, None, None] * self._wall[:, None]
        )

    @cached_property
    def _wall(self) -> NDArray[np.float64]:
        """(S, DIRECTIONS, 3) m, from the centre."""
        around = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
        return self.radii[..., None] * (around @ self.across)

    def locate_points(
        self, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the place along the stations (P,), and the offset (P, 2) across the tube.

        The offset is that over the wall's distance in its direction, so that its length is the
        radial coordinate. Beyond its ends the tube goes on straight, with its last station's place.

        Args:
            points: (P, 3) m.
        """
        from scipy.spatial import cKDTree

        last = len(self.centres) - 1
        station = cKDTree(self.centres).query(points)[1].astype(np.float64)
        for _ in range(3):
            centre, tangent = _between(self.centres, station), _between(self.tangents, station)
            ahead = np.einsum("px,px->p", points - centre, tangent)
            station = np.clip(station + ahead / self.spacing, 0.0, last)
        offset = points - _between(self.centres, station)
        x, y = np.einsum("px,pax->ap", offset, _between(self.across, station))
        turn = np.mod(np.arctan2(y, x), 2 * math.pi) * (DIRECTIONS / (2 * math.pi))
        low = turn.astype(int) % DIRECTIONS
        near = _between(self.radii, station)
        row = np.arange(len(points))
        part = turn - np.floor(turn)
        wall = near[row, low] * (1.0 - part) + near[row, (low + 1) % DIRECTIONS] * part
        return station, np.stack([x, y], axis=1) / wall[:, None]


def measure_lumen(lumen: NDArray[np.bool_], index_to_patient: NDArray[np.float64]) -> Lumen:
    """Measure the sections of a vessel from the voxels of its lumen.

    Where it reaches the edge of the volume it is taken to go on beyond that.

    Args:
        lumen: (i, j, k), True in the vessel.
        index_to_patient: (4, 4) m.

    Raises:
        VolumeError: they are no tube; the sentence begins with what they are instead.
    """
    inside = np.argwhere(lumen)
    if not len(inside):
        raise VolumeError("is nowhere in the volume")
    low, high = inside.min(axis=0), inside.max(axis=0) + 1
    cropped = lumen[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
    placed = index_to_patient.copy()
    placed[:3, 3] += index_to_patient[:3, :3] @ low
    line = find_centreline(cropped, placed)
    walls = _Walls(lumen, low, high, index_to_patient, _WIDEST * line.width)
    points = line.points
    for _ in range(_REFINED):
        points = _extended(points, walls, 0.25 * line.width)
        section = _sections(points, walls, closed=False)
        # Of the sector of a circle the centre of area lies two thirds out.
        weights = section.radii**2
        moment = np.einsum("sd,sdx->sx", weights, section._wall) * (2.0 / 3.0)
        centroids = section.centres + moment / np.maximum(weights.sum(axis=1), 1e-30)[:, None]
        points = resample_curve(centroids, 0.25 * line.width, smoothing=0.5 * line.width)
    tube = _sections(_extended(points, walls, 0.25 * line.width), walls)
    # Without the stations at its ends where it closes.
    wide = np.flatnonzero(tube.areas > 0.5 * np.median(tube.areas))
    part = slice(int(wide[0]), int(wide[-1]) + 1)
    found = Lumen(tube.centres[part], tube.tangents[part], tube.across[part], tube.radii[part])
    held = found.areas.sum() * found.spacing
    whole = len(inside) * abs(np.linalg.det(index_to_patient[:3, :3]))
    if not _HELD[0] < held / whole < _HELD[1]:
        raise VolumeError(
            f"is no tube: sections across its middle hold {100 * held / whole:.0f} % of it"
        )
    return found


class _Walls:
    """The wall of a lumen as seen from a point within.

    Args:
        lumen: (i, j, k). low, high: (3,) the box of voxels around it.
        index_to_patient: (4, 4) m.
        reach: m, how far to look.
    """

    def __init__(
        self,
        lumen: NDArray[np.bool_],
        low: NDArray[np.int64],
        high: NDArray[np.int64],
        index_to_patient: NDArray[np.float64],
        reach: float,
    ) -> None:
        from scipy.ndimage import gaussian_filter

        margin = 3
        first = np.maximum(low - margin, 0)
        end = np.minimum(high + margin, lumen.shape)
        within = lumen[tuple(slice(a, b) for a, b in zip(first, end, strict=True))]
        # Beyond the edge of the volume what is at the edge goes on.
        self._inside = gaussian_filter(within.astype(np.float32), _SOFTENED, mode="nearest")
        self._to_index = np.linalg.inv(index_to_patient)
        self._to_index[:3, 3] -= first
        self._last = np.array(within.shape) - 0.5
        voxel = float(np.linalg.norm(index_to_patient[:3, :3], axis=0).min())
        self._steps = np.arange(0.0, reach, _WALL_STEP * voxel)
        self._drawn_in = 0.5 * (_SOFTENED**2 + _INTERPOLATED) * voxel**2

    def are_in_volume(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return (P,) True for points (P, 3) m that lie among the voxels, and in the lumen."""
        index = self._index(points)
        among = ((index >= -0.5) & (index <= self._last)).all(axis=-1)
        return np.asarray(among & (self._at(index) > 0.5))

    def distances(
        self, points: NDArray[np.float64], directions: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return (P, D) m from points (P, 3) m along directions (P, D, 3); inf without a wall."""
        rays = points[:, None, None] + self._steps[:, None] * directions[:, :, None]
        inside = self._at(self._index(rays))
        outside = inside < 0.5
        first = outside.argmax(axis=2)
        at = first[..., None]
        beyond = np.take_along_axis(inside, at, axis=2)[..., 0]
        before = np.take_along_axis(inside, np.maximum(at - 1, 0), axis=2)[..., 0]
        drop = np.where(before > beyond, before - beyond, 1.0)
        crossing = first - np.clip((0.5 - beyond) / drop, 0.0, 1.0)
        distance = np.maximum(crossing, 0.0) * self._steps[1]
        # Averaging draws a curved wall in, by half the variance times the curvature.
        distance += self._drawn_in / np.maximum(distance, self._steps[1])
        return np.where(outside.any(axis=2), distance, np.inf)

    def _index(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(points @ self._to_index[:3, :3].T + self._to_index[:3, 3])

    def _at(self, index: NDArray[np.float64]) -> NDArray[np.float32]:
        from scipy.ndimage import map_coordinates

        coordinates = np.moveaxis(index, -1, 0)
        sampled = map_coordinates(self._inside, coordinates, order=1, mode="nearest")
        return np.asarray(sampled, dtype=np.float32)


def _sections(points: NDArray[np.float64], walls: _Walls, *, closed: bool = True) -> Lumen:
    """Measure sections at the points (S, 3) m of a centre line.

    Raises:
        VolumeError: one is not closed, and shall be.
    """
    tangents = np.gradient(points, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1)[:, None]
    across = _frames(tangents)
    around = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1)
    radii = walls.distances(points, around @ across)
    is_open = np.isinf(radii).any(axis=1)
    if is_open.any():
        if closed:
            x, y, z = 1e3 * points[np.argmax(is_open)]
            raise VolumeError(
                f"is no tube: its section at ({x:.0f}, {y:.0f}, {z:.0f}) mm is not closed"
            )
        radii = np.where(np.isinf(radii), 0.0, radii)
    return Lumen(points, tangents, across, radii)


def _frames(tangents: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (S, 2, 3) unit vectors across tangents (S, 3), turned as little as possible."""
    across = np.empty((len(tangents), 2, 3))
    first = np.eye(3)[np.argmin(np.abs(tangents[0]))]
    for s, tangent in enumerate(tangents):
        first = first - (first @ tangent) * tangent
        first = first / np.linalg.norm(first)
        across[s] = first, np.cross(tangent, first)
    return across


def _extended(points: NDArray[np.float64], walls: _Walls, spacing: float) -> NDArray[np.float64]:
    """Extend the curve straight at both ends as far as lumen and volume reach."""
    ends = []
    for inner, end in ((points[1], points[0]), (points[-2], points[-1])):
        step = (end - inner) * (spacing / np.linalg.norm(end - inner))
        ahead = end + step * np.arange(1, 65)[:, None]
        out = ~walls.are_in_volume(ahead)
        ends.append(ahead[: np.argmax(out)] if out.any() else ahead)
    return np.concatenate([ends[0][::-1], points, ends[1]])


def _between(values: NDArray[np.float64], station: NDArray[np.float64]) -> NDArray[np.float64]:
    """Interpolate values (S, …) at places (P,) between stations."""
    low = np.minimum(station.astype(int), len(values) - 2)
    part = (station - low).reshape(-1, *[1] * (values.ndim - 1))
    return np.asarray(values[low] * (1.0 - part) + values[low + 1] * part)


_MOST = 60_000  # voxels of a lumen that are walked; of more, every second along each axis is
_SLENDER = 3.0  # least length of a vessel over its width
_PIECE = 0.05
"""Fraction of its voxels that may lie apart from a vessel, as segmentations have crumbs."""

_BRANCH = 0.2  # fraction of a slice from which a part that lies apart from the rest is a branch

_HALF = [
    (i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1) if (i, j, k) > (0, 0, 0)
]
"""Steps to one of each two opposite neighbours of a voxel."""


@dataclass(frozen=True, eq=False)
class Centreline:
    """The middle of a tube from one end to the other."""

    points: NDArray[np.float64]  # (P, 3) m, evenly spaced
    width: float  # m, diameter of a circle of the tube's mean area


def find_centreline(lumen: NDArray[np.bool_], index_to_patient: NDArray[np.float64]) -> Centreline:
    """Find the centre line of the voxels of a lumen.

    Args:
        lumen: (i, j, k), True in the vessel.
        index_to_patient: (4, 4) m.

    Raises:
        VolumeError: they are no tube; the sentence begins with what they are instead.
    """
    lumen = _one_piece(lumen)
    volume = np.count_nonzero(lumen) * abs(np.linalg.det(index_to_patient[:3, :3]))
    while np.count_nonzero(lumen) > _MOST:
        lumen = lumen[::2, ::2, ::2]
        index_to_patient = index_to_patient @ np.diag([2.0, 2.0, 2.0, 1.0])
    voxels = np.argwhere(lumen)
    graph = _graph(lumen, voxels, index_to_patient[:3, :3])
    distance = dijkstra(graph, directed=False, indices=0)
    start = int(np.argmax(np.where(np.isfinite(distance), distance, -1.0)))
    walked = dijkstra(graph, directed=False, indices=start)
    walked[~np.isfinite(walked)] = 0.0  # a crumb that thinning cut off
    length = float(walked.max())
    width = 2.0 * math.sqrt(volume / (math.pi * max(length, 1e-9)))
    if length < _SLENDER * width:
        raise VolumeError(
            f"is too short for a tube: {1e3 * length:.1f} mm long and {1e3 * width:.1f} mm wide"
        )
    places = voxels @ index_to_patient[:3, :3].T + index_to_patient[:3, 3]
    count = max(4, math.ceil(length / (0.5 * width)))
    slices = np.minimum((walked * (count / length)).astype(int), count - 1)
    _require_no_branch(voxels, places, slices)
    sizes = np.bincount(slices, minlength=count)
    centres = np.stack(
        [np.bincount(slices, places[:, axis], count) / np.maximum(sizes, 1) for axis in range(3)], 1
    )[sizes > 0]
    # The first and last slice are caps around a corner of the vessel's end.
    inner = centres[1:-1]
    return Centreline(resample_curve(inner, 0.25 * width, smoothing=0.5 * width), width)


def resample_curve(
    points: NDArray[np.float64], spacing: float, smoothing: float = 0.0
) -> NDArray[np.float64]:
    """Smooth a curve (P, 3) m; return points (Q, 3) m, evenly about ``spacing`` apart.

    Args:
        points: (P, 3) m.
        spacing: m.
        smoothing: m, standard deviation of the averaging along the curve. Its ends stay.

    Raises:
        VolumeError: the curve is shorter than the spacing.
    """
    from scipy.ndimage import gaussian_filter1d

    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    if not along[-1] > spacing:
        raise VolumeError("is no tube: slices across it do not follow one another")
    count = max(2, round(along[-1] / spacing)) + 1
    even = np.linspace(0.0, along[-1], count)
    curve = np.stack([np.interp(even, along, points[:, axis]) for axis in range(3)], axis=1)
    if smoothing > 0.0:
        # Mirrored through its ends a straight line stays straight.
        sigma = smoothing * (count - 1) / along[-1]
        reach = min(count - 1, math.ceil(4 * sigma))
        before = 2 * curve[0] - curve[1 : reach + 1][::-1]
        after = 2 * curve[-1] - curve[-reach - 1 : -1][::-1]
        whole = np.concatenate([before, curve, after])
        curve = gaussian_filter1d(whole, sigma, axis=0)[reach : reach + count]
    return np.asarray(curve)


def _one_piece(lumen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    from scipy.ndimage import label

    parts, count = label(lumen, structure=np.ones((3, 3, 3)))
    if count == 0:
        raise VolumeError("is nowhere in the volume")
    sizes = np.bincount(parts.ravel())[1:]
    if sizes.max() < (1.0 - _PIECE) * sizes.sum():
        raise VolumeError(f"is in {count} pieces")
    return np.asarray(parts == 1 + sizes.argmax())


def _graph(
    lumen: NDArray[np.bool_], voxels: NDArray[np.int64], step: NDArray[np.float64]
) -> coo_matrix:
    number = np.full(np.array(lumen.shape) + 2, -1, dtype=np.int64)
    number[1:-1, 1:-1, 1:-1][lumen] = np.arange(len(voxels))
    ones, others, lengths = [], [], []
    for half in _HALF:
        other = number[tuple((voxels + 1 + half).T)]
        met = np.flatnonzero(other >= 0)
        ones.append(met)
        others.append(other[met])
        lengths.append(np.full(len(met), np.linalg.norm(step @ half)))
    pairs = np.concatenate(ones), np.concatenate(others)
    return coo_matrix((np.concatenate(lengths), pairs), shape=(len(voxels), len(voxels))).tocsr()


def _require_no_branch(
    voxels: NDArray[np.int64], places: NDArray[np.float64], slices: NDArray[np.int64]
) -> None:
    """Refuse a slice, but at the ends, that is not one connected part."""
    from scipy.ndimage import label

    last = slices.max()
    for which in range(2, last - 1):
        within = slices == which
        if not within.any():
            continue  # of a line of voxels that is thinner than they are long
        mine = voxels[within]
        low = mine.min(axis=0)
        box = np.zeros(mine.max(axis=0) - low + 1, dtype=bool)
        box[tuple((mine - low).T)] = True
        parts, count = label(box, structure=np.ones((3, 3, 3)))
        sizes = np.sort(np.bincount(parts.ravel())[1:])
        if count > 1 and sizes[-2] > _BRANCH * sizes.sum():
            x, y, z = 1e3 * places[within].mean(axis=0)
            raise VolumeError(f"branches near ({x:.0f}, {y:.0f}, {z:.0f}) mm")
