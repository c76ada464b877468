"""Normals of the surfaces between labels, at rest: for each voxel beside another label.

The normal is the gradient of what lies within a few voxels: 1 where it has the voxel's own label
and 0 elsewhere, weighted as a Gaussian. So the steps of voxels are smoothed away. It is a covector
of voxel indices, as the gradient of a function of these is. The weighted mean of the same tells how
far the surface is from the voxel's centre: of a half space it is the normal distribution.

Normals are kept in blocks of 8³ voxels, where there are surfaces at all.

>>> import numpy as np
>>> from us_sim.slicing.acoustics.surface_normals import SurfaceNormals
>>> labels = np.zeros((24, 24, 24), np.uint8)
>>> labels[:, :, 12:] = 1
>>> normal, distance = SurfaceNormals(labels).at(10, 10, 12)
>>> normal, round(distance, 1)  # the surface is half a voxel before the voxel's centre
(array([0., 0., 1.]), 0.5)
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit
from us_sim.volume.volume import Volume

BLOCK = 8
DISTANCE = 40.0
"""Parts of a voxel in which the distance of a surface is kept."""

_REACH = 3  # voxels
_SIGMA = 1.5  # voxels
_PARTS = 256  # of the weighted mean that are told apart


class SurfaceNormals:
    """Of a volume's labels (i, j, k)."""

    def __init__(self, labels: NDArray[np.uint8]) -> None:
        shape = np.array(labels.shape, dtype=np.int64)
        self.blocks = np.full(tuple(-(-shape // BLOCK)), -1, dtype=np.int32)
        offset = np.arange(-_REACH, _REACH + 1)
        weights = np.exp(-0.5 * (offset / _SIGMA) ** 2)
        weights = (weights / weights.sum()).astype(np.float32)
        flat = labels.reshape(-1)
        count = _mark_blocks(flat, shape, self.blocks)
        self.normals = np.zeros((count, BLOCK**3, 4), dtype=np.int8)
        _fill_normals(flat, shape, weights, _DISTANCES, self.blocks, self.normals)

    def at(self, i: int, j: int, k: int) -> tuple[NDArray[np.float64], float]:
        """(3,) into the voxel's own label, of length 1, and how many voxels away the surface is.

        Zeros where there is no surface.
        """
        block = self.blocks[i // BLOCK, j // BLOCK, k // BLOCK]
        if block < 0:
            return np.zeros(3), 0.0
        within = ((i % BLOCK) * BLOCK + j % BLOCK) * BLOCK + k % BLOCK
        found = self.normals[block, within]
        return np.asarray(found[:3] / 127.0), float(found[3] / DISTANCE)


def _distances() -> NDArray[np.int8]:
    """(`_PARTS`,) how far a plane is in `DISTANCE`-ths of a voxel, by the part on this side."""
    part = (np.arange(_PARTS) + 0.5) / _PARTS
    # A Gaussian that ends at the reach, of voxels: as the mean of a half space's would be.
    offset = np.arange(-_REACH, _REACH + 1)
    weights = np.exp(-0.5 * (offset / _SIGMA) ** 2)
    total = np.concatenate([[0.0], np.cumsum(weights / weights.sum())])
    return (
        np.asarray(np.rint(DISTANCE * np.interp(part, total, np.append(offset, _REACH + 1) - 0.5)))
        .clip(-127, 127)
        .astype(np.int8)
    )


_DISTANCES = _distances()
_found: WeakKeyDictionary[Volume, SurfaceNormals] = WeakKeyDictionary()


def surface_normals_of(volume: Volume) -> SurfaceNormals:
    """The normals of a volume's labels, found when they are first asked for (about a second)."""
    assert volume.labels is not None
    if volume not in _found:
        _found[volume] = SurfaceNormals(volume.labels)
    return _found[volume]


@njit(cache=True, nogil=True, error_model="numpy")
def _beside_another(labels, shape, i, j, k):
    """Whether one of a voxel's six neighbours has another label."""
    to_i = shape[1] * shape[2]
    to_j = shape[2]
    at = i * to_i + j * to_j + k
    own = labels[at]
    return (
        (i > 0 and labels[at - to_i] != own)
        or (i < shape[0] - 1 and labels[at + to_i] != own)
        or (j > 0 and labels[at - to_j] != own)
        or (j < shape[1] - 1 and labels[at + to_j] != own)
        or (k > 0 and labels[at - 1] != own)
        or (k < shape[2] - 1 and labels[at + 1] != own)
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _touches_another(labels, shape, i, j, k):
    """Whether a voxel has another label than one that it shares a face, edge or corner with.

    A beam may pass from voxel to voxel through any of these.
    """
    own = labels[(i * shape[1] + j) * shape[2] + k]
    for p in range(max(i - 1, 0), min(i + 2, shape[0])):
        for q in range(max(j - 1, 0), min(j + 2, shape[1])):
            row = (p * shape[1] + q) * shape[2]
            for r in range(max(k - 1, 0), min(k + 2, shape[2])):
                if labels[row + r] != own:
                    return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def _mark_blocks(labels, shape, blocks):
    """Numbers the blocks that have a surface; returns how many there are."""
    count = 0
    for a in range(blocks.shape[0]):
        for b in range(blocks.shape[1]):
            for c in range(blocks.shape[2]):
                if _has_surface(labels, shape, a * BLOCK, b * BLOCK, c * BLOCK):
                    blocks[a, b, c] = count
                    count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _has_surface(labels, shape, i0, j0, k0):
    for i in range(i0, min(i0 + BLOCK, shape[0])):
        for j in range(j0, min(j0 + BLOCK, shape[1])):
            for k in range(k0, min(k0 + BLOCK, shape[2])):
                if _beside_another(labels, shape, i, j, k):
                    return True
    return False


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_normals(labels, shape, weights, distances, blocks, normals):
    for a in range(blocks.shape[0]):
        for b in range(blocks.shape[1]):
            for c in range(blocks.shape[2]):
                block = blocks[a, b, c]
                if block < 0:
                    continue
                i0, j0, k0 = a * BLOCK, b * BLOCK, c * BLOCK
                for i in range(i0, min(i0 + BLOCK, shape[0])):
                    for j in range(j0, min(j0 + BLOCK, shape[1])):
                        for k in range(k0, min(k0 + BLOCK, shape[2])):
                            if _touches_another(labels, shape, i, j, k):
                                within = ((i - i0) * BLOCK + j - j0) * BLOCK + k - k0
                                _gradient(
                                    labels, shape, weights, distances, i, j, k,
                                    normals[block, within],
                                )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _gradient(labels, shape, weights, distances, i, j, k, out):
    """Sets the unit normal in 127ths, and the surface's distance."""
    own = labels[(i * shape[1] + j) * shape[2] + k]
    x = y = z = total = np.float32(0.0)
    for a in range(-_REACH, _REACH + 1):
        p = min(max(i + a, 0), shape[0] - 1)
        for b in range(-_REACH, _REACH + 1):
            q = min(max(j + b, 0), shape[1] - 1)
            row = (p * shape[1] + q) * shape[2]
            both = weights[a + _REACH] * weights[b + _REACH]
            for c in range(-_REACH, _REACH + 1):
                r = min(max(k + c, 0), shape[2] - 1)
                if labels[row + r] == own:
                    w = both * weights[c + _REACH]
                    total += w
                    x += w * np.float32(a)
                    y += w * np.float32(b)
                    z += w * np.float32(c)
    length = np.sqrt(x * x + y * y + z * z)
    if length > 0.0:
        scale = np.float32(127.0) / length
        out[0] = np.int8(np.rint(scale * x))
        out[1] = np.int8(np.rint(scale * y))
        out[2] = np.int8(np.rint(scale * z))
        out[3] = distances[min(int(total * np.float32(_PARTS)), _PARTS - 1)]
