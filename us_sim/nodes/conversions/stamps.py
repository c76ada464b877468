"""Stamps and frames of messages, checked: a type allows times that are none."""

from __future__ import annotations

from typing import Any

from builtin_interfaces.msg import Time
from std_msgs.msg import Header

from us_sim.errors import MessageError, StampError

_SECOND = 1_000_000_000  # ns
_LAST = 2**31 - 1 - 86_400
"""s since 1970, a day before a stamp can count no further: what is added must be counted, too."""


def nanoseconds_of(stamp: Time) -> int:
    """The ns since 1970 of a stamp; 0 for one that was never set.

    Raises:
        StampError: it is no time: before 1970, with a second's worth of nanoseconds or more, or
            so late that ROS cannot count any further.
    """
    return nanoseconds_since(stamp.sec, stamp.nanosec)


def nanoseconds_since(seconds: int, nanoseconds: int) -> int:
    """Likewise, of a stamp's two parts."""
    if not 0 <= seconds <= _LAST or not 0 <= nanoseconds < _SECOND:
        raise StampError(
            f"the stamp of {seconds} s and {nanoseconds} ns is no time: let the sender stamp its "
            f"messages with its clock"
        )
    return int(_SECOND * seconds + nanoseconds)


def stamp_message(nanoseconds: int) -> Time:
    """The stamp of a time in ns since 1970; of 1970 itself where it is before.

    Raises:
        StampError: it is so late that ROS cannot count any further.
    """
    seconds, rest = divmod(max(int(nanoseconds), 0), _SECOND)
    if seconds > _LAST:
        raise StampError(f"a time of {seconds} s after 1970 is later than a stamp can say")
    return Time(sec=seconds, nanosec=rest)


def require_stamp(message: Any) -> None:
    """Look at the stamp that a message has in its header, or as a clock.

    Raises:
        StampError: there is one, and it is no time.
    """
    header = getattr(message, "header", None)
    stamp = getattr(message, "clock", None) if header is None else header.stamp
    if stamp is not None:
        nanoseconds_of(stamp)


def require_frame(header: Header, frame: str | None) -> None:
    """Look at the frame of a message; None is any.

    Raises:
        MessageError: it is another one.
    """
    if frame is not None and header.frame_id != frame:
        raise MessageError(f"is in frame '{header.frame_id}', not '{frame}'")
