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
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.subject import Piece
from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import rotation_exp, rotation_log
from us_sim.settings.registry import FILTERS
from us_sim.settings.setting import Settings
from us_sim.tracking.filters import create_filter
from us_sim.tracking.measurement import Measurement
from us_sim.tracking.settings import KalmanSettings, OneEuroSettings

Array = NDArray[np.float64]

_RATE = 60.0  # Hz
_NOISE, _TURN_NOISE = 3e-4, 3.5e-3  # m and rad, standard deviation of a coordinate
_MOVING, _REST = 8.0, 8.0  # s
_SWAY = ((0.25, 0.035, 0.25), (0.9, 0.009, 0.12), (2.3, 0.0012, 0.015))
"""Hz, m and rad of the hand's sway along and about each axis: a slow slide, a rocking, a tremor."""


def filter_pieces(quick: bool) -> list[Piece]:
    """Every filter over its settings; all are to follow the same noisy path."""
    return [
        Piece({"filter": name, "setting": words}, partial(filter_row, name, settings))
        for name, settings, words in _trials(quick)
    ]


def _trials(quick: bool) -> Iterator[tuple[str, Settings | None, str]]:
    """Filters' names, settings, and these in words."""
    cutoffs = (0.5, 1.5, 6.0) if quick else (0.25, 0.5, 1.0, 1.5, 3.0, 6.0, 12.0)
    slopes = (180.0,) if quick else (0.0, 60.0, 180.0, 600.0)
    accelerations = (0.01, 0.05, 0.25) if quick else (0.003, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0)
    yield "none", None, ""
    for slope in slopes:
        for cutoff in cutoffs:
            one_euro = OneEuroSettings(
                minimum_cutoff=cutoff,
                speed_coefficient=slope,
                rotation_minimum_cutoff=cutoff,
                rotation_speed_coefficient=(
                    slope * OneEuroSettings().rotation_speed_coefficient / 180.0
                ),
            )
            yield "one_euro", one_euro, f"{cutoff:g} Hz + {slope:g} Hz per m/s"
    for acceleration in accelerations:
        kalman = KalmanSettings(acceleration=acceleration, angular_acceleration=10 * acceleration)
        yield "kalman", kalman, f"{acceleration:g} m/s per root second"


def delay(times: Array, values: Array, path: Callable[[Array], Array]) -> float:
    """Seconds by which values (K, d) at times (K,) are behind a path, by least squares.

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


def filter_row(method: str, settings: Settings | None) -> list[dict[str, Any]]:
    """Row of a filter with some settings on the noisy path."""
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
    late = found[moving] - _position(times[moving] - lag)
    turned_rest = _root_mean_square(found_turns[rest] - turns[rest])
    return [
        {
            "rate_hz": _RATE,
            "noise_mm": 1e3 * _NOISE,
            "noise_deg": float(np.degrees(_TURN_NOISE)),
            "lag_ms": 1e3 * lag,
            "rotation_lag_ms": 1e3 * delay(times[moving], found_turns[moving], _rotation),
            "jitter_mm": 1e3 * _root_mean_square(found[rest] - positions[rest]),
            "jitter_deg": float(np.degrees(turned_rest)),
            "moving_jitter_mm": 1e3 * _root_mean_square(late),
            "error_mm": 1e3 * _root_mean_square(found[moving] - positions[moving]),
            "stated_lag_ms": 1e3 * float(np.median(np.array(stated)[moving])),
            "us_per_pose": 1e6 * seconds,
            "default": settings in (None, FILTERS.settings(method)()),
        }
    ]


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
