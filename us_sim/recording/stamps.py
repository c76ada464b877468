"""The stamp of a serialized message, read from its first bytes without decoding the rest."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

from rosbags.interfaces import Nodetype

from us_sim.errors import BagError
from us_sim.recording.reader import Bag
from us_sim.recording.topic import BagTopic

_HEADER = (Nodetype.NAME, "std_msgs/msg/Header")
_STAMP = {True: struct.Struct("<iI"), False: struct.Struct(">iI")}
_COUNT = {True: struct.Struct("<I"), False: struct.Struct(">I")}
_ENCAPSULATION = 4  # bytes before a message in CDR; the second tells the order of bytes

Stamp = Callable[[bytes], int | None]


def stamp_reader(bag: Bag, topic: BagTopic) -> Stamp | None:
    """A function from a message's bytes to its stamp in ns; None where the type has no header.

    The type must begin with a header, or with a sequence of such, of which the first counts, as
    in tf. The function gives None for an empty sequence.

    The function raises struct.error for a message that is too short to have a stamp.
    """
    try:
        fields = bag.definitions(topic).fielddefs if topic.encoding == "cdr" else {}
    except BagError:
        return None

    def first_field(type_name: str) -> Any:
        _, own = fields.get(type_name, (None, []))
        return own[0][1] if own else (None, None)

    kind, content = first_field(topic.type_name)
    if (kind, content) == _HEADER:
        return _stamp
    if kind == Nodetype.SEQUENCE and content[0][0] == Nodetype.NAME:
        return _first_stamp if first_field(content[0][1]) == _HEADER else None
    return None


def _stamp(data: bytes, begin: int = _ENCAPSULATION) -> int:
    seconds, nanoseconds = _STAMP[bool(data[1] & 1)].unpack_from(data, begin)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def _first_stamp(data: bytes) -> int | None:
    (count,) = _COUNT[bool(data[1:2] == b"\1")].unpack_from(data, _ENCAPSULATION)
    return _stamp(data, _ENCAPSULATION + _COUNT[True].size) if count else None
