"""Strain from displacement: the slope of a straight line fitted to it along the beam.

The least-squares strain estimator of Kallel and Ophir (Ultrasonic Imaging 19:195, 1997), with a
weight for each sample, so that what was not found does not count and windows may end at the image.

>>> import numpy as np
>>> from us_sim.slicing.strain.least_squares import slope
>>> moved = 0.02 * np.arange(20.0)[:, None] + np.zeros((20, 3))
>>> moved[7] = 9.0  # was not found
>>> weight = np.ones((20, 3))
>>> weight[7] = 0.0
>>> slope(moved, weight, 5)[[0, 8, 19], 0].round(6)
array([0.02, 0.02, 0.02], dtype=float32)
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray


def slope(values: ArrayLike, weight: ArrayLike, length: int) -> NDArray[np.float32]:
    """The slope (per sample) at each sample of (samples, lines) values, down the columns.

    Args:
        values, weight: (samples, lines); values without weight may be anything finite.
        length: samples of the line that is fitted, odd.

    Returns:
        NaN where fewer than two samples, or less than half of the line's weight, are there.
    """
    w = np.asarray(weight, dtype=np.float64)
    weighted = np.asarray(values, dtype=np.float64) * w
    place = np.arange(len(w), dtype=np.float64)[:, None] * np.ones_like(w)

    def total(terms: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(
            cv2.boxFilter(terms, -1, (1, length), normalize=False, borderType=cv2.BORDER_CONSTANT)
        )

    s0, s1, s2 = total(w), total(w * place), total(w * place * place)
    v0, v1 = total(weighted), total(weighted * place)
    spread = s0 * s2 - s1 * s1
    enough = (spread > 1e-9) & (s0 >= 0.5 * total(np.ones_like(w)))
    found = np.where(enough, (s0 * v1 - s1 * v0) / np.where(enough, spread, 1.0), np.nan)
    return found.astype(np.float32)
