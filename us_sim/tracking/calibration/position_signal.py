"""Motion as one number over time, from positions of a body or images of a line.

>>> import numpy as np
>>> from us_sim.tracking.calibration.position_signal import signal_of_positions
>>> times = np.linspace(0, 1, 5)
>>> swing = signal_of_positions(times, np.outer([0.0, 1, 2, 1, 0], [0.03, 0.04, 0.0]))
>>> (swing.values - swing.values[0]).round(3)
array([0.  , 0.05, 0.1 , 0.05, 0.  ])
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from us_sim.errors import CalibrationError

_FEWEST_COLUMNS = 20  # that show the line
_ENOUGH_COLUMNS = 150
_FAINTEST = 0.3  # of the brightest columns' brightness, that still shows the line
_LEAST_CONTRAST = 20.0  # grey levels of the line above the image's median
_REACH = 4  # rows on each side of the brightest that make the line's middle
_TRIALS = 150
_FEWEST_FRAMES = 0.5  # of all, that must show the line


@dataclass(frozen=True, eq=False)
class PositionSignal:
    """A position over time along the direction that moved most."""

    times: NDArray[np.float64]  # (K,) s, ascending
    values: NDArray[np.float64]  # (K,) m or pixels
    left_out: int = 0  # samples without a position

    def __len__(self) -> int:
        return len(self.times)


def signal_of_positions(
    times: NDArray[np.float64], positions: NDArray[np.float64]
) -> PositionSignal:
    """The first principal component of positions (K, 3) m at times (K,) s; its sign is arbitrary.

    Raises:
        CalibrationError: there are fewer than 3.
    """
    if len(times) < 3:
        raise CalibrationError(f"a position over time needs at least 3 poses, not {len(times)}")
    centred = positions - positions.mean(axis=0)
    main = np.linalg.svd(centred, full_matrices=False)[2][0]
    return _ascending(times, centred @ main, 0)


def signal_of_images(
    times: NDArray[np.float64], images: Iterable[NDArray[np.uint8]]
) -> PositionSignal:
    """Where a bright line, such as the bottom of a water tank, crosses the images' middle.

    Args:
        times: (K,) s.
        images: (rows, columns) each, as many as times; read once.

    Raises:
        CalibrationError: less than half of the images show a line.
    """
    rows = np.array([line_row(image) for image in images])
    seen = np.isfinite(rows)
    if seen.sum() < max(3.0, _FEWEST_FRAMES * len(rows)):
        raise CalibrationError(
            f"only {int(seen.sum())} of {len(rows)} images show a bright line across: record the "
            f"bottom of a water tank"
        )
    return _ascending(np.asarray(times)[seen], rows[seen], int((~seen).sum()))


def line_row(image: NDArray[np.uint8]) -> float:
    """The row (pixels, to a part of one) where a bright line crosses the image's middle column.

    The brightest place of every column, and the line through most of them (least median of
    squares, Rousseeuw 1984). nan where there is no line.
    """
    smooth = cv2.GaussianBlur(image, (1, 5), 0).astype(np.float64)
    peaks = smooth.argmax(axis=0)
    columns = np.arange(image.shape[1])
    brightness = smooth[peaks, columns]
    level = max(_FAINTEST * float(np.percentile(brightness, 95)), _LEAST_CONTRAST)
    lit = columns[brightness - np.median(smooth) > level]
    if len(lit) < _FEWEST_COLUMNS:
        return float("nan")
    lit = lit[:: max(1, len(lit) // _ENOUGH_COLUMNS)]
    around = np.clip(peaks[lit] + np.arange(-_REACH, _REACH + 1)[:, None], 0, len(smooth) - 1)
    weights = image[around, lit].astype(np.float64)
    rows = (weights * around).sum(axis=0) / np.maximum(weights.sum(axis=0), 1e-9)
    middle = 0.5 * (image.shape[1] - 1)
    return _line_through_most(lit - middle, rows)


def _line_through_most(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    """The height at x = 0 of the line that most points lie on."""
    rng = np.random.default_rng(0)  # the same image, the same row
    first, second = rng.integers(len(x), size=(2, _TRIALS))
    apart = np.abs(x[first] - x[second]) > 0.1 * np.ptp(x)
    first, second = first[apart], second[apart]
    slopes = (y[second] - y[first]) / (x[second] - x[first])
    heights = y[first] - slopes * x[first]
    errors = np.abs(y - slopes[:, None] * x - heights[:, None])
    medians = np.median(errors, axis=1)
    best = int(medians.argmin())
    near = errors[best] <= max(4.0 * float(medians[best]), 0.5)
    return float(np.polynomial.polynomial.polyfit(x[near], y[near], 1)[0])


def _ascending(
    times: NDArray[np.float64], values: NDArray[np.float64], left_out: int
) -> PositionSignal:
    """A signal sorted by time, with the first of samples at the same time."""
    times, first = np.unique(times, return_index=True)
    return PositionSignal(times, values[first], left_out)
