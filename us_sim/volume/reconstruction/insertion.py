"""Inserting images into voxels, and filling the holes between the voxels that were hit.

Pixels are distributed onto voxels, the nearest or the eight around each (pixel-based methods in
Solberg et al., Freehand 3D ultrasound reconstruction algorithms - a review, Ultrasound in Medicine
and Biology 33, 2007), one image after the other, so that a volume grows while a probe is moving.

A voxel that no pixel hit is filled from two that were, on both sides of it along one of 13
directions: the nearest such pair, linearly by distance (as the sticks of Plus; Vaughan et al., Hole
filling with oriented sticks in ultrasound volume reconstruction, Journal of Medical Imaging 2,
2015). So nothing grows beyond the scanned part.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit
from us_sim.volume.reconstruction.grid import Grid, check_memory

VOXEL_BYTES = 10  # of memory a voxel while images are inserted: sum, weight, grey, coverage

_MODES = {"mean": 0, "max": 1, "latest": 2, "plus_mean": 3}
_MEAN, _MAX, _LATEST, _PLUS_MEAN, _COUNT, _COLLECT = range(6)
_LEAST_WEIGHT = 0.125
"""Of a voxel that takes a pixel whole: the weight of all eight around a pixel in their middle."""
_TILE = 32  # pixels along a side
_PLUS_PLACES = 2.0**14
"""Of a voxel; its fixed-point numbers have 14 bits behind the point (IGSIO, fixed.h)."""
_PLUS_ONE, _PLUS_FULL, _PLUS_MOST = 256.0, 65279.0, 65535.0
"""Plus counts a pixel as 256 up to a sum that 16 bits hold, and then takes 1/256 of each."""


class Insertion:
    """Voxels that images are inserted into.

    Args:
        grid: of the voxels.
        method: ``nearest`` or ``linear``.
        compounding: ``mean``, ``max``, ``latest`` or ``plus_mean``; medians need all pixels of a
            voxel at once, see `Collection`.
        plus_rounding: places of pixels are rounded as Plus does.

    Raises:
        VolumeError: the free memory does not hold them.
    """

    def __init__(
        self, grid: Grid, *, method: str, compounding: str, plus_rounding: bool = False
    ) -> None:
        check_memory(VOXEL_BYTES * grid.voxels, f"a volume of {_shown(grid)} voxels")
        self.grid = grid
        self._plus_rounding = plus_rounding
        self._linear = method == "linear"
        self._mode = _MODES[compounding]
        # Of each voxel the sum and the weight, or the value and whether there is one: beside each
        # other, since memory is what inserting waits for.
        self._gathered = np.zeros((grid.voxels, 2), dtype=np.float32)

    def insert(
        self,
        image: NDArray[np.uint8],
        image_to_reference: NDArray[np.float64],
        used: NDArray[np.bool_],
    ) -> None:
        """Insert an image.

        Args:
            image: (rows, columns).
            image_to_reference: (4, 4) m, from (column, row, 0, 1).
            used: (rows, columns) which pixels are inserted.
        """
        step = _step(self.grid, image_to_reference)
        if self._plus_rounding:
            step = np.trunc(step * _PLUS_PLACES + np.copysign(0.5, step)) / _PLUS_PLACES
        shape = np.array(self.grid.shape, dtype=np.int64)
        if self._mode == _MEAN and not self._linear:
            _add_nearest(image, used, step, shape, self._gathered)
            return
        places = self._linear, self._mode, self._gathered, _NO_CURSOR, _NO_VALUES
        _insert_image(image, used, step, shape, *places)

    def insert_points(self, values: NDArray[np.uint8], points: NDArray[np.float64]) -> None:
        """Insert pixels wherever they lie.

        Args:
            values: (N,).
            points: (N, 3) m, in the grid's reference frame; nan is left out.
        """
        to_index = self.grid.reference_to_index
        placed = points @ to_index[:3, :3].T + to_index[:3, 3]
        shape = np.array(self.grid.shape, dtype=np.int64)
        places = self._linear, self._mode, self._gathered, _NO_CURSOR, _NO_VALUES
        _insert_points(values, np.ascontiguousarray(placed), shape, *places)

    def clear(self) -> None:
        """Forget every image."""
        self._gathered[:] = 0.0

    def result(self) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Grey values (i, j, k), 0 where no pixel came, and where some did."""
        grey = np.zeros(self.grid.voxels, dtype=np.uint8)
        covered = np.zeros(self.grid.voxels, dtype=np.bool_)
        _finish(self._gathered, self._mode == _MEAN, grey, covered)
        return grey.reshape(self.grid.shape), covered.reshape(self.grid.shape)


class Collection:
    """All pixels of every voxel, for medians, which need them at once.

    Args:
        grid: of the voxels.
        method: as of `Insertion`; with ``linear``, a pixel belongs to the voxels around it that
            have an eighth of its weight or more.
    """

    def __init__(self, grid: Grid, *, method: str) -> None:
        check_memory((VOXEL_BYTES + 8) * grid.voxels, f"a volume of {_shown(grid)} voxels")
        self.grid = grid
        self._linear = method == "linear"
        self._shape = np.array(grid.shape, dtype=np.int64)
        self._counts = np.zeros((grid.voxels, 2), dtype=np.float32)
        self._cursor = _NO_CURSOR
        self._values = _NO_VALUES

    def count(self, image_to_reference: NDArray[np.float64], used: NDArray[np.bool_]) -> None:
        """Count an image's pixels, all before the first is collected."""
        image = np.broadcast_to(np.uint8(0), used.shape)
        self._go_through(np.ascontiguousarray(image), image_to_reference, used, _COUNT)

    def reserve(self) -> None:
        """Take the memory for the counted pixels.

        Raises:
            VolumeError: there is not enough.
        """
        ends = np.cumsum(self._counts[:, 1], dtype=np.int64)
        check_memory(float(ends[-1]), f"keeping {ends[-1]} pixels for their medians")
        self._cursor = np.concatenate([[0], ends[:-1]])
        self._values = np.empty(max(int(ends[-1]), 1), dtype=np.uint8)

    def insert(
        self,
        image: NDArray[np.uint8],
        image_to_reference: NDArray[np.float64],
        used: NDArray[np.bool_],
    ) -> None:
        """Collect the pixels of an image that was counted; arguments as of `Insertion.insert`."""
        self._go_through(image, image_to_reference, used, _COLLECT)

    def result(self) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Medians (i, j, k), of an even number the mean of the middle two, and where there are."""
        grey = np.zeros(self.grid.voxels, dtype=np.uint8)
        _medians(self._values, self._cursor, self._counts, grey)
        covered = self._counts[:, 1] > 0.0
        return grey.reshape(self.grid.shape), covered.reshape(self.grid.shape)

    def _go_through(
        self,
        image: NDArray[np.uint8],
        image_to_reference: NDArray[np.float64],
        used: NDArray[np.bool_],
        mode: int,
    ) -> None:
        step = _step(self.grid, image_to_reference)
        places = self._linear, mode, self._counts, self._cursor, self._values
        _insert_image(image, used, step, self._shape, *places)


_NO_CURSOR = np.zeros(1, dtype=np.int64)
_NO_VALUES = np.zeros(1, dtype=np.uint8)


def _step(grid: Grid, image_to_reference: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) columns: index of pixel (0, 0), step to the next column, to the next row."""
    to_index = grid.reference_to_index @ image_to_reference
    return np.ascontiguousarray(to_index[:3, [3, 0, 1]])


def _shown(grid: Grid) -> str:
    return " × ".join(map(str, grid.shape))


@njit(cache=True, nogil=True, error_model="numpy")
def _insert_image(image, used, step, shape, linear, mode, gathered, cursor, values):
    """Insert the used pixels of an image.

    image, used: (rows, columns). step: (3, 3), columns: index of pixel (0, 0), step to the next
    column, to the next row. shape: (3,). gathered: (N, 2). cursor: (N,) where the next value of a
    voxel goes. values: of all voxels, one after another.
    """
    in_order = mode in (_LATEST, _PLUS_MEAN)
    # Tile by tile, so that voxels are in the cache when the next row of pixels comes to them.
    height = image.shape[0] if in_order else _TILE
    width = image.shape[1] if in_order else _TILE
    for top in range(0, image.shape[0], height):
        for left in range(0, image.shape[1], width):
            for row in range(top, min(top + height, image.shape[0])):
                x0 = step[0, 0] + step[0, 2] * row
                y0 = step[1, 0] + step[1, 2] * row
                z0 = step[2, 0] + step[2, 2] * row
                for column in range(left, min(left + width, image.shape[1])):
                    if used[row, column]:
                        x = x0 + step[0, 1] * column
                        y = y0 + step[1, 1] * column
                        z = z0 + step[2, 1] * column
                        pixel = image[row, column]
                        _insert(x, y, z, pixel, shape, linear, mode, gathered, cursor, values)


@njit(cache=True, nogil=True, error_model="numpy")
def _add_nearest(image, used, step, shape, gathered):
    """As `_insert_image` does for the mean of nearest voxels, in a third of the time."""
    for row in range(image.shape[0]):
        x0 = step[0, 0] + step[0, 2] * row
        y0 = step[1, 0] + step[1, 2] * row
        z0 = step[2, 0] + step[2, 2] * row
        for column in range(image.shape[1]):
            if used[row, column]:
                x = x0 + step[0, 1] * column
                y = y0 + step[1, 1] * column
                z = z0 + step[2, 1] * column
                if not (
                    -0.5 <= x < shape[0] - 0.5
                    and -0.5 <= y < shape[1] - 0.5
                    and -0.5 <= z < shape[2] - 0.5
                ):
                    continue
                # Nothing is below zero here, so that cutting off rounds.
                i, j, k = np.int64(x + 0.5), np.int64(y + 0.5), np.int64(z + 0.5)
                voxel = (i * shape[1] + j) * shape[2] + k
                gathered[voxel, 0] += np.float32(image[row, column])
                gathered[voxel, 1] += np.float32(1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _insert_points(pixels, points, shape, linear, mode, gathered, cursor, values):
    """Insert pixels (P,) at indices (P, 3); the rest as for `_insert_image`."""
    for p in range(pixels.shape[0]):
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        if not math.isnan(x):
            _insert(x, y, z, pixels[p], shape, linear, mode, gathered, cursor, values)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _insert(x, y, z, pixel, shape, linear, mode, gathered, cursor, values):
    """Insert a pixel at index (x, y, z) into the voxels of the grid around it."""
    if not linear:
        if not (-0.5 <= x < shape[0] - 0.5 and -0.5 <= y < shape[1] - 0.5):
            return
        if not -0.5 <= z < shape[2] - 0.5:
            return
        # Nothing is below zero here, so that cutting off rounds.
        i, j, k = np.int64(x + 0.5), np.int64(y + 0.5), np.int64(z + 0.5)
        voxel = (i * shape[1] + j) * shape[2] + k
        _gather(voxel, pixel, 1.0, False, mode, gathered, cursor, values)
        return
    i0 = np.int64(math.floor(x))
    j0 = np.int64(math.floor(y))
    k0 = np.int64(math.floor(z))
    fx, fy, fz = x - i0, y - j0, z - k0
    inside = 0 <= i0 < shape[0] - 1 and 0 <= j0 < shape[1] - 1 and 0 <= k0 < shape[2] - 1
    if inside and mode == _MEAN:
        voxel = (i0 * shape[1] + j0) * shape[2] + k0
        _add_row(gathered, voxel, (1.0 - fx) * (1.0 - fy), fz, pixel)
        _add_row(gathered, voxel + shape[2], (1.0 - fx) * fy, fz, pixel)
        voxel += shape[1] * shape[2]
        _add_row(gathered, voxel, fx * (1.0 - fy), fz, pixel)
        _add_row(gathered, voxel + shape[2], fx * fy, fz, pixel)
        return
    for corner in range(8):
        a, b, c = (corner >> 2) & 1, (corner >> 1) & 1, corner & 1
        i, j, k = i0 + a, j0 + b, k0 + c
        weight = (fx if a else 1.0 - fx) * (fy if b else 1.0 - fy) * (fz if c else 1.0 - fz)
        if weight > 0.0 and 0 <= i < shape[0] and 0 <= j < shape[1] and 0 <= k < shape[2]:
            voxel = (i * shape[1] + j) * shape[2] + k
            _gather(voxel, pixel, weight, True, mode, gathered, cursor, values)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _add_row(gathered, voxel, weight, fraction, pixel):
    """Add a pixel of a weight to a voxel and the next along the last axis."""
    value = np.float32(pixel)
    second = np.float32(weight * fraction)
    first = np.float32(weight) - second
    gathered[voxel, 0] += first * value
    gathered[voxel, 1] += first
    gathered[voxel + 1, 0] += second * value
    gathered[voxel + 1, 1] += second


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _gather(voxel, pixel, weight, linear, mode, gathered, cursor, values):
    """Give a voxel a pixel of a weight."""
    value = np.float64(pixel)
    if mode == _MEAN:
        gathered[voxel, 0] += weight * value
        gathered[voxel, 1] += weight
    elif mode == _PLUS_MEAN:
        old, total = np.float64(gathered[voxel, 0]), np.float64(gathered[voxel, 1])
        if linear:
            before = total / _PLUS_ONE
            gathered[voxel, 0] = math.floor(
                (weight * value + before * old) / (weight + before) + 0.5
            )
            gathered[voxel, 1] = min(math.floor((weight + before) * _PLUS_ONE + 0.5), _PLUS_MOST)
        elif total <= _PLUS_FULL:
            gathered[voxel, 0] = math.floor((value * _PLUS_ONE + old * total) / (total + _PLUS_ONE))
            gathered[voxel, 1] = total + _PLUS_ONE
        else:
            gathered[voxel, 0] = math.floor((value + old * (_PLUS_ONE - 1.0)) / _PLUS_ONE)
    elif weight >= _LEAST_WEIGHT:
        if mode == _MAX:
            gathered[voxel, 0] = max(gathered[voxel, 0], np.float32(value))
        elif mode == _LATEST:
            gathered[voxel, 0] = value
        elif mode == _COLLECT:
            values[cursor[voxel]] = pixel
            cursor[voxel] += 1
        if mode == _COUNT:
            gathered[voxel, 1] += 1.0
        elif mode != _COLLECT:
            gathered[voxel, 1] = 1.0


@njit(cache=True, nogil=True, error_model="numpy")
def _finish(gathered, is_sum, grey, covered):
    """Grey values (N,) and coverage (N,) of what was gathered (N, 2)."""
    for voxel in range(grey.shape[0]):
        weight = gathered[voxel, 1]
        if weight > 0.0:
            covered[voxel] = True
            value = gathered[voxel, 0] / weight if is_sum else gathered[voxel, 0]
            grey[voxel] = np.uint8(min(max(value + np.float32(0.5), 0.0), 255.0))


@njit(cache=True, nogil=True, error_model="numpy")
def _medians(values, ends, counts, grey):
    """Medians (N,) of each voxel's values, which end before ends (N,); counts (N, 2)."""
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
"""One of each pair of opposite neighbours among the 26 of a voxel."""


def fill_holes(grey: NDArray[np.uint8], covered: NDArray[np.bool_], radius: float) -> int:
    """Fill holes in place; how many voxels were filled.

    Args:
        grey: (i, j, k), changed in place.
        covered: (i, j, k) which voxels were hit; the filled are added.
        radius: of the largest hole, voxels: what it is filled from is twice as far apart at most.
    """
    if radius < 1.0:
        return 0
    candidate = np.zeros(covered.shape, dtype=np.uint8)
    _mark_near(covered.view(np.uint8), np.int64(radius), candidate)
    apart = 2.0 * radius / np.linalg.norm(_DIRECTIONS, axis=1)
    steps = np.floor(apart + 1e-9).astype(np.int64)
    filled = int(_fill(grey, covered.view(np.uint8), candidate, _DIRECTIONS, steps))
    covered |= candidate.view(np.bool_)  # those that could not be filled are no candidates now
    return filled


@njit(cache=True, nogil=True, error_model="numpy")
def _mark_near(covered, radius, near):
    """Mark in near (i, j, k) what is not covered, and in a cube around something that is.

    Most of a volume is far from any. The cube is gone through axis by axis.
    """
    shape = covered.shape
    along = np.empty(shape[2], dtype=np.uint8)
    plane = np.empty((shape[1], shape[2]), dtype=np.uint8)
    for i in range(shape[0]):
        plane[:] = 0
        for j in range(shape[1]):
            _widen(covered[i, j], radius, along)
            for other in range(max(j - radius, 0), min(j + radius + 1, shape[1])):
                for k in range(shape[2]):
                    plane[other, k] |= along[k]
        for other in range(max(i - radius, 0), min(i + radius + 1, shape[0])):
            for j in range(shape[1]):
                for k in range(shape[2]):
                    near[other, j, k] |= plane[j, k]
    for i in range(shape[0]):
        for j in range(shape[1]):
            for k in range(shape[2]):
                near[i, j, k] &= 1 - covered[i, j, k]


@njit(cache=True, nogil=True, error_model="numpy")
def _widen(row, radius, wide):
    """Mark in wide (k,) what is within the radius of something marked in row (k,)."""
    for k in range(row.shape[0]):
        wide[k] = row[k]
    for shift in range(1, radius + 1):
        for k in range(row.shape[0] - shift):
            wide[k] |= row[k + shift]
            wide[k + shift] |= row[k]


@njit(cache=True, nogil=True, error_model="numpy")
def _fill(grey, covered, candidate, directions, steps):
    """Fill the candidates (i, j, k) that lie between covered voxels; the others are unmarked.

    directions: (13, 3), the shortest first. steps: (13,) by which both sides may be apart.
    """
    filled = 0
    shape = np.array(grey.shape)
    values, known, wanted = grey.reshape(-1), covered.reshape(-1), candidate.reshape(-1)
    offset = (directions[:, 0] * shape[1] + directions[:, 1]) * shape[2] + directions[:, 2]
    square = (directions**2).sum(axis=1)
    for voxel in range(wanted.shape[0]):
        if not wanted[voxel]:
            continue
        k = voxel % shape[2]
        j = (voxel // shape[2]) % shape[1]
        i = voxel // (shape[2] * shape[1])
        margin = min(i, j, k, shape[0] - 1 - i, shape[1] - 1 - j, shape[2] - 1 - k)
        shortest, total, count = np.int64(1 << 60), 0.0, 0
        for d in range(directions.shape[0]):
            if 4 * square[d] > shortest:
                break  # no pair along this or a later direction is nearer
            most = steps[d] - 1
            reach = reach_behind = most
            if margin < most:
                reach = _reach(shape, i, j, k, directions[d], 1, most)
                reach_behind = _reach(shape, i, j, k, directions[d], -1, most)
            ahead = _distance(known, voxel, offset[d], reach)
            if ahead == 0:
                continue
            reach_behind = min(reach_behind, steps[d] - ahead)
            behind = _distance(known, voxel, -offset[d], reach_behind)
            if behind == 0:
                continue
            length = (ahead + behind) ** 2 * square[d]
            if length > shortest:
                continue
            if length < shortest:
                shortest, total, count = length, 0.0, 0
            first = np.float64(values[voxel + ahead * offset[d]])
            second = np.float64(values[voxel - behind * offset[d]])
            total += (first * behind + second * ahead) / (ahead + behind)
            count += 1
        if count:
            values[voxel] = np.uint8(total / count + 0.5)
            filled += 1
        else:
            wanted[voxel] = 0
    return filled


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _distance(known, voxel, offset, most):
    """Steps from a voxel to a covered one; 0 where none is near enough."""
    for step in range(1, most + 1):
        if known[voxel + step * offset]:
            return step
    return 0


@njit(cache=True, nogil=True, error_model="numpy")
def _reach(shape, i, j, k, direction, sign, most):
    """Steps from (i, j, k) along a direction that stay in the volume, ``most`` at most."""
    for step in range(1, most + 1):
        x = i + sign * step * direction[0]
        y = j + sign * step * direction[1]
        z = k + sign * step * direction[2]
        if not (0 <= x < shape[0] and 0 <= y < shape[1] and 0 <= z < shape[2]):
            return step - 1
    return most
