"""Points in time, spans, and the clocks that tell them: system, steady, and ROS time."""

import time as wall
import weakref
from enum import IntEnum
from functools import total_ordering
from operator import attrgetter
from typing import Any, Protocol

from ..messages import message_class

S_TO_NS = 1_000_000_000


class ClockType(IntEnum):
    """ROS_TIME follows the topic /clock when the parameter use_sim_time is true."""

    UNINITIALIZED = 0
    ROS_TIME = 1
    SYSTEM_TIME = 2
    STEADY_TIME = 3


@total_ordering
class Duration:
    """A period between two points in time; the fraction of a nanosecond is discarded."""

    __slots__ = ("_nanoseconds",)
    nanoseconds = property(attrgetter("_nanoseconds"))

    def __init__(self, *, seconds: int | float = 0, nanoseconds: int = 0):
        total = int(seconds * S_TO_NS) + int(nanoseconds)
        if not -(2**63) <= total < 2**63:
            raise OverflowError("Total nanoseconds value is too large to store in C duration.")
        self._nanoseconds = total

    def to_msg(self) -> Any:
        seconds, nanoseconds = divmod(self._nanoseconds, S_TO_NS)
        cls = message_class("builtin_interfaces/msg/Duration")
        return cls(sec=seconds, nanosec=nanoseconds)

    @classmethod
    def from_msg(cls, msg: Any) -> "Duration":
        """The span that a `builtin_interfaces/msg/Duration` holds; raises TypeError for others."""
        expected: Any = message_class("builtin_interfaces/msg/Duration")
        if not isinstance(msg, expected):
            raise TypeError("Must pass a builtin_interfaces.msg.Duration object")
        return cls(seconds=msg.sec, nanoseconds=msg.nanosec)

    def __repr__(self) -> str:
        return f"Duration(nanoseconds={self._nanoseconds})"

    def __str__(self) -> str:
        return "Infinite" if self == Infinite else f"{self._nanoseconds} nanoseconds"

    def __eq__(self, other: object) -> bool:
        if isinstance(other, Duration):
            return self._nanoseconds == other._nanoseconds
        return NotImplemented

    def __lt__(self, other: object) -> bool:
        if isinstance(other, Duration):
            return self._nanoseconds < other._nanoseconds
        return NotImplemented

    __hash__ = None  # type: ignore[assignment]


Infinite = Duration(nanoseconds=2**63 - 1)


@total_ordering
class Time:
    """A point in time with nanosecond precision, never before the epoch."""

    __slots__ = ("_clock_type", "_nanoseconds")
    nanoseconds = property(attrgetter("_nanoseconds"))
    clock_type = property(attrgetter("_clock_type"))

    def __init__(
        self,
        *,
        seconds: int | float = 0,
        nanoseconds: int = 0,
        clock_type: ClockType = ClockType.SYSTEM_TIME,
    ):
        if not isinstance(clock_type, ClockType):
            raise TypeError("Clock type must be a ClockType enum")
        if seconds < 0:
            raise ValueError("Seconds value must not be negative")
        if nanoseconds < 0:
            raise ValueError("Nanoseconds value must not be negative")
        total = int(seconds * S_TO_NS) + int(nanoseconds)
        if total >= 2**63:
            raise OverflowError("Total nanoseconds value is too large to store in C time point.")
        self._nanoseconds = total
        self._clock_type = clock_type

    def seconds_nanoseconds(self) -> tuple[int, int]:
        return divmod(self._nanoseconds, S_TO_NS)

    def to_msg(self) -> Any:
        seconds, nanoseconds = divmod(self._nanoseconds, S_TO_NS)
        return message_class("builtin_interfaces/msg/Time")(sec=seconds, nanosec=nanoseconds)

    @classmethod
    def from_msg(cls, msg: Any, clock_type: ClockType = ClockType.ROS_TIME) -> "Time":
        """The point that a `builtin_interfaces/msg/Time` holds; raises TypeError for others."""
        expected: Any = message_class("builtin_interfaces/msg/Time")
        if not isinstance(msg, expected):
            raise TypeError("Must pass a builtin_interfaces.msg.Time object")
        return cls(seconds=msg.sec, nanoseconds=msg.nanosec, clock_type=clock_type)

    def __repr__(self) -> str:
        return f"Time(nanoseconds={self._nanoseconds}, clock_type={self._clock_type.name})"

    def __add__(self, other: Duration) -> "Time":
        if not isinstance(other, Duration):
            return NotImplemented
        try:
            return self._shifted(other.nanoseconds)
        except OverflowError as error:
            raise OverflowError("Addition leads to overflow in C storage.") from error

    __radd__ = __add__

    def __sub__(self, other: "Time | Duration") -> Any:
        if isinstance(other, Time):
            if self._clock_type != other._clock_type:
                raise TypeError("Can't subtract times with different clock types")
            return Duration(nanoseconds=self._nanoseconds - other._nanoseconds)
        if isinstance(other, Duration):
            try:
                return self._shifted(-other.nanoseconds)
            except ValueError as error:
                raise ValueError("Subtraction leads to negative time.") from error
        return NotImplemented

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Time):
            return NotImplemented
        self._require_same_clock(other)
        return self._nanoseconds == other._nanoseconds

    def __lt__(self, other: object) -> bool:
        if not isinstance(other, Time):
            return NotImplemented
        self._require_same_clock(other)
        return self._nanoseconds < other._nanoseconds

    __hash__ = None  # type: ignore[assignment]

    def _shifted(self, nanoseconds: int) -> "Time":
        return Time(nanoseconds=self._nanoseconds + nanoseconds, clock_type=self._clock_type)

    def _require_same_clock(self, other: "Time") -> None:
        if self._clock_type != other._clock_type:
            raise TypeError("Can't compare times with different clock types")


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
        """Show another time, and tell the timers the time before."""
        before, is_other_time = self._now(), active != self._active
        self._active, self._override = active, override
        if active or is_other_time:
            for timer in list(self._timers):
                timer._on_time_jump(before, is_other_time)

    def _now(self) -> int:
        return self._override if self._active else wall.time_ns()

    def _runs_by_itself(self) -> bool:
        return not self._active
