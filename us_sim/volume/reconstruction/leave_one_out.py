"""How well a reconstruction predicts images that it has not seen.

The honest test of the whole chain of calibration, tracking and compounding: frames that are left
out are cut from the volume of the others and compared with what the probe saw there.

>>> import numpy as np
>>> from us_sim.volume.reconstruction.leave_one_out import correlation
>>> round(correlation(np.array([1.0, 2.0, 4.0]), np.array([10.0, 20.0, 40.0])), 6)
1.0
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from us_sim.errors import VolumeError
from us_sim.volume.reconstruction.reconstruction import Plan, Progress, Reconstruction, reconstruct

APART = 8
"""Frames from one that is left out to the next: the seven between are enough to predict it."""
_LEAST = 100  # pixels for a correlation


@dataclass(frozen=True, eq=False)
class Prediction:
    """How like the frames left out and their predictions are."""

    frames: NDArray[np.int64]  # (N,) numbers of the frames in the file
    correlations: NDArray[np.float64]  # (N,) normalised cross-correlation; nan where not covered
    covered: NDArray[np.float64]  # (N,) fraction of the used pixels that the others predict

    @property
    def median(self) -> float:
        """The median correlation."""
        return float(np.nanmedian(self.correlations))

    @property
    def worst(self) -> float:
        """The lowest correlation."""
        return float(np.nanmin(self.correlations))


def leave_one_out(planned: Plan, count: int, progress: Progress | None = None) -> Prediction:
    """Predict some frames of a sweep from all others.

    The frames are spread over the sweep, with seven others between two of them or more, so that
    each is predicted as if it alone were left out; one reconstruction does for all of them.

    Args:
        planned: what is inserted where.
        count: how many frames, fewer where the sweep is short.
        progress: is told how far it is.

    Raises:
        VolumeError: the sweep has fewer than three frames, or the others predict nothing of those.
    """
    total = len(planned.sweep.numbers)
    if total < 3:
        raise VolumeError(
            f"{planned.sweep.path}: has {total} usable frames; leaving one out needs 3 or more"
        )
    count = max(1, min(count, total // APART))
    chosen = np.unique(np.linspace(0, total - 1, count + 2).round().astype(int)[1:-1])
    others = np.setdiff1d(np.arange(total), chosen)
    made = reconstruct(planned, [int(k) for k in others], progress)
    correlations, covered = [], []
    for k, image in zip(chosen, planned.sweep.images(chosen.tolist()), strict=True):
        seen, predicted, fraction = _pair(planned, made, int(k), image)
        covered.append(fraction)
        correlations.append(correlation(seen, predicted) if len(seen) >= _LEAST else math.nan)
    if np.isnan(correlations).all():
        raise VolumeError(
            f"{planned.sweep.path}: the other frames predict nothing of the {len(chosen)} left "
            f"out: the frames are too far apart; give a larger --hole-radius or --spacing"
        )
    return Prediction(planned.sweep.numbers[chosen], np.array(correlations), np.array(covered))


def correlation(first: NDArray[np.floating], second: NDArray[np.floating]) -> float:
    """Pearson's correlation; nan where one is constant."""
    first, second = first - first.mean(), second - second.mean()
    scale = math.sqrt(float(first @ first) * float(second @ second))
    return float(first @ second) / scale if scale else math.nan


def _pair(
    planned: Plan, made: Reconstruction, k: int, image: NDArray[np.uint8]
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """The used pixels of a frame whose eight voxels are covered, their prediction, and how many."""
    rows, columns = np.nonzero(planned.used)
    matrix = planned.sweep.image_to_reference[k]
    points = columns[:, None] * matrix[:3, 0] + rows[:, None] * matrix[:3, 1] + matrix[:3, 3]
    if planned.rest is not None:
        points = planned.rest(k, points)
    to_index = planned.grid.reference_to_index
    index = (points @ to_index[:3, :3].T + to_index[:3, 3]).T
    size = np.array(planned.grid.shape)[:, None]
    inside = (np.isfinite(index) & (index >= -0.5) & (index < size - 0.5)).all(axis=0)
    index = np.where(inside, index, 0.0)
    covered = made.covered.view(np.uint8)
    whole = ndimage.map_coordinates(covered, index, np.float32, order=1, mode="nearest")
    used = inside & (whole > 1.0 - 1e-5)
    predicted = ndimage.map_coordinates(
        made.volume.intensities, index[:, used], np.float64, order=1, mode="nearest"
    )
    seen = image[rows[used], columns[used]].astype(np.float64)
    return seen, predicted, float(used.mean())
