"""Displacement along the beams between two images, by the correlation of windows.

Each window of the later image is looked for along its beam in the earlier one, where the normalised
cross-correlation is largest (Ophir et al., Ultrasonic Imaging 13:111, 1991), between samples by a
parabola through the three largest (Céspedes et al., Ultrasonic Imaging 17:142, 1995). Then the
earlier image is warped by what was found, and what remains is looked for again: windows that were
compressed themselves correlate better so (Alam and Ophir, Ultrasound Med. Biol. 23:95, 1997), and a
parabola is exact where nothing remains.

>>> import numpy as np
>>> from us_sim.slicing.strain.tracking import track
>>> rng = np.random.default_rng(1)
>>> speckle = 20.0 * np.cumsum(rng.normal(size=(200, 30)), axis=0)
>>> place = np.arange(200.0)
>>> moved = np.stack([np.interp(place - 0.01 * place, place, line) for line in speckle.T], axis=1)
>>> found, correlation = track(speckle, moved, window=(31, 5), search=4)
>>> np.round(found[50:151:50, 15], 1)  # a hundredth of the depth
array([0.5, 1. , 1.5], dtype=float32)
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import ProbeError
from us_sim.kernels import njit

_PASSES = 2
"""How often the image is warped and what remains is looked for."""
_FLAT = 6.0**2
"""Variance of grey values (in squared levels) below which a window has nothing to be found by.

Full speckle has four times that deviation where 60 dB are shown; a shadow's noise has less.
"""

Field = NDArray[Any]
"""float32."""
Window = tuple[Field, Field, Field]
"""An image, and the mean and standard deviation around each of its samples."""


def track(
    earlier: ArrayLike, later: ArrayLike, *, window: tuple[int, int], search: int
) -> tuple[Field, Field]:
    """How far what each sample of the later image shows has come along its beam, in samples.

    Args:
        earlier, later: (samples, lines) of grey values, 0 to 255.
        window: samples and lines of what is looked for, odd.
        search: samples to either side.

    Returns:
        (samples, lines): displacement, positive away from the face; and the correlation of what
        was found, -1 to 1; 0 where there is nothing to be found by, or the beams of the earlier
        image may have begun or ended within it.

    Raises:
        ProbeError: the images differ in size, or a window is longer than half a beam.
    """
    first, second = (np.array(image, dtype=np.float32) for image in (earlier, later))
    if first.shape != second.shape or first.ndim != 2:
        raise ProbeError(f"images of {first.shape} and {second.shape} cannot be compared")
    if 2 * window[0] > first.shape[0]:
        raise ProbeError(
            f"a window of {window[0]} samples is longer than half a beam of {first.shape[0]}: make "
            f"strain.window shorter"
        )
    size = window[::-1]
    later_window = second, *_moments(second, size)
    found, correlation = _search(first, later_window, size, search)
    moved = _smoothed(found, correlation, size)
    for _ in range(_PASSES):
        found, correlation = _refine(first, later_window, size, moved)
        moved = _smoothed(found, correlation, size)
    top, bottom = _ends(moved, correlation, window[0] // 2, search)
    correlation[:top] = 0.0
    correlation[bottom:] = 0.0
    return moved, correlation


def _ends(moved: Field, correlation: Field, half: int, search: int) -> tuple[int, int]:
    """The first sample, and the one after the last, whose windows were all in the earlier image.

    What has come from beyond an end is not found, or found elsewhere. How far things moved there
    is told by the nearest windows that can have come from nowhere else.
    """
    rows = len(moved)
    near = half + search
    top = bottom = 0
    for part, is_top in ((slice(near, 2 * near), True), (slice(-2 * near, -near), False)):
        there = moved[part][correlation[part] > 0.0]
        if not there.size:
            continue
        came = np.percentile(there, 95.0) if is_top else -np.percentile(there, 5.0)
        lost = half + max(0, int(np.ceil(came)))
        top, bottom = (lost, bottom) if is_top else (top, lost)
    return min(top, rows), max(rows - bottom, 0)


def _search(first: Field, later: Window, size: tuple[int, int], most: int) -> tuple[Field, Field]:
    """Where in the image as it is the correlation is largest, and how large it is."""
    around = cv2.copyMakeBorder(first, most + 1, most + 1, 0, 0, cv2.BORDER_REFLECT_101)
    earlier = around, *_moments(around, size)
    best = np.full_like(first, -np.inf)
    previous = np.full_like(first, -np.inf)
    before, after, found = (np.zeros_like(first) for _ in range(3))
    is_latest = np.zeros(first.shape, dtype=np.bool_)
    rows = len(first)
    for lag in range(-most - 1, most + 2):
        start = most + 1 - lag
        part = [each[start : start + rows] for each in earlier]
        level = _correlation(later, (part[0], part[1], part[2]), size)
        np.copyto(after, level, where=is_latest)
        if abs(lag) <= most:  # those beyond are only there as neighbours
            np.greater(level, best, out=is_latest)
            np.copyto(best, level, where=is_latest)
            np.copyto(before, previous, where=is_latest)
            found[is_latest] = lag
        else:
            is_latest[:] = False
        previous = level
    return found + _tip(before, best, after, 0.5), np.clip(best, -1.0, 1.0)


def _refine(
    first: Field, later: Window, size: tuple[int, int], moved: Field
) -> tuple[Field, Field]:
    """The same in the image warped by what is known, up to a sample from there."""
    levels = []
    for lag in (-1.0, 0.0, 1.0):
        warped = np.empty_like(first)
        _warp(first, moved, lag, warped)
        levels.append(_correlation(later, (warped, *_moments(warped, size)), size))
    before, middle, after = levels
    return moved + _tip(before, middle, after, 1.0), np.clip(middle, -1.0, 1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _warp(image, moved, lag, warped):
    """Fills ``warped`` (samples, lines) with what lay ``moved + lag`` samples nearer the face.

    Cubic convolution (Keys, IEEE Trans. ASSP 29:1153, 1981), exact for parabolas; OpenCV's takes
    places to a 32nd of a sample only. Beyond the ends goes on what is there.
    """
    last = len(image) - 1
    for i in range(len(image)):
        for k in range(image.shape[1]):
            at = min(max(i - moved[i, k] - lag, 0.0), np.float64(last))
            m = int(at)
            if m == last:
                m -= 1
            t = at - m
            a = image[max(m - 1, 0), k]
            b = image[m, k]
            c = image[m + 1, k]
            d = image[min(m + 2, last), k]
            bend = 2.0 * a - 5.0 * b + 4.0 * c - d
            twist = 3.0 * (b - c) + d - a
            warped[i, k] = b + 0.5 * t * (c - a + t * (bend + t * twist))


def _correlation(one: Window, other: Window, size: tuple[int, int]) -> Field:
    """Of two images in each window."""
    product = cv2.boxFilter(one[0] * other[0], -1, size, borderType=cv2.BORDER_REFLECT_101)
    return np.asarray((product - one[1] * other[1]) / (one[2] * other[2]))


def _tip(before: Field, middle: Field, after: Field, most: float) -> Field:
    """Where a parabola through three values a sample apart is largest, from the middle one on."""
    bend = np.minimum(before - 2.0 * middle + after, np.float32(-1e-6))
    return np.asarray(np.clip(0.5 * (before - after) / bend, -most, most), dtype=np.float32)


def _moments(image: Field, size: tuple[int, int]) -> tuple[Field, Field]:
    """Mean and standard deviation of each window; the latter infinite where it is flat."""
    border = cv2.BORDER_REFLECT_101
    mean = cv2.boxFilter(image, -1, size, borderType=border)
    variance = cv2.sqrBoxFilter(image, -1, size, borderType=border) - mean * mean
    return mean, np.where(
        variance > _FLAT, np.sqrt(np.maximum(variance, _FLAT)), np.float32(np.inf)
    )


def _smoothed(moved: Field, correlation: Field, size: tuple[int, int]) -> Field:
    """Without single windows that were found elsewhere: the median, then a mean by correlation.

    Windows that the image's ends cut off go on as the whole ones beside them do.
    """
    half = size[1] // 2
    moved = cv2.medianBlur(moved.astype(np.float32), 5)
    last = len(moved) - half - 1
    moved[:half] = 2.0 * moved[half] - moved[2 * half : half : -1]
    moved[last + 1 :] = 2.0 * moved[last] - moved[last - 1 : last - half - 1 : -1]
    weight = np.maximum(correlation, 1e-3) ** 4
    small = (max(3, size[0] // 2 | 1), max(3, size[1] // 4 | 1))
    total = cv2.GaussianBlur(weight, small, 0.0)
    return np.asarray(cv2.GaussianBlur(weight * moved, small, 0.0) / total, dtype=np.float32)
