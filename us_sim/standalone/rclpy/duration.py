"""A span of time with nanosecond precision.

>>> Duration(seconds=1.5) > Duration(nanoseconds=1)
True
>>> Duration(seconds=1.5).nanoseconds
1500000000
"""

from functools import total_ordering
from operator import attrgetter
from typing import Any

from ..messages import message_class
from .constants import S_TO_NS


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
        """This span as a `builtin_interfaces/msg/Duration`."""
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
