"""The stamp of a serialized message, read from its first bytes without decoding the rest."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

from rosbags.interfaces import Nodetype

from us_sim.errors import BagError
from us_sim.recording.reader import Bag
from us_sim.recording.topic import BagTopic

_HEADER, _TIME = "std_msgs/msg/Header", "builtin_interfaces/msg/Time"
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
    if topic.encoding != "cdr":
        return None
    try:
        fields = bag.definitions(topic).fielddefs
    except BagError:
        return None

    def begins_with(type_name: str, wanted: str) -> bool:
        (_, inside) = fields.get(type_name, (None, []))
        return bool(inside) and inside[0][1] == (Nodetype.NAME, wanted)

    if not begins_with(_HEADER, _TIME):
        return None
    if begins_with(topic.type_name, _HEADER):
        return _stamp
    (_, own) = fields[topic.type_name]
    kind, content = own[0][1] if own else (None, None)
    if kind == Nodetype.SEQUENCE and begins_with(_name(content), _HEADER):
        return _first_stamp
    return None


def _name(sequence: Any) -> str:
    """The type of a sequence's elements; nothing where it is no message."""
    (kind, name), _ = sequence
    return str(name) if kind == Nodetype.NAME else ""


def _stamp(data: bytes, begin: int = _ENCAPSULATION) -> int:
    seconds, nanoseconds = _STAMP[bool(data[1] & 1)].unpack_from(data, begin)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def _first_stamp(data: bytes) -> int | None:
    (count,) = _COUNT[bool(data[1:2] == b"\1")].unpack_from(data, _ENCAPSULATION)
    return _stamp(data, _ENCAPSULATION + _COUNT[True].size) if count else None
