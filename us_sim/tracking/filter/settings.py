"""How a tracker's poses are filtered, and which of them are not believed.

>>> from us_sim.tracking.filter.settings import FilterSettings
>>> FilterSettings(method="one_euro", minimum_cutoff="2 Hz").minimum_cutoff
2.0
>>> FilterSettings(method="median")
Traceback (most recent call last):
...
us_sim.errors.TrackingError: filter.method: 'median' is not one of none, one_euro, kalman
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from us_sim.errors import TrackingError
from us_sim.settings.quantity import Quantity, given, require_given

__all__ = ["FILTER_METHODS", "FilterSettings", "GateSettings"]

FILTER_METHODS = ("none", "one_euro", "kalman")

_CUTOFF = Quantity("frequency", 1e-3, 1e3)
_PER_SPEED = Quantity("number", 0.0, 1e5)
_COUNT = Quantity("number", 2, 10_000)


@dataclass(frozen=True)
class FilterSettings:
    """The settings of the filter of a tracker's poses; each is a key of ``tracker.filter``.

    The defaults suit a hand-held probe: at rest the One-Euro filter takes away most of what
    trembles above 1.5 Hz, and in a sweep of 0.1 m/s it lags by 8 ms.

    Raises:
        TrackingError: a value is out of range, with its name and the range.
    """

    method: str = given(default="none", choices=FILTER_METHODS, description="which filter")
    minimum_cutoff: float = given(
        _CUTOFF, default=1.5, description="Hz, One-Euro: cutoff of the position at rest"
    )
    speed_coefficient: float = given(
        _PER_SPEED,
        default=180.0,
        description="Hz per m/s, One-Euro: how much the position's cutoff rises with speed",
    )
    rotation_minimum_cutoff: float = given(
        _CUTOFF, default=1.5, description="Hz, One-Euro: cutoff of the rotation at rest"
    )
    rotation_speed_coefficient: float = given(
        _PER_SPEED,
        default=20.0,
        description="Hz per rad/s, One-Euro: how much the rotation's cutoff rises with speed",
    )
    derivative_cutoff: float = given(
        _CUTOFF, default=1.0, description="Hz, One-Euro: cutoff of the speeds"
    )
    acceleration: float = given(
        Quantity("number", 1e-6, 1e4),
        default=0.05,
        description="m/s per root second, Kalman: how much the speed changes within a second, one "
        "standard deviation; within a time t by the root of t as much",
    )
    angular_acceleration: float = given(
        Quantity("number", 1e-6, 1e5),
        default=0.5,
        description="rad/s per root second, Kalman: the same of the rotation",
    )
    position_deviation: float = given(
        Quantity("length", 1e-9, 0.1),
        default=3e-4,
        description="m, Kalman: noise of each coordinate of a pose that says nothing of its own",
    )
    rotation_deviation: float = given(
        Quantity("angle", 1e-9, 1.0),
        default=5e-3,
        description="rad, Kalman: noise about each axis of a pose that says nothing of its own",
    )

    def __post_init__(self) -> None:
        require_given(self, "filter", TrackingError)


@dataclass(frozen=True)
class GateSettings:
    """Which poses are not believed; each setting is a key of ``tracker.gate``.

    Raises:
        TrackingError: a value is out of range, with its name and the range.
    """

    maximum_speed: float = given(
        Quantity("speed", 1e-3, 100.0), default=2.0, description="m/s of the probe's face"
    )
    maximum_angular_speed: float = given(
        Quantity("angular speed", 1e-2, 1e3), default=15.0, description="rad/s of the probe"
    )
    jump: float = given(
        Quantity("length", 0.0, 1.0),
        default=5e-3,
        description="m, from one pose to the next beside what the speed allows: a pose's noise",
    )
    rotation_jump: float = given(
        Quantity("angle", 0.0, math.pi),
        default=math.radians(5),
        description="rad, from one pose to the next beside what the speed allows",
    )
    confidence: float = given(
        Quantity("number", 0.5, 1 - 1e-12),
        default=0.999999,
        description="share of right poses with a covariance that are believed",
    )
    accept_after: int = given(
        _COUNT,
        default=5,
        description="so many refused poses in a row that agree with each other are the new place",
    )

    def __post_init__(self) -> None:
        require_given(self, "gate", TrackingError)
