"""A point in time, of one of the three kinds of clock.

>>> start = Time(seconds=2, nanoseconds=5)
>>> start.seconds_nanoseconds()
(2, 5)
>>> start + Duration(seconds=1) - start
Duration(nanoseconds=1000000000)
"""

from functools import total_ordering
from operator import attrgetter
from typing import Any

from ..messages import message_class
from .clock_type import ClockType
from .constants import S_TO_NS
from .duration import Duration


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
        """Whole seconds, and the nanoseconds beyond them."""
        return divmod(self._nanoseconds, S_TO_NS)

    def to_msg(self) -> Any:
        """This point as a `builtin_interfaces/msg/Time`."""
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
