"""Outlines of labels in an image, by pixels or settled onto the border between voxels.

On that border, each voxel counts by how much of its surroundings has the label (a Gaussian of two
voxels); the border is the level at which as many voxels lie inside as have the label.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit
from us_sim.slicing.frame import Frame
from us_sim.volume.volume import Volume

Refine = Callable[[int, NDArray[np.float64]], NDArray[np.float64]]
"""Moves points (P, 2) of a label's outline to where it runs between voxels."""

_MOST = 64  # most outlines of one label; the longest are taken
_LEAST = 6.0  # pixels that an outline must enclose


def trace_label_outlines(
    labels: NDArray[np.uint8], label: int, *, smoothing: float = 1.0, refine: Refine | None = None
) -> list[NDArray[np.float64]]:
    """Trace closed outlines of the areas and holes of one label, the longest first.

    Args:
        labels: (rows, columns).
        label: whose outlines are wanted.
        smoothing: pixels, about the length of the steps between pixels that are smoothed away.
        refine: moves points of a label's outline to where it runs between voxels.

    Returns:
        (P, 2) column and row of each outline, in pixels, between pixels with the label and those
        without, the points at most about half of ``smoothing`` apart.
    """
    mask = cv2.inRange(labels, (float(label),), (float(label),))
    left, top, width, height = cv2.boundingRect(mask)
    if width == 0:
        return []
    around = mask[top : top + height, left : left + width]
    found, _ = cv2.findContours(around, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE, offset=(left, top))
    enclosing = [
        chain[:, 0] for chain in found if cv2.contourArea(chain) + len(chain) / 2 >= _LEAST
    ]
    enclosing.sort(key=len, reverse=True)
    outlines = [_smooth(chain, smoothing) for chain in enclosing[:_MOST]]
    return outlines if refine is None else [refine(label, outline) for outline in outlines]


def _smooth(chain: NDArray[Any], smoothing: float) -> NDArray[np.float64]:
    """Smooth a chain of pixels (P, 2) on the inside, and move it half a pixel out.

    A Gaussian in the outline's Fourier series, applied as g (2 - g) so that circles hardly shrink.
    """
    series = np.fft.fft(chain[:, 0] + 1j * chain[:, 1])
    frequency = 2 * np.pi * np.fft.fftfreq(len(chain))  # per pixel of the chain
    damping = np.exp(-0.5 * (smoothing * frequency) ** 2)
    series *= damping * (2 - damping)
    outline = np.fft.ifft(series)
    along = np.fft.ifft(1j * frequency * series)
    outline += 0.5j * along / np.maximum(np.abs(along), 1e-9)
    apart = max(1, int(smoothing / 2))
    return np.column_stack([outline.real[::apart], outline.imag[::apart]])


_SIGMA = 2.0  # voxels: less leaves steps where a border runs along them
_MARGIN = 6  # voxels around a label in which it has a share
_STEPS = 4  # of Newton's method
_LONGEST = 0.5  # pixels, of a step
_FLAT = 1e-3  # slope, a pixel, at which nothing is known of where the border lies


class _Share(NamedTuple):
    """The part of the surroundings of each voxel, in a box around a label, that has it."""

    field: NDArray[np.float32]  # (i, j, k), 0 to 1
    start: NDArray[np.int64]  # (3,) the volume's voxel that the first one is
    level: float  # at the border


_found: WeakKeyDictionary[Volume, dict[int, _Share]] = WeakKeyDictionary()


def snap_to_border(frame: Frame, label: int, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Move points (P, 2), column and row, near a label's border onto it.

    Points at the image's sides, and where there is no tissue, stay.
    """
    share = _share_of(frame.volume, label)
    elements, maps, _ = frame.placed
    moved = np.array(points, dtype=np.float64)
    _move_to_level(elements, maps, share.field, share.start, share.level, moved)
    return moved


@njit(cache=True, nogil=True, error_model="numpy")
def _move_to_level(elements, maps, field, start, level, points):
    """Move points (P, 2) along the slope of ``field`` (i, j, k) to its level: Newton's method."""
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
            value, across, down = _interpolate_field(field, cell, part, m, -level)
            steepness = np.sqrt(across * across + down * down)
            if steepness < _FLAT:
                break
            length = min(max(-value / steepness, -_LONGEST), _LONGEST) / steepness
            x += length * across
            y += length * down
        points[p, 0] = x
        points[p, 1] = y


@njit(cache=True, nogil=True, error_model="numpy")
def _interpolate_field(field, cell, part, m, value):
    """Add the field at a place in a cell to ``value``; return its slopes along the image, too."""
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
    return value, across, down


def _share_of(volume: Volume, label: int) -> _Share:
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
