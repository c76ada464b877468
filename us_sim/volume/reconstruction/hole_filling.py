"""Filling voxels that no pixel hit, between voxels that some did, up to a distance.

A voxel is filled from two that were hit, on both sides of it along one of 13 directions: the
nearest such pair, linearly by distance (as the sticks of Plus; Vaughan et al., Hole filling with
oriented sticks in ultrasound volume reconstruction, Journal of Medical Imaging 2, 2015). So
nothing grows out of what was scanned.

>>> import numpy as np
>>> from us_sim.volume.reconstruction.hole_filling import fill_holes
>>> grey = np.array([[[10, 0, 40, 0, 0]]], np.uint8)
>>> filled = fill_holes(grey, grey > 0, 2)
>>> grey[0, 0], filled
(array([10, 25, 40,  0,  0], dtype=uint8), 1)
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit

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
