"""Inserting images into voxels, and filling the holes between the voxels that were hit.

Every pixel goes into the nearest voxel, which holds the mean of its pixels (a pixel-based method in
Solberg et al., Freehand 3D ultrasound reconstruction algorithms - a review, Ultrasound in Medicine
and Biology 33, 2007).

A voxel that no pixel hit is filled from two that were, on both sides of it along one of 13
directions: the nearest such pair, linearly by distance (as the sticks of Plus; Vaughan et al., Hole
filling with oriented sticks in ultrasound volume reconstruction, Journal of Medical Imaging 2,
2015). So nothing grows beyond the scanned part.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from us_sim.kernels import njit


@njit(cache=True, nogil=True, error_model="numpy")
def insert_pixels(pixels, points, to_index, total, count):
    """Add pixels (P,) at points (P, 3), which (3, 4) takes to the grid, to voxels (i, j, k).

    Points that are nan, or beside the grid, are left out. total: sums. count: pixels.
    """
    m = to_index
    for p in range(pixels.shape[0]):
        a, b, c = points[p, 0], points[p, 1], points[p, 2]
        x = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c + m[0, 3]
        y = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c + m[1, 3]
        z = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c + m[2, 3]
        if math.isnan(x):
            continue
        i, j, k = math.floor(x + 0.5), math.floor(y + 0.5), math.floor(z + 0.5)
        if 0 <= i < total.shape[0] and 0 <= j < total.shape[1] and 0 <= k < total.shape[2]:
            total[i, j, k] += pixels[p]
            count[i, j, k] += 1


def compute_means(
    total: NDArray[np.uint32], count: NDArray[np.uint32]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Return the mean of each voxel's pixels, 0 without any, and where there are some."""
    covered = count > 0
    grey = np.zeros(total.shape, np.uint8)
    grey[covered] = (total[covered] + count[covered] // 2) // count[covered]
    return grey, covered


_DIRECTIONS = np.array(
    [
        *((0, 0, 1), (0, 1, 0), (1, 0, 0)),
        *((0, 1, 1), (0, 1, -1), (1, 0, 1), (1, 0, -1), (1, 1, 0), (1, -1, 0)),
        *((1, 1, 1), (1, 1, -1), (1, -1, 1), (1, -1, -1)),
    ],
    dtype=np.int64,
)
"""One of each pair of opposite neighbours among the 26 of a voxel, the shortest first."""


def fill_holes(grey: NDArray[np.uint8], covered: NDArray[np.bool_], radius: float) -> int:
    """Fill holes in place; return how many voxels were filled.

    Args:
        grey: (i, j, k), changed in place.
        covered: (i, j, k) which voxels were hit; the filled are added.
        radius: of the largest hole, voxels: what it is filled from is twice as far apart at most.
    """
    if radius < 1.0:
        return 0
    # Most of a volume is far from all that was hit.
    filled = ndimage.maximum_filter(covered, 2 * int(radius) + 1, mode="constant") & ~covered
    apart = 2.0 * radius / np.linalg.norm(_DIRECTIONS, axis=1)
    _fill(grey, covered, filled, _DIRECTIONS, np.floor(apart + 1e-9).astype(np.int64))
    covered |= filled
    return int(np.count_nonzero(filled))


@njit(cache=True, nogil=True, error_model="numpy")
def _fill(grey, covered, wanted, directions, steps):  # noqa: C901 - one loop of a kernel
    """Fill those wanted (i, j, k) that lie between covered voxels, and unmark the others.

    directions: (13, 3). steps: (13,) by which both sides may be apart.
    """
    square = (directions**2).sum(axis=1)
    for i in range(grey.shape[0]):
        for j in range(grey.shape[1]):
            for k in range(grey.shape[2]):
                if not wanted[i, j, k]:
                    continue
                shortest, total, count = np.int64(1 << 60), 0.0, 0
                for d in range(directions.shape[0]):
                    if 4 * square[d] > shortest:
                        break  # no pair along this or a later direction is nearer
                    a, b, c = directions[d]
                    ahead = _distance(covered, i, j, k, a, b, c, steps[d] - 1)
                    if ahead == 0:
                        continue
                    behind = _distance(covered, i, j, k, -a, -b, -c, steps[d] - ahead)
                    length = (ahead + behind) ** 2 * square[d]
                    if behind == 0 or length > shortest:
                        continue
                    if length < shortest:
                        shortest, total, count = length, 0.0, 0
                    first = np.float64(grey[i + ahead * a, j + ahead * b, k + ahead * c])
                    second = np.float64(grey[i - behind * a, j - behind * b, k - behind * c])
                    total += (first * behind + second * ahead) / (ahead + behind)
                    count += 1
                if count:
                    grey[i, j, k] = np.uint8(total / count + 0.5)
                wanted[i, j, k] = count > 0


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _distance(covered, i, j, k, a, b, c, most):
    """Count steps (a, b, c) from a voxel to a covered one; 0 where none is near enough."""
    for step in range(1, most + 1):
        i, j, k = i + a, j + b, k + c
        if not (
            0 <= i < covered.shape[0] and 0 <= j < covered.shape[1] and 0 <= k < covered.shape[2]
        ):
            return 0
        if covered[i, j, k]:
            return step
    return 0
