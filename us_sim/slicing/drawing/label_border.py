"""Where the border of a label lies between voxels, in an image.

Voxels have a label or not, so an outline of their pixels has their steps. Here each voxel counts by
how much of its surroundings has the label (a Gaussian of two voxels), from a level on at which as
many voxels lie inside as before. That level's contour has no steps and encloses the same volume. It
is found in the tissue as it is deformed now.

>>> import numpy as np
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.slicing.b_mode import BMode
>>> from us_sim.slicing.drawing.label_border import onto_border
>>> from us_sim.slicing.probe.probe import LinearProbe
>>> from us_sim.volume.volume import Volume
>>> x, y, z = np.indices((40, 8, 40))
>>> labels = ((x - 20) ** 2 + (z - 20) ** 2 < 10.2**2).astype(np.uint8)
>>> volume = Volume(labels, np.diag([1e-3, 1e-3, 1e-3, 1.0]), labels, {1: "vein"})
>>> probe = LinearProbe(aperture=0.04, depth=0.04, columns=160, rows=160)  # 4 pixels a voxel
>>> frame = BMode(volume, probe).frame(Pose([0.02, 0.004, 0.0]))
>>> near = 79.5 + 43.0 * np.array([[1.0, 0.0], [0.6, 0.8]])
>>> radius = np.hypot(*(onto_border(frame, 1, near) - 79.5).T)
>>> bool((abs(radius - 4 * 10.2) < 4 / 3).all())  # to a third of a voxel
True
"""

from __future__ import annotations

from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit
from us_sim.slicing.frame import Frame
from us_sim.volume.volume import Volume

_SIGMA = 2.0  # voxels: less leaves steps where a border runs along them
_MARGIN = 6  # voxels around a label in which it has a share
_STEPS = 4  # of Newton's method
_LONGEST = 0.5  # pixels, of a step
_FLAT = 1e-3  # slope, a pixel, at which nothing is known of where the border lies


class _Share(NamedTuple):
    """How much of the surroundings of each voxel around a label has it."""

    field: NDArray[np.float32]  # (i, j, k), 0 to 1
    start: NDArray[np.int64]  # (3,) the volume's voxel that the first one is
    level: float  # at the border


_found: WeakKeyDictionary[Volume, dict[int, _Share]] = WeakKeyDictionary()


def onto_border(frame: Frame, label: int, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Move points (P, 2), column and row, that are near a label's border onto it.

    Points at the image's sides, and where there is no tissue, stay.
    """
    share = _share_of(frame.volume, label)
    elements, maps, _ = frame.placed
    moved = np.array(points, dtype=np.float64)
    _settle(elements, maps, share.field, share.start, share.level, moved)
    return moved


@njit(cache=True, nogil=True, error_model="numpy")
def _settle(elements, maps, field, start, level, points):
    """Newton's method along the slope of ``field`` (i, j, k), for each of ``points`` (P, 2)."""
    rows, columns = elements.shape
    index = np.empty(3)
    part = np.empty(3)
    cell = np.empty(3, np.int64)
    for p in range(len(points)):
        x, y = points[p]
        for _ in range(_STEPS):
            if not (0.5 < x < columns - 1.5 and 0.5 < y < rows - 1.5):
                break
            element = elements[np.int64(y + 0.5), np.int64(x + 0.5)]
            if element < 0:
                break
            m = maps[element]
            for axis in range(3):
                index[axis] = m[axis, 0] + m[axis, 1] * x + m[axis, 2] * y - start[axis]
                inside = min(max(index[axis], 0.0), field.shape[axis] - 1.001)
                cell[axis] = np.int64(inside)
                part[axis] = inside - cell[axis]
            value = -level
            across = down = 0.0
            for corner in range(8):
                weight = 1.0
                for axis in range(3):
                    weight *= part[axis] if corner >> axis & 1 else 1.0 - part[axis]
                i = cell[0] + (corner & 1)
                j = cell[1] + (corner >> 1 & 1)
                k = cell[2] + (corner >> 2 & 1)
                share = field[i, j, k]
                value += weight * share
                for axis in range(3):
                    slope = 1.0 if corner >> axis & 1 else -1.0
                    for other in range(3):
                        if other != axis:
                            slope *= part[other] if corner >> other & 1 else 1.0 - part[other]
                    across += slope * share * m[axis, 1]
                    down += slope * share * m[axis, 2]
            steepness = np.sqrt(across * across + down * down)
            if steepness < _FLAT:
                break
            length = min(max(-value / steepness, -_LONGEST), _LONGEST) / steepness
            x += length * across
            y += length * down
        points[p, 0] = x
        points[p, 1] = y


def _share_of(volume: Volume, label: int) -> _Share:
    """Found when it is first asked for."""
    shares = _found.setdefault(volume, {})
    if label not in shares:
        assert volume.labels is not None
        shares[label] = _made(volume.labels == label)
    return shares[label]


def _made(mask: NDArray[np.bool_]) -> _Share:
    from scipy import ndimage  # which no other part of an image needs

    (box,) = ndimage.find_objects(mask.astype(np.uint8), max_label=1)
    # Beyond the volume it goes on as it is at its sides.
    crop = mask[box].astype(np.float32)
    start = np.array([side.start for side in box])
    before = np.minimum(_MARGIN, start)
    after = np.minimum(_MARGIN, np.array(mask.shape) - [side.stop for side in box])
    crop = np.pad(crop, list(zip(before, after, strict=True)))
    # A cell has two voxels along each axis, also where the volume has one.
    crop = np.pad(crop, [(0, int(side == 1)) for side in crop.shape], mode="edge")
    field = ndimage.gaussian_filter(crop, _SIGMA, mode="nearest", truncate=3.0)
    first = field.size - np.count_nonzero(crop)  # of those that shall be inside, in order
    beside = (first - 1, first) if first else (0, 0)
    level = np.partition(field, beside, axis=None)[list(beside)].mean()
    return _Share(field, start - before, float(level))
