"""Inserting images into voxels, and filling the holes between the voxels that were hit.

Pixels are distributed onto voxels, the nearest or the eight around each (pixel-based methods in
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
from us_sim.volume.files.stored_image import check_memory
from us_sim.volume.reconstruction.grid import Grid

_VOXEL_BYTES = 10  # of memory while images are inserted: sum, weight, grey, coverage
_MEAN, _MAX, _COUNT, _COLLECT = range(4)
_LEAST_WEIGHT = 0.125
"""Of a voxel that takes a pixel whole: the weight of all eight around a pixel in their middle."""


class Insertion:
    """Voxels that the pixels of images are inserted into.

    Args:
        grid: of the voxels.
        method: ``nearest`` or ``linear``.
        compounding: ``mean``, ``max`` or ``median``, which needs all pixels of a voxel at once:
            count every image before the first is inserted.

    Raises:
        VolumeError: the free memory does not hold them.
    """

    def __init__(self, grid: Grid, *, method: str, compounding: str) -> None:
        shown = " × ".join(map(str, grid.shape))
        self.is_median = compounding == "median"
        needed = (_VOXEL_BYTES + 8 * self.is_median) * grid.voxels
        check_memory(needed, f"a volume of {shown} voxels")
        self._shape = np.array(grid.shape, dtype=np.int64)
        self._linear = method == "linear"
        self._mode = {"mean": _MEAN, "max": _MAX, "median": _COLLECT}[compounding]
        # Of each voxel the sum and the weight, or the greatest and 1, or 0 and the count: beside
        # each other, since memory is what inserting waits for.
        self._gathered = np.zeros((grid.voxels, 2), dtype=np.float32)
        self._cursor = np.zeros(1, dtype=np.int64)  # where the next value of a voxel goes
        self._values = np.zeros(0, dtype=np.uint8)  # of all voxels, one after another

    def count(self, points: NDArray[np.float64], to_index: NDArray[np.float64]) -> None:
        """Count pixels that will be inserted; only for medians."""
        self._gather(np.zeros(len(points), dtype=np.uint8), points, to_index, _COUNT)

    def insert(
        self,
        pixels: NDArray[np.uint8],
        points: NDArray[np.float64],
        to_index: NDArray[np.float64],
    ) -> None:
        """Insert pixels (P,) at points (P, 3), which (3, 4) takes to the grid; nan is left out.

        Raises:
            VolumeError: the free memory does not hold all pixels for their medians.
        """
        if self.is_median and not len(self._values):
            ends = np.cumsum(self._gathered[:, 1], dtype=np.int64)
            check_memory(float(ends[-1]), f"keeping {ends[-1]} pixels for their medians")
            self._cursor = np.concatenate([[0], ends[:-1]])
            self._values = np.empty(max(int(ends[-1]), 1), dtype=np.uint8)
        self._gather(pixels, points, to_index, self._mode)

    def result(self) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Grey values (i, j, k), 0 where no pixel came, and where some did."""
        grey = np.zeros(len(self._gathered), dtype=np.uint8)
        if self.is_median:
            _take_medians(self._values, self._cursor, self._gathered, grey)
        else:
            _finish(self._gathered, self._mode == _MEAN, grey)
        covered = self._gathered[:, 1] > 0.0
        return grey.reshape(self._shape), covered.reshape(self._shape)

    def _gather(
        self,
        pixels: NDArray[np.uint8],
        points: NDArray[np.float64],
        to_index: NDArray[np.float64],
        mode: int,
    ) -> None:
        places = self._linear, mode, self._gathered, self._cursor, self._values
        _insert(pixels, np.ascontiguousarray(points), to_index.copy(), self._shape, *places)


@njit(cache=True, nogil=True, error_model="numpy")
def _insert(pixels, points, to_index, shape, linear, mode, gathered, cursor, values):
    """Insert pixels (P,) at points (P, 3) into gathered (N, 2), or cursor (N,) and values."""
    m = to_index
    around, half, fraction = (2, 0.0, 1.0) if linear else (1, 0.5, 0.0)
    for p in range(pixels.shape[0]):
        a, b, c = points[p, 0], points[p, 1], points[p, 2]
        x = m[0, 0] * a + m[0, 1] * b + m[0, 2] * c + m[0, 3]
        y = m[1, 0] * a + m[1, 1] * b + m[1, 2] * c + m[1, 3]
        z = m[2, 0] * a + m[2, 1] * b + m[2, 2] * c + m[2, 3]
        if math.isnan(x):
            continue
        first_i, first_j = math.floor(x + half), math.floor(y + half)
        first_k = math.floor(z + half)
        fx, fy, fz = fraction * (x - first_i), fraction * (y - first_j), fraction * (z - first_k)
        fits = 0 <= first_i < shape[0] - 1 and 0 <= first_j < shape[1] - 1
        if linear and mode == _MEAN and fits and 0 <= first_k < shape[2] - 1:
            value = np.float32(pixels[p])  # as below, in less time
            for corner in range(4):
                i, j = corner // 2, corner % 2
                flat = (fx if i else 1.0 - fx) * (fy if j else 1.0 - fy)
                voxel = ((first_i + i) * shape[1] + first_j + j) * shape[2] + first_k
                second = np.float32(flat * fz)
                first = np.float32(flat) - second
                gathered[voxel, 0] += first * value
                gathered[voxel, 1] += first
                gathered[voxel + 1, 0] += second * value
                gathered[voxel + 1, 1] += second
            continue
        for i in range(max(first_i, 0), min(first_i + around, shape[0])):
            for j in range(max(first_j, 0), min(first_j + around, shape[1])):
                flat = (1.0 - fx if i == first_i else fx) * (1.0 - fy if j == first_j else fy)
                row = (i * shape[1] + j) * shape[2]
                for k in range(max(first_k, 0), min(first_k + around, shape[2])):
                    weight = np.float32(flat * (1.0 - fz if k == first_k else fz))
                    voxel = row + k
                    if mode == _MEAN:
                        gathered[voxel, 0] += weight * np.float32(pixels[p])
                        gathered[voxel, 1] += weight
                    elif weight < _LEAST_WEIGHT:
                        continue
                    elif mode == _MAX:
                        gathered[voxel, 0] = max(gathered[voxel, 0], np.float32(pixels[p]))
                        gathered[voxel, 1] = 1.0
                    elif mode == _COUNT:
                        gathered[voxel, 1] += 1.0
                    else:
                        values[cursor[voxel]] = pixels[p]
                        cursor[voxel] += 1


@njit(cache=True, nogil=True, error_model="numpy")
def _finish(gathered, is_sum, grey):
    """Fill grey (N,) from what was gathered (N, 2)."""
    for voxel in range(grey.shape[0]):
        weight = gathered[voxel, 1]
        if weight > 0.0:
            value = gathered[voxel, 0] / weight if is_sum else gathered[voxel, 0]
            grey[voxel] = np.uint8(min(value + np.float32(0.5), 255.0))


@njit(cache=True, nogil=True, error_model="numpy")
def _take_medians(values, ends, counts, grey):
    """Fill grey (N,) with medians of each voxel's values, which end before ends (N,)."""
    for voxel in range(grey.shape[0]):
        count = np.int64(counts[voxel, 1])
        if count > 0:
            own = np.sort(values[ends[voxel] - count : ends[voxel]])
            middle = np.int64(own[count // 2]) + np.int64(own[(count - 1) // 2])
            grey[voxel] = np.uint8((middle + 1) // 2)


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
    """Fill holes in place; how many voxels were filled.

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
def _fill(grey, covered, wanted, directions, steps):
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
    """Steps (a, b, c) from a voxel to a covered one; 0 where none is near enough."""
    for step in range(1, most + 1):
        i, j, k = i + a, j + b, k + c
        if not (
            0 <= i < covered.shape[0] and 0 <= j < covered.shape[1] and 0 <= k < covered.shape[2]
        ):
            return 0
        if covered[i, j, k]:
            return step
    return 0
