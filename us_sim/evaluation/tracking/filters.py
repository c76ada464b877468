"""Filters' lag behind a moving hand, and the jitter that they leave.

>>> import numpy as np
>>> from us_sim.evaluation.tracking.filters import delay
>>> times = np.arange(0, 4, 0.01)
>>> late = np.sin(7 * (times - 0.025))[:, None]
>>> round(delay(times, late, lambda t: np.sin(7 * t)[:, None]), 4)
0.025
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.report import Row
from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import rotation_exp, rotation_log
from us_sim.settings.registry import FILTERS
from us_sim.settings.setting import Settings
from us_sim.tracking.filters import create_filter
from us_sim.tracking.measurement import Measurement
from us_sim.tracking.settings import KalmanSettings, OneEuroSettings

Array = NDArray[np.float64]

FILTER_METHODS = {"none": ("0.3", "*"), "one_euro": ("#0072B2", "o"), "kalman": ("#D55E00", "s")}
"""By name, the colour and the mark of its points in a plot."""

_RATE = 60.0  # Hz
_NOISE, _TURN_NOISE = 3e-4, 3.5e-3  # m and rad, standard deviation of a coordinate
_MOVING, _REST = 8.0, 8.0  # s
_SWAY = ((0.25, 0.035, 0.25), (0.9, 0.009, 0.12), (2.3, 0.0012, 0.015))
"""Hz, m and rad of the hand's sway along and about each axis: a slow slide, a rocking, a tremor."""

_Path = Callable[[Array], Array]
FilterTrial = tuple[str, Settings | None, str]  # a filter's name, its settings, and those in words


@dataclass(frozen=True)
class FilterPoint(Row):
    """A row of filters.csv."""

    decimals = 4

    method: str
    setting: str
    default: bool
    lag: float  # s
    rotation_lag: float  # s
    jitter: float  # m, at rest, root mean square over all three coordinates
    rotation_jitter: float  # rad
    moving_jitter: float  # m, without the lag
    error: float  # m, root mean square to where the probe is at that moment
    stated: float  # s, the lag that the filter itself states, in motion
    seconds: float  # a pose

    @property
    def values(self) -> dict[str, object]:
        return {
            "filter": self.method,
            "setting": self.setting,
            "rate_hz": _RATE,
            "noise_mm": 1e3 * _NOISE,
            "noise_deg": round(float(np.degrees(_TURN_NOISE)), 3),
            "lag_ms": round(1e3 * self.lag, 2),
            "rotation_lag_ms": round(1e3 * self.rotation_lag, 2),
            "jitter_mm": 1e3 * self.jitter,
            "jitter_deg": float(np.degrees(self.rotation_jitter)),
            "moving_jitter_mm": 1e3 * self.moving_jitter,
            "error_mm": 1e3 * self.error,
            "stated_lag_ms": round(1e3 * self.stated, 2),
            "us_per_pose": round(1e6 * self.seconds, 1),
        }


def filter_trials(quick: bool) -> list[FilterTrial]:
    """Every filter over its settings; all are to follow the same noisy path."""
    cutoffs = (0.5, 1.5, 6.0) if quick else (0.25, 0.5, 1.0, 1.5, 3.0, 6.0, 12.0)
    slopes = (180.0,) if quick else (0.0, 60.0, 180.0, 600.0)
    accelerations = (0.01, 0.05, 0.25) if quick else (0.003, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0)
    tried: list[FilterTrial] = [("none", None, "")]
    for slope in slopes:
        for cutoff in cutoffs:
            turning = slope * OneEuroSettings().rotation_speed_coefficient / 180.0
            one_euro = OneEuroSettings(
                minimum_cutoff=cutoff,
                speed_coefficient=slope,
                rotation_minimum_cutoff=cutoff,
                rotation_speed_coefficient=turning,
            )
            tried.append(("one_euro", one_euro, f"{cutoff:g} Hz + {slope:g} Hz per m/s"))
    for acceleration in accelerations:
        kalman = KalmanSettings(acceleration=acceleration, angular_acceleration=10 * acceleration)
        tried.append(("kalman", kalman, f"{acceleration:g} m/s per root second"))
    return tried


def delay(times: Array, values: Array, path: _Path) -> float:
    """s by which values (K, d) at times (K,) are behind a path, by least squares.

    The path is known at any time, so this is the peak of the correlation between grid points too.
    """

    def misfit(lag: float) -> float:
        return float(((values - path(times - lag)) ** 2).sum())

    grid = np.linspace(-0.05, 0.8, 171)
    step = float(grid[1] - grid[0])
    best = float(grid[np.argmin([misfit(lag) for lag in grid])])
    for _ in range(4):
        before, here, after = (misfit(best + side * step) for side in (-1, 0, 1))
        bend = before - 2 * here + after
        best += 0.5 * step * (before - after) / bend if bend > 0 else 0.0
        step *= 0.2
    return best


def filter_point(method: str, settings: Settings | None, words: str) -> FilterPoint:
    """Row of a filter with some settings, named in words, on the noisy path."""
    times = np.arange(round((_MOVING + _REST) * _RATE)) / _RATE
    random = np.random.default_rng(7)
    noise = random.normal(0.0, _NOISE, (len(times), 3))
    turn_noise = random.normal(0.0, _TURN_NOISE, (len(times), 3))
    covariance = np.diag([_NOISE**2] * 3 + [_TURN_NOISE**2] * 3)
    positions, turns = _position(times), _rotation(times)
    measured = []
    noisy = zip(times, positions + noise, turns, turn_noise, strict=True)
    for moment, position, turn, turned_off in noisy:
        turned = Pose(np.zeros(3), rotation_exp(turned_off)) @ Pose(position, rotation_exp(turn))
        pose = Pose(position, turned.orientation)
        measured.append(Measurement(round(1e9 * moment) + 1, pose, covariance))
    filter = create_filter(method, settings)
    filtered, stated = [], []
    began = time.thread_time()
    for measurement in measured:
        filtered.append(filter.update(measurement).pose)
        stated.append(filter.lag)
    seconds = (time.thread_time() - began) / len(measured)
    found = np.array([pose.position for pose in filtered])
    found_turns = np.array([rotation_log(pose.orientation) for pose in filtered])
    moving = (times >= 1.0) & (times < _MOVING)
    rest = times >= _MOVING + 4.0
    lag = delay(times[moving], found[moving], _position)
    return FilterPoint(
        method,
        words,
        settings in (None, FILTERS.settings(method)()),
        lag,
        delay(times[moving], found_turns[moving], _rotation),
        _root_mean_square(found[rest] - positions[rest]),
        _root_mean_square(found_turns[rest] - turns[rest]),
        _root_mean_square(found[moving] - _position(times[moving] - lag)),
        _root_mean_square(found[moving] - positions[moving]),
        float(np.median(np.array(stated)[moving])),
        seconds,
    )


def _swayed(times: Array, what: int) -> Array:
    """(K, 3) m or rad: the hand sways, comes to rest, and stays there."""
    ease = np.clip((_MOVING - times) / 0.5, 0.0, 1.0)
    ease = ease**3 * (10 - 15 * ease + 6 * ease**2)
    total = np.zeros((len(times), 3))
    for axis in range(3):
        for number, sway in enumerate(_SWAY):
            phase = 1.7 * axis + 0.9 * number
            amplitude = (1.0, 0.6, 0.3)[axis] * sway[what]
            total[:, axis] += amplitude * np.sin(2 * np.pi * sway[0] * times + phase)
    return total * ease[:, None]


_position, _rotation = partial(_swayed, what=1), partial(_swayed, what=2)


def _root_mean_square(values: Array) -> float:
    return float(np.sqrt((values**2).sum(axis=1).mean()))
