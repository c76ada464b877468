"""One message to the page: a header of JSON, and bytes.

>>> from us_sim.viewer.packet import Packet
>>> packet = Packet("image", 7, {"rows": 1, "columns": 4}, bytes([0, 85, 170, 255]))
>>> len(packet.encoded) % 4, Packet.decoded(packet.encoded) == packet
(0, True)
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

_LENGTH = struct.Struct("<I")
_ALIGNMENT = 8
"""Bytes: where the payload begins is a multiple, so that the page can look at it as numbers."""


@dataclass(frozen=True)
class Packet:
    """What one message of a stream holds."""

    kind: str  # the stream's name
    sequence: int  # counts the messages of the stream
    header: Mapping[str, Any]  # JSON-like, without numbers that are none
    payload: bytes

    @cached_property
    def encoded(self) -> bytes:
        """As sent: length of the header (32 bits, little endian), header, payload."""
        header = {"kind": self.kind, "sequence": self.sequence, **self.header}
        text = json.dumps(header, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-(_LENGTH.size + len(text)) % _ALIGNMENT)
        return b"".join((_LENGTH.pack(len(text)), text, self.payload))

    @classmethod
    def decoded(cls, data: bytes) -> Packet:
        """The packet of :attr:`encoded`."""
        (length,) = _LENGTH.unpack_from(data)
        header = json.loads(data[_LENGTH.size : _LENGTH.size + length])
        kind, sequence = header.pop("kind"), header.pop("sequence")
        return cls(kind, sequence, header, data[_LENGTH.size + length :])
