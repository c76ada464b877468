"""Planes that are near each other where a probe touches, and farther apart elsewhere.

>>> from us_sim.evaluation.tissue.graded_planes import graded_planes
>>> graded_planes(0.0, 0.05, 0.0, 0.02, 0.01, 1.2).round(4).tolist()
[0.0, 0.01, 0.02, 0.0336, 0.05]
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def graded_planes(
    low: float, high: float, fine_low: float, fine_high: float, size: float, growth: float
) -> NDArray[np.float64]:
    """Planes (m) from ``low`` to ``high``: ``size`` apart where it is fine, growing outside.

    Each distance outside is about ``growth`` (above 1) times the one before.
    """
    count = max(1, round((fine_high - fine_low) / size))
    fine = np.linspace(fine_low, fine_high, count + 1)
    parts = [fine]
    for length, end, direction in (
        (fine_low - low, fine_low, -1),
        (high - fine_high, fine_high, 1),
    ):
        if length <= 0:
            continue
        number = max(1, round(np.log1p(length / size * (1 - 1 / growth)) / np.log(growth)))
        steps = growth ** np.arange(1, number + 1)
        parts.append(end + direction * length * np.cumsum(steps) / steps.sum())
    planes = np.unique(np.concatenate(parts))
    planes[[0, -1]] = low, high
    return planes
