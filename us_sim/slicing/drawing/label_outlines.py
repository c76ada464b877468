"""The outlines of a label in an image of labels.

>>> import numpy as np
>>> from us_sim.slicing.drawing.label_outlines import label_outlines
>>> labels = np.zeros((40, 40), np.uint8)
>>> labels[10:20, 12:30] = 3  # its sides are half a pixel around the centres of its pixels
>>> outline, = label_outlines(labels, 3)
>>> np.abs(outline - [20.5, 14.5]).max(axis=0).round()
array([9., 5.])
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Settle = Callable[[int, NDArray[np.float64]], NDArray[np.float64]]
"""Moves points (P, 2) of a label's outline, see `us_sim.slicing.drawing.label_border`."""

_MOST = 64
"""Most outlines of one label; the longest are taken."""


def label_outlines(
    labels: NDArray[np.uint8],
    label: int,
    *,
    least: float = 6.0,
    smoothing: float = 1.0,
    settle: Settle | None = None,
) -> list[NDArray[np.float64]]:
    """Closed outlines of the areas and holes of one label, the longest first.

    Args:
        labels: (rows, columns).
        least: pixels that an outline must enclose.
        smoothing: pixels, about the length of the steps between pixels that are smoothed away.
        settle: moves points of a label's outline to where it runs between voxels.

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
    enclosing = [chain[:, 0] for chain in found if cv2.contourArea(chain) + len(chain) / 2 >= least]
    enclosing.sort(key=len, reverse=True)
    outlines = [_smooth(chain, smoothing) for chain in enclosing[:_MOST]]
    return outlines if settle is None else [settle(label, outline) for outline in outlines]


def _smooth(chain: NDArray[Any], smoothing: float) -> NDArray[np.float64]:
    """A chain of neighbouring pixels on the inside (P, 2), smoothed and moved half a pixel out.

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
