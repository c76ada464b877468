"""Messages to bytes and back: plain CDR (XCDR1) as ROS 2 puts it on the wire and into bags.

>>> from us_sim.standalone.cdr import deserialize, serialize
>>> from us_sim.standalone.message_class import message_class
>>> Point = message_class("geometry_msgs/msg/Point")
>>> serialize(Point(x=1.0))[:12].hex()
'00010000000000000000f03f'
>>> deserialize(serialize(Point(x=1.0)), Point)
geometry_msgs.msg.Point(x=1.0, y=0.0, z=0.0)
"""

from __future__ import annotations

import struct
from typing import TypeVar

from .cdr_source import compiled_reader, compiled_writer
from .message_class import Message

M = TypeVar("M", bound=Message)


class CdrError(Exception):
    """Bytes are not the serialized message they should be."""


def serialize(message: Message) -> bytes:
    """The message as a four-byte header and little-endian XCDR1, as rclpy serializes it."""
    return compiled_writer(message.__msgtype__)(message)


def deserialize(data: bytes | bytearray | memoryview, cls: type[M]) -> M:
    """The message of class ``cls`` in ``data``.

    Raises:
        CdrError: the bytes end too early, hold text that is no UTF-8, or are of another encoding.
    """
    data = bytes(data)
    if data[:2] == b"\x00\x01":
        order = "<"
    elif data[:2] == b"\x00\x00":
        order = ">"
    else:
        raise CdrError(
            f"{len(data)} bytes starting with {data[:4].hex() or 'nothing'} are not the plain CDR "
            f"of a {cls.__msgtype__}; only XCDR1 (0000 or 0001) can be read"
        )
    try:
        message, end = compiled_reader(cls.__msgtype__, order)(data, memoryview(data))
    except (struct.error, ValueError) as error:
        raise CdrError(
            f"{len(data)} bytes do not form a {cls.__msgtype__} ({error}); "
            f"check that the topic has this type"
        ) from error
    if end > len(data):
        raise CdrError(
            f"{len(data)} bytes are too few for a {cls.__msgtype__}, which needs {end}; "
            f"check that the topic has this type"
        )
    return message
