"""Landmarks that somebody touched: places where a stylus' tip stayed while it was tilted.

As Plus' landmark detection has it: whoever touches a landmark pivots about it for a second, which
tells it from a stylus that lies on the table.

>>> import numpy as np
>>> from scipy.spatial.transform import Rotation
>>> from us_sim.tracking.calibration.dwell import find_dwells
>>> times = 0.05 * np.arange(60)
>>> tips = np.outer(np.clip(times - 2.0, 0.0, None), [0.3, 0.0, 0.0])
>>> tilts = Rotation.from_euler("x", np.sin(times)[:, None]).as_matrix()
>>> [touched] = find_dwells(times, tips, tilts)
>>> touched.position, round(touched.start, 2)
(array([0., 0., 0.]), 0.0)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_WINDOW = 0.2  # s, over which the tip is averaged


@dataclass(frozen=True, eq=False)
class Dwell:
    """A place where the tip stayed."""

    position: NDArray[np.float64]  # (3,) m, mean of the first steady second
    deviations: NDArray[np.float64]  # (3,) m, of its samples
    start: float  # s


def find_dwells(
    times: NDArray[np.float64],
    tips: NDArray[np.float64],
    rotations: NDArray[np.float64],
    *,
    stillness: float = 1.5e-3,
    swing: float = 0.3,
    seconds: float = 1.0,
    apart: float = 5e-3,
) -> list[Dwell]:
    """The places where the tip stayed, in the order in which it came there first.

    Args:
        times: (K,) s, ascending.
        tips: (K, 3) m.
        rotations: (K, 3, 3) of the stylus.
        stillness: m, diagonal of the box in which the tip's averages stay.
        swing: how far one of the stylus' axes swings meanwhile, about in rad.
        seconds: how long at least.
        apart: m, nearer places are the same one, of which the first counts.
    """
    if len(times) < 2:
        return []
    size = max(1, round(_WINDOW / float(np.median(np.diff(times)))))
    count = len(times) // size
    means = tips[: count * size].reshape(count, size, 3).mean(axis=1)
    axes = rotations[size - 1 : count * size : size]
    needed = max(1, round(seconds / _WINDOW))
    dwells: list[Dwell] = []
    start = 0
    for end in range(1, count + 1):
        if _diagonal(means[start:end]) > stillness:
            start = end
        elif end - start >= needed and _swing(axes[start:end]) >= swing:
            samples = tips[start * size : (start + needed) * size]
            position = samples.mean(axis=0)
            if all(np.linalg.norm(known.position - position) >= apart for known in dwells):
                dwells.append(Dwell(position, samples.std(axis=0), float(times[start * size])))
            start = end
    return dwells


def _diagonal(points: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 0.0


def _swing(rotations: NDArray[np.float64]) -> float:
    """How far the axis swings that swings most, about in rad."""
    return float(np.linalg.norm(np.ptp(rotations, axis=0), axis=0).max())
