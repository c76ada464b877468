"""Serialized messages whose sequences claim more elements than the bytes hold.

Fast DDS's type support of Jazzy makes room for as many elements as a sequence claims, before it
looks at the bytes: 24 of them can take all the memory there is. So those are looked through first,
by rosbags, which makes room for nothing.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from rosbags.interfaces import Nodetype

from us_sim.recording.schemas import jazzy_definitions


def require_sequences(data: bytes, message_type: Any) -> None:
    """Look at the sequences of a serialized message, where its type is one of Jazzy's with any.

    Raises:
        Exception: what rosbags raises, where the bytes are no such message.
    """
    name = f"{message_type.__module__.partition('.')[0]}/msg/{message_type.__name__}"
    if _has_sequences(name):
        jazzy_definitions().deserialize_cdr(data, name)


@cache
def _has_sequences(name: str) -> bool:
    fields = jazzy_definitions().fielddefs.get(name, ((), ()))[1]
    return any(_is_sequence(*kind) for _, kind in fields)


def _is_sequence(kind: Nodetype, of: Any) -> bool:
    if kind is Nodetype.ARRAY:
        return _is_sequence(*of[0])
    return kind is Nodetype.SEQUENCE or (kind is Nodetype.NAME and _has_sequences(of))
