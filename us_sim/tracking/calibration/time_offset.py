"""The offset between two clocks, from one motion that both recorded as positions or as images.

The offset with the largest normalised cross-correlation, to a part of a sample; its standard
deviation by leaving out a tenth of the recording at a time (block jackknife, Künsch 1989), which
holds for errors that are correlated in time too.

>>> from us_sim.tracking.calibration.time_offset import PositionSignal, find_time_offset
>>> def swing(t):
...     return np.sin(2 * t) + np.sin(3.1 * t + 0.2 * t**2)
>>> tracker, video = np.arange(0, 10, 0.02), np.arange(1, 9, 0.085)
>>> late = PositionSignal(tracker + 0.064, swing(tracker))
>>> found = find_time_offset(late, PositionSignal(video, -300 * swing(video)))
>>> round(found.offset, 3), round(found.correlation, 3)
(-0.064, -1.0)
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar
from scipy.stats import siegelslopes

from us_sim.errors import CalibrationError

_FEWEST_COLUMNS = 20  # that show the line
_ENOUGH_COLUMNS = 150
_FAINTEST = 0.3  # of the brightest columns' brightness, that still shows the line
_LEAST_CONTRAST = 20.0  # grey levels of the line above the image's median
_REACH = 4  # rows on each side of the brightest that make the line's middle
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

    The brightest place of every column, and the line of repeated medians through them (Siegel
    1982). nan where there is no line.
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
    return float(siegelslopes(rows, lit - middle).intercept)


def _ascending(
    times: NDArray[np.float64], values: NDArray[np.float64], left_out: int
) -> PositionSignal:
    """A signal sorted by time, with the first of samples at the same time."""
    times, first = np.unique(times, return_index=True)
    return PositionSignal(times, values[first], left_out)


_LARGEST_STEP = 0.005  # s, between tried offsets
_FEWEST_SAMPLES = 30
_SHORTEST = 3.0  # s, of both recordings together
_LEAST_CORRELATION = 0.7
_CLEAREST = 1.5  # times the best's squared error that any other offset's must have
_BLOCKS = 10
_GAP = 5.0  # times the usual interval, between samples that nothing is interpolated


@dataclass(frozen=True, eq=False)
class TimeOffset:
    """The offset to add to the moving signal's stamps so that it agrees with the fixed one."""

    offset: float  # s
    deviation: float  # s, its standard deviation
    correlation: float  # there; its sign says whether the two count in the same direction
    residual: float  # of the fixed signal's standard deviation, what the moving leaves unexplained
    seconds: float  # how long both were compared


def find_time_offset(
    moving: PositionSignal, fixed: PositionSignal, *, largest: float = 0.5
) -> TimeOffset:
    """The offset of the moving signal's stamps against the fixed one's.

    Args:
        moving: of the device whose stamps are to be mended.
        fixed: of the device whose stamps are right.
        largest: s, the largest offset to believe; twice as far is looked, since an offset
            outside may fit half a stroke away too.

    Raises:
        CalibrationError: they overlap too little, do not move alike, or move so regularly that
            several offsets come into question.
    """
    if min(len(moving), len(fixed)) < _FEWEST_SAMPLES:
        raise CalibrationError(
            f"a time offset needs at least {_FEWEST_SAMPLES} samples of each signal, not "
            f"{len(moving)} and {len(fixed)}"
        )
    # The denser signal is interpolated at the other's times.
    moving_is_dense = _interval(moving) <= _interval(fixed)
    dense, sparse = (moving, fixed) if moving_is_dense else (fixed, moving)
    times, values = _compared(dense, sparse, 2.0 * largest)
    match = _Match(CubicSpline(dense.times, dense.values), _gaps(dense), times, values)
    step = min(_LARGEST_STEP, 0.5 * _interval(dense))
    tried = np.linspace(-2.0 * largest, 2.0 * largest, 4 * round(largest / step) + 1)
    correlations = np.array([match.correlation(shift) for shift in tried])
    best = int(np.abs(correlations).argmax())
    # The dense signal at t + shift is the sparse one at t.
    sign = -1.0 if moving_is_dense else 1.0
    _check(sign * tried, correlations, best, largest)
    shift = match.refined(tried[best], step)
    correlation = match.correlation(shift)
    blocks = np.array_split(np.arange(len(times)), _BLOCKS)
    without = [match.without(block).refined(shift, 10 * step) for block in blocks]
    spread = np.asarray(without) - np.mean(without)
    deviation = float(np.sqrt((_BLOCKS - 1) / _BLOCKS * (spread**2).sum()))
    residual = float(np.sqrt(max(1.0 - correlation**2, 0.0)))
    return TimeOffset(sign * shift, deviation, correlation, residual, float(np.ptp(times)))


@dataclass(frozen=True, eq=False)
class _Match:
    """A curve and the samples that it is compared with."""

    curve: CubicSpline
    gaps: NDArray[np.float64]  # (G, 2) s, where the curve is a guess
    times: NDArray[np.float64]
    values: NDArray[np.float64]

    def correlation(self, shift: float) -> float:
        """Correlation of the samples with the curve moved later by a shift; 0 if too few."""
        times, values = self.times + shift, self.values
        if len(self.gaps):
            known = ~((times > self.gaps[:, :1]) & (times < self.gaps[:, 1:])).any(axis=0)
            if known.sum() < max(0.5 * len(times), 3.0):
                return 0.0
            times, values = times[known], values[known]
        return float(np.corrcoef(self.curve(times), values)[0, 1])

    def refined(self, shift: float, step: float) -> float:
        """The best shift within a step of one."""
        found = minimize_scalar(
            lambda x: 1.0 - self.correlation(x) ** 2,
            bounds=(shift - step, shift + step),
            method="bounded",
            options={"xatol": 1e-7},
        )
        return float(found.x)

    def without(self, block: NDArray[np.intp]) -> _Match:
        """The match without a block of the samples."""
        times, values = (np.delete(array, block) for array in (self.times, self.values))
        return _Match(self.curve, self.gaps, times, values)


def _interval(signal: PositionSignal) -> float:
    return float(np.median(np.diff(signal.times)))


def _gaps(signal: PositionSignal) -> NDArray[np.float64]:
    """(G, 2) s, from the last sample before to the first after each."""
    before = np.flatnonzero(np.diff(signal.times) > _GAP * _interval(signal))
    return np.stack([signal.times[before], signal.times[before + 1]], axis=1)


def _compared(
    dense: PositionSignal, sparse: PositionSignal, furthest: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The sparse signal's samples that the dense one covers at every offset."""
    first, last = dense.times[0], dense.times[-1]
    inside = (sparse.times - furthest >= first) & (sparse.times + furthest <= last)
    times, values = sparse.times[inside], sparse.values[inside]
    if len(times) < _FEWEST_SAMPLES or np.ptp(times) < _SHORTEST:
        raise CalibrationError(
            f"the two recordings overlap too little ({len(times)} samples that stay inside at "
            f"offsets up to {furthest:g} s): record both at once for 20 seconds"
        )
    if np.ptp(values) == 0.0 or np.ptp(dense.values) == 0.0:
        raise CalibrationError("a signal does not move at all: move the probe while recording")
    return times, values


def _check(
    tried: NDArray[np.float64], correlations: NDArray[np.float64], best: int, largest: float
) -> None:
    highest = abs(float(correlations[best]))
    if highest < _LEAST_CORRELATION:
        raise CalibrationError(
            f"the two signals do not move alike (correlation {highest:.2f} at best): record one "
            f"motion with both, or try larger offsets than {largest:g} s"
        )
    if abs(float(tried[best])) > largest:
        raise CalibrationError(
            f"the signals agree best at an offset of {tried[best]:.2f} s, beyond the largest to "
            f"believe, {largest:g} s: allow a larger one if it can be"
        )
    heights = np.abs(correlations)
    peaks = 1 + np.flatnonzero((heights[1:-1] >= heights[:-2]) & (heights[1:-1] >= heights[2:]))
    others = peaks[peaks != best]
    if not len(others):
        return
    other = int(others[heights[others].argmax()])
    if 1.0 - heights[other] ** 2 < _CLEAREST * (1.0 - highest**2):
        raise CalibrationError(
            f"the motion is so regular that offsets of {tried[best]:.2f} s and "
            f"{tried[other]:.2f} s fit alike: record again with pauses and uneven strokes, or try "
            f"smaller offsets"
        )
