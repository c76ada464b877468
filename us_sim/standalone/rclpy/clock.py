"""Clocks: system, steady, and ROS time, which a simulator can set.

>>> clock = Clock(clock_type=ClockType.ROS_TIME)
>>> clock.set_ros_time_override(Time(seconds=3, clock_type=ClockType.ROS_TIME))
>>> clock._set_ros_time_is_active(True)
>>> clock.now()
Time(nanoseconds=3000000000, clock_type=ROS_TIME)
"""

import time as wall
import weakref
from operator import attrgetter
from typing import Protocol

from .clock_type import ClockType
from .time import Time

__all__ = ["Clock", "ClockType", "ROSClock"]


class _Timer(Protocol):
    def _on_time_jump(self, before: int, is_other_time: bool) -> None: ...


class Clock:
    """Tells the time of one kind; `Clock(clock_type=ClockType.ROS_TIME)` is a ROSClock."""

    _clock_type: ClockType
    _timers: "weakref.WeakSet[_Timer]"
    clock_type = property(attrgetter("_clock_type"))

    def __new__(cls, *, clock_type: ClockType = ClockType.SYSTEM_TIME) -> "Clock":
        if not isinstance(clock_type, ClockType):
            raise TypeError("Clock type must be a ClockType enum")
        self: Clock
        if clock_type is ClockType.ROS_TIME:
            self = super().__new__(ROSClock)
            self._active = False  # type: ignore[attr-defined]
            self._override = 0  # type: ignore[attr-defined]
        else:
            self = super().__new__(cls)
        self._clock_type = clock_type
        self._timers = weakref.WeakSet()
        return self

    def __repr__(self) -> str:
        return f"Clock(clock_type={self._clock_type.name})"

    def now(self) -> Time:
        """The time now."""
        return Time(nanoseconds=self._now(), clock_type=self._clock_type)

    def _now(self) -> int:
        if self._clock_type is ClockType.STEADY_TIME:
            return wall.monotonic_ns()
        return wall.time_ns()

    def _runs_by_itself(self) -> bool:
        """Whether this clock advances with real time, so that one can wait for it."""
        return True


class ROSClock(Clock):
    """A clock that shows system time until it is set by a simulator."""

    _active: bool
    _override: int
    ros_time_is_active = property(attrgetter("_active"))

    def __new__(cls) -> "ROSClock":
        self = super().__new__(Clock, clock_type=ClockType.ROS_TIME)
        assert isinstance(self, ROSClock)
        return self

    def set_ros_time_override(self, time: Time) -> None:
        """Set the time that this clock shows while ROS time is active."""
        if not isinstance(time, Time):
            raise TypeError(
                f"Time must be specified as rclpy.time.Time. Received type: {type(time)}"
            )
        self._change(self._active, time.nanoseconds)

    def _set_ros_time_is_active(self, enabled: bool) -> None:
        self._change(enabled, self._override)

    def _change(self, active: bool, override: int) -> None:
        """Show another time, and let the timers know what was shown before."""
        before, is_other_time = self._now(), active != self._active
        self._active, self._override = active, override
        if active or is_other_time:
            for timer in list(self._timers):
                timer._on_time_jump(before, is_other_time)

    def _now(self) -> int:
        return self._override if self._active else wall.time_ns()

    def _runs_by_itself(self) -> bool:
        return not self._active
