"""Text that is burned into images: where it may be, without reading it.

All text of scanners has thin strokes, brighter or darker than their surroundings, the same in every
image, of about one brightness, and beside one another on a line. Speckle has the strokes, but
neither the one brightness nor the line. It is a help for a person who looks at the picture, and no
proof: it misses letters across bright tissue, handwriting, and faces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.volume.deidentification.settings import Rectangle

_STILL = 12  # grey levels by which the same letter differs between images; JPEG makes about ten
_STROKE = 11  # px, wider than the strokes of the largest letters
_HEIGHTS = (5, 60)  # px


@dataclass(frozen=True)
class _Glyphs:
    """Bright spots; each array has one number a spot."""

    left: NDArray[np.int64]
    top: NDArray[np.int64]
    right: NDArray[np.int64]  # the last column that belongs to it
    bottom: NDArray[np.int64]

    @property
    def height(self) -> NDArray[np.int64]:
        return self.bottom - self.top + 1


def find_text(images: Sequence[NDArray[np.uint8]]) -> list[Rectangle]:
    """Lines of possible text, from the top down.

    Args:
        images: (rows, columns) of equal size; several, from all over a recording, tell text from
            moving echoes.
    """
    stack = np.stack(images)
    low, high = stack.min(axis=0), stack.max(axis=0)
    still = (high - low) <= _STILL
    # Grey levels; in three images or more hardly anything but text stands still.
    contrast = 45 if len(images) < 3 else 16
    lines = []
    # In a picture with few rows or columns letters may touch.
    for scale in (1, 2) if min(low.shape) <= 600 else (1,):
        for picture in (low, 255 - high):
            lines += _lines(_glyphs(picture, still, contrast, scale), scale)
    kept: list[Rectangle] = []  # each line once, where it was found at both scales
    for line in sorted(lines, key=lambda line: -line.size[0] * line.size[1]):
        x, y = (line.left + line.right) / 2, (line.top + line.bottom) / 2
        if not any(one.left <= x <= one.right and one.top <= y <= one.bottom for one in kept):
            kept.append(line)
    return sorted(kept, key=lambda line: (line.top, line.left))


def proposed_part(
    images: Sequence[NDArray[np.uint8]], text: Sequence[Rectangle]
) -> Rectangle | None:
    """The part of images to keep, for a person to decide: the largest connected part that moves,
    or of one image that is not black; no text.

    Args:
        images: (rows, columns) of equal size.
        text: places of possible text.
    """
    stack = np.stack(images)
    moving = np.ptp(stack, axis=0) > 16  # grey levels
    seen = moving if moving.mean() > 0.01 else stack.max(axis=0) > 8
    seen = seen.astype(np.uint8)
    for line in text:
        seen[line.slices] = 0
    opened = cv2.morphologyEx(seen, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    closed = cv2.morphologyEx(opened, cv2.MORPH_CLOSE, np.ones((15, 15), np.uint8))
    count, _, stats, _ = cv2.connectedComponentsWithStats(closed, connectivity=8)
    if count < 2:
        return None
    left, top, width, height, _ = (
        int(each) for each in stats[1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))]
    )
    return Rectangle(left, top, left + width - 1, top + height - 1)


def _glyphs(
    picture: NDArray[np.uint8], still: NDArray[np.bool_], contrast: float, scale: int
) -> _Glyphs:
    """Strokes that stand out brightly, connected, and of a letter's size and evenness."""
    if scale > 1:
        size = (picture.shape[1] * scale, picture.shape[0] * scale)
        larger = cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC)
        picture = np.asarray(larger, np.uint8)
        still = still.repeat(scale, axis=0).repeat(scale, axis=1)
    kernel = cv2.getStructuringElement(cv2.MORPH_RECT, (_STROKE, _STROKE))
    stands_out = cv2.morphologyEx(picture, cv2.MORPH_TOPHAT, kernel)
    enough = np.maximum(0.5 * cv2.dilate(stands_out, kernel), contrast)
    strokes = ((stands_out > enough) & still).astype(np.uint8)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(strokes, connectivity=8)
    left, top, width, height, area = stats.T.astype(np.int64)
    where = np.flatnonzero(strokes)
    flat, heights = labels.ravel()[where], stands_out.ravel()[where]
    brightest = np.zeros(count, np.int64)
    np.maximum.at(brightest, flat, heights)
    even = np.bincount(flat, heights >= 0.6 * brightest[flat], count) / area
    filled = area / (width * height)
    good = (_HEIGHTS[0] <= height) & (height <= _HEIGHTS[1]) & (width <= 2 * height)
    good &= (filled > 0.12) & ((filled < 0.9) | (width < 0.5 * height)) & (even > 0.5)
    good[0] = False  # the background of the strokes
    edges = (left, top, left + width - 1, top + height - 1)
    return _Glyphs(*(each[good] for each in edges))


def _lines(glyphs: _Glyphs, scale: int) -> list[Rectangle]:
    """Three glyphs or more of about one height, beside one another on a common base or top."""
    order = np.argsort(glyphs.left, kind="stable")
    groups = np.arange(len(order))
    for place, a in enumerate(order):
        reach = 1.3 * glyphs.height[a]
        for b in order[place + 1 :]:
            if glyphs.left[b] - glyphs.right[a] > reach:
                break  # those that begin further right are no nearer
            if _beside(glyphs, a, b):
                groups[groups == groups[b]] = groups[a]
    lines = []
    for group in np.unique(groups):
        members = np.flatnonzero(groups == group)
        if len(members) >= 3 and _is_line(glyphs, members):
            first = glyphs.left[members].min(), glyphs.top[members].min()
            last = glyphs.right[members].max(), glyphs.bottom[members].max()
            lines.append(Rectangle(*(int(edge) // scale for edge in (*first, *last))))
    return lines


def _beside(glyphs: _Glyphs, a: int, b: int) -> bool:
    low, high = sorted((int(glyphs.height[a]), int(glyphs.height[b])))
    between = glyphs.left[b] - glyphs.right[a]
    overlap = min(glyphs.bottom[a], glyphs.bottom[b]) - max(glyphs.top[a], glyphs.top[b])
    return bool(high <= 1.8 * low and -2 <= between <= high and overlap > 0.5 * low)


def _is_line(glyphs: _Glyphs, members: NDArray[np.int64]) -> bool:
    """Whether most stand on one base, or hang from one top, and the whole is wide."""
    height = float(np.median(glyphs.height[members]))
    slack = 1.0 + 0.08 * height
    width = glyphs.right[members].max() - glyphs.left[members].min()
    aligned = max(
        np.mean(np.abs(edge - np.median(edge)) <= slack)
        for edge in (glyphs.bottom[members], glyphs.top[members])
    )
    return bool(aligned >= 0.7 and width > 1.5 * height)
