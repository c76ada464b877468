"""A bag's topics and messages as every kind of storage hands them out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

from us_sim.errors import BagError
from us_sim.recording.qos import QosProfile

LOST = "messages_lost"
"""The note that says how many messages of each topic are missing since the note before."""
MARKER = "marker"
"""The note of a moment that a person marked: its ``time`` in ns, and a ``text``."""


@dataclass(frozen=True)
class BagTopic:
    """One topic of a bag."""

    name: str
    type_name: str  # package/msg/Type
    message_count: int
    qos: tuple[QosProfile, ...] = ()
    type_hash: str = ""  # RIHS01_…; empty before ROS 2 Iron
    encoding: str = "cdr"
    schema: str | None = None  # ros2msg text; None where the bag carries none

    def joined(self, other: BagTopic, bag: str) -> BagTopic:
        """This topic with the messages of another channel or file of the same name.

        Raises:
            BagError: the two are of different types or encodings.
        """
        if (self.type_name, self.encoding) != (other.type_name, other.encoding):
            raise BagError(
                f"{bag} holds topic {self.name} as {self.type_name} ({self.encoding}) and as "
                f"{other.type_name} ({other.encoding}): a topic has one type, so split the bag"
            )
        return replace(
            self,
            message_count=self.message_count + other.message_count,
            qos=self.qos or other.qos,
            type_hash=self.type_hash or other.type_hash,
            schema=other.schema if self.schema is None else self.schema,
        )


class BagMessage(NamedTuple):
    """One message of a bag, still serialized."""

    topic: str
    type_name: str
    log_time: int  # ns since the epoch, when the recorder received it
    publish_time: int  # ns since the epoch, when it was sent; the log time where none is kept
    data: bytes


class BagAttachment(NamedTuple):
    """A file within a bag."""

    name: str
    media_type: str
    time: int  # ns since the epoch
    data: bytes


class BagNote(NamedTuple):
    """Texts by their names that a bag holds beside its messages."""

    name: str
    values: dict[str, str]


class Fault(NamedTuple):
    """Something that is wrong with a bag."""

    text: str  # a sentence
    messages: int = 0  # that are lost by it, as far as is known
