"""The centre line of a vessel from the voxels of its lumen, or why they are no tube.

Voxels are walked from one end of the lumen to the other, along shortest paths within it. Those
equally far from the end form a slice across the vessel, be it curved or not, and the centres of the
slices are its centre line (A. Verroust, F. Lazarus, Extracting skeletal curves from 3D scattered
data, Visual Computer 16, 2000). Where a slice falls apart, the vessel branches.

>>> import numpy as np
>>> from us_sim.slicing.flow.centreline import centreline
>>> x, z = np.meshgrid(np.arange(13) - 6, np.arange(13) - 6, indexing="ij")
>>> tube = np.repeat((x**2 + z**2 < 16)[:, None], 40, axis=1)
>>> line = centreline(tube, np.diag([1e-3, 1e-3, 1e-3, 1.0]))
>>> bool(np.allclose(line.points[:, [0, 2]], 6e-3, atol=4e-4)), round(line.width * 1e3)
(True, 7)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, label
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from us_sim.errors import VolumeError

_MOST = 60_000
"""Voxels of a lumen that are walked; of more, every second along each axis is."""

_SLENDER = 3.0
"""Least length of a vessel over its width."""

_PIECE = 0.05
"""Fraction of its voxels that may lie apart from a vessel, as segmentations have crumbs."""

_BRANCH = 0.2
"""Fraction of a slice from which a part that lies apart from the rest is a branch."""

_HALF = [
    (i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1) if (i, j, k) > (0, 0, 0)
]
"""Steps to one of each two opposite neighbours of a voxel."""


@dataclass(frozen=True, eq=False)
class Centreline:
    """The middle of a tube from one end to the other."""

    points: NDArray[np.float64]  # (P, 3) m, evenly spaced
    width: float  # m, diameter of a circle of the tube's mean area


def centreline(lumen: NDArray[np.bool_], index_to_patient: NDArray[np.float64]) -> Centreline:
    """The centre line of the voxels of a lumen.

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
    start = _farthest(dijkstra(graph, directed=False, indices=0))
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
    return Centreline(resampled(inner, 0.25 * width, smoothing=0.5 * width), width)


def resampled(
    points: NDArray[np.float64], spacing: float, smoothing: float = 0.0
) -> NDArray[np.float64]:
    """(Q, 3) m: a curve (P, 3) smoothed, with points about ``spacing`` apart, evenly.

    Args:
        smoothing: m, standard deviation of the averaging along the curve. Its ends stay.

    Raises:
        VolumeError: the curve is shorter than the spacing.
    """
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
    """The largest connected part, if the others are crumbs."""
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
    """Distances (m) between neighbouring voxels, as a sparse matrix."""
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


def _farthest(distance: NDArray[np.float64]) -> int:
    return int(np.argmax(np.where(np.isfinite(distance), distance, -1.0)))


def _require_no_branch(
    voxels: NDArray[np.int64], places: NDArray[np.float64], slices: NDArray[np.int64]
) -> None:
    """Each slice but those of the ends is one connected part."""
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
