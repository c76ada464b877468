"""The offset between two clocks, from one motion that both recorded.

The offset with the largest normalised cross-correlation, to a part of a sample; its standard
deviation by leaving out a tenth of the recording at a time (block jackknife, Künsch 1989), which
holds for errors that are correlated in time too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar

from us_sim.errors import CalibrationError


@dataclass(frozen=True, eq=False)
class PositionSignal:
    """A position over time along the direction that moved most."""

    times: NDArray[np.float64]  # (K,) s, ascending
    values: NDArray[np.float64]  # (K,) m

    def __len__(self) -> int:
        return len(self.times)


def compute_position_signal(
    times: NDArray[np.float64], positions: NDArray[np.float64]
) -> PositionSignal:
    """Return the first principal component of positions (K, 3) m at times (K,) s, of either sign.

    Raises:
        CalibrationError: there are fewer than 3.
    """
    if len(times) < 3:
        raise CalibrationError(f"a position over time needs at least 3 poses, not {len(times)}")
    centred = positions - positions.mean(axis=0)
    main = np.linalg.svd(centred, full_matrices=False)[2][0]
    times, first = np.unique(times, return_index=True)
    return PositionSignal(times, (centred @ main)[first])


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
    correlation: float  # there; negative where the two count in opposite directions
    residual: float  # of the fixed signal's standard deviation, what the moving leaves unexplained
    seconds: float  # that both were compared


def find_time_offset(
    moving: PositionSignal, fixed: PositionSignal, *, largest: float = 0.5
) -> TimeOffset:
    """Find the offset of the moving signal's stamps against the fixed one's.

    Args:
        moving: of the device whose stamps are to be mended.
        fixed: of the device whose stamps are right.
        largest: s, the largest offset to believe; twice that is searched, since an offset
            outside may fit half a stroke away too.

    Raises:
        CalibrationError: they overlap too little, do not move alike, or move so regularly that
            several offsets come into question.

    Examples:
        >>> def swing(t):
        ...     return np.sin(2 * t) + np.sin(3.1 * t + 0.2 * t**2)
        >>> tracker, video = np.arange(0, 10, 0.02), np.arange(1, 9, 0.085)
        >>> late = PositionSignal(tracker + 0.064, swing(tracker))
        >>> found = find_time_offset(late, PositionSignal(video, -300 * swing(video)))
        >>> round(found.offset, 3), round(found.correlation, 3)
        (-0.064, -1.0)
    """
    if min(len(moving), len(fixed)) < _FEWEST_SAMPLES:
        raise CalibrationError(
            f"a time offset needs at least {_FEWEST_SAMPLES} samples of each signal, not "
            f"{len(moving)} and {len(fixed)}"
        )
    # The denser signal is interpolated at the other's times.
    moving_is_dense = _interval(moving) <= _interval(fixed)
    dense, sparse = (moving, fixed) if moving_is_dense else (fixed, moving)
    times, values = _select_covered(dense, sparse, 2.0 * largest)
    curve = CubicSpline(dense.times, dense.values)
    step = min(_LARGEST_STEP, 0.5 * _interval(dense))
    tried = np.linspace(-2.0 * largest, 2.0 * largest, 4 * round(largest / step) + 1)
    correlations = np.array([_correlation(curve, times, values, shift) for shift in tried])
    best = int(np.abs(correlations).argmax())
    # The dense signal at t + shift is the sparse one at t.
    sign = -1.0 if moving_is_dense else 1.0
    _check(sign * tried, correlations, best, largest)
    shift = _refine_shift(curve, times, values, tried[best], step)
    correlation = _correlation(curve, times, values, shift)
    without = [
        _refine_shift(curve, np.delete(times, block), np.delete(values, block), shift, 10 * step)
        for block in np.array_split(np.arange(len(times)), _BLOCKS)
    ]
    spread = np.asarray(without) - np.mean(without)
    deviation = float(np.sqrt((_BLOCKS - 1) / _BLOCKS * (spread**2).sum()))
    residual = float(np.sqrt(max(1.0 - correlation**2, 0.0)))
    return TimeOffset(sign * shift, deviation, correlation, residual, float(np.ptp(times)))


def _correlation(
    curve: CubicSpline, times: NDArray[np.float64], values: NDArray[np.float64], shift: float
) -> float:
    """Correlate samples with the curve moved later by a shift, s."""
    return float(np.corrcoef(curve(times + shift), values)[0, 1])


def _refine_shift(
    curve: CubicSpline,
    times: NDArray[np.float64],
    values: NDArray[np.float64],
    shift: float,
    step: float,
) -> float:
    """Return the best shift (s) within a step of one."""
    found = minimize_scalar(
        lambda x: 1.0 - _correlation(curve, times, values, x) ** 2,
        bounds=(shift - step, shift + step),
        method="bounded",
        options={"xatol": 1e-7},
    )
    return float(found.x)


def _interval(signal: PositionSignal) -> float:
    return float(np.median(np.diff(signal.times)))


def _select_covered(
    dense: PositionSignal, sparse: PositionSignal, furthest: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the sparse signal's samples that the dense one covers at every offset."""
    first, last = dense.times[0], dense.times[-1]
    inside = (sparse.times - furthest >= first) & (sparse.times + furthest <= last)
    for gap in np.flatnonzero(np.diff(dense.times) > _GAP * _interval(dense)):
        start, end = dense.times[gap : gap + 2]
        inside &= (sparse.times + furthest <= start) | (sparse.times - furthest >= end)
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
