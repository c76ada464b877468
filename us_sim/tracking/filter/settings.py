"""The settings of the filters of a tracker's poses, and of the gate that refuses some.

>>> from us_sim.tracking.filter.settings import OneEuroSettings
>>> OneEuroSettings(minimum_cutoff="2 Hz").minimum_cutoff
2.0
>>> OneEuroSettings(derivative_cutoff=0)
Traceback (most recent call last):
...
us_sim.errors.TrackingError: filter.derivative_cutoff: 0 Hz is outside 0.001 to 1000 Hz
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from us_sim.errors import TrackingError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting

_CUTOFF = Quantity("frequency", 1e-3, 1e3)


@dataclass(frozen=True)
class OneEuroSettings(Settings):
    """The settings of the One-Euro filter; each is a key of ``tracker.filter``.

    The defaults suit a hand-held probe: at rest the filter takes away most of what trembles above
    1.5 Hz, and in a sweep of 0.1 m/s it lags by 8 ms.

    Raises:
        TrackingError: a value is out of range, with its name and the range.
    """

    section = "filter"
    error = TrackingError
    live = True

    minimum_cutoff: float = setting(
        _CUTOFF, default=1.5, description="cutoff of the position at rest"
    )
    speed_coefficient: float = setting(
        Quantity("cutoff per speed", 0.0, 1e5),
        default=180.0,
        description="how much the position's cutoff rises with speed",
    )
    rotation_minimum_cutoff: float = setting(
        _CUTOFF, default=1.5, description="cutoff of the rotation at rest"
    )
    rotation_speed_coefficient: float = setting(
        Quantity("cutoff per angular speed", 0.0, 1e5),
        default=20.0,
        description="how much the rotation's cutoff rises with angular speed",
    )
    derivative_cutoff: float = setting(_CUTOFF, default=1.0, description="cutoff of the speeds")


@dataclass(frozen=True)
class KalmanSettings(Settings):
    """The settings of the constant-velocity Kalman filter; each is a key of ``tracker.filter``.

    Raises:
        TrackingError: a value is out of range, with its name and the range.
    """

    section = "filter"
    error = TrackingError
    live = True

    acceleration: float = setting(
        Quantity("acceleration noise", 1e-6, 1e4),
        default=0.05,
        description="standard deviation of the change of the speed within a second; within a time "
        "t it is the root of t times as much",
    )
    angular_acceleration: float = setting(
        Quantity("angular acceleration noise", 1e-6, 1e5),
        default=0.5,
        description="the same of the angular speed",
    )
    position_deviation: float = setting(
        Quantity("length", 1e-9, 0.1),
        default=3e-4,
        description="standard deviation of each coordinate of a pose that comes without covariance",
    )
    rotation_deviation: float = setting(
        Quantity("angle", 1e-9, 1.0),
        default=5e-3,
        description="standard deviation about each axis of a pose that comes without covariance",
    )


@dataclass(frozen=True)
class GateSettings(Settings):
    """The settings of the gate that refuses poses; each is a key of ``tracker.gate``.

    Raises:
        TrackingError: a value is out of range, with its name and the range.
    """

    section = "gate"
    error = TrackingError

    maximum_speed: float = setting(
        Quantity("speed", 1e-3, 100.0), default=2.0, description="largest speed of the probe's face"
    )
    maximum_angular_speed: float = setting(
        Quantity("angular speed", 1e-2, 1e3),
        default=15.0,
        description="largest angular speed of the probe",
    )
    jump: float = setting(
        Quantity("length", 0.0, 1.0),
        default=5e-3,
        description="distance between two poses that is allowed beside what the speed allows: a "
        "pose's noise",
    )
    rotation_jump: float = setting(
        Quantity("angle", 0.0, math.pi),
        default=math.radians(5),
        description="turn between two poses that is allowed beside what the angular speed allows",
    )
    confidence: float = setting(
        Quantity("number", 0.5, 1 - 1e-12),
        default=0.999999,
        description="fraction of right poses with a covariance that are believed",
    )
    accept_after: int = setting(
        Quantity("number", 2, 10_000),
        default=5,
        description="so many refused poses in a row that agree with each other are the new place",
    )
