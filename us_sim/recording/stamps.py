"""Readers of the stamps of a topic's serialized messages."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rosbags.interfaces import Nodetype

from us_sim.errors import BagError
from us_sim.recording.decoding import read_first_stamp, read_stamp
from us_sim.recording.reader import Bag
from us_sim.recording.topic import BagTopic

_HEADER = (Nodetype.NAME, "std_msgs/msg/Header")

Stamp = Callable[[bytes], int | None]


def make_stamp_reader(bag: Bag, topic: BagTopic) -> Stamp | None:
    """Return a function from a message's bytes to its stamp in ns; None where it has no header.

    The type must begin with a header, or with a sequence of such, of which the first counts, as
    in tf. The function gives None for an empty sequence.

    The function raises struct.error for a message that is too short to have a stamp.
    """
    try:
        fields = bag.find_definitions(topic).fielddefs if topic.encoding == "cdr" else {}
    except BagError:
        return None

    def first_field(type_name: str) -> Any:
        _, own = fields.get(type_name, (None, []))
        return own[0][1] if own else (None, None)

    kind, content = first_field(topic.type_name)
    if (kind, content) == _HEADER:
        return read_stamp
    if kind == Nodetype.SEQUENCE and content[0][0] == Nodetype.NAME:
        return read_first_stamp if first_field(content[0][1]) == _HEADER else None
    return None
