"""A bag's topics, messages and quality of service, as every kind of storage hands them out.

Quality of service is in the YAML of rosbag2: policies by name since Jazzy, by number before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from enum import Enum
from typing import Any, NamedTuple

import yaml
from rosbags.interfaces import QosTime
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.metadata import parse_qos

from us_sim.errors import BagError

INFINITE = 2**63 - 1  # ns, what rmw calls RMW_DURATION_INFINITE
_DURATIONS = ("deadline", "lifespan", "liveliness_lease_duration")


@dataclass(frozen=True)
class QosProfile:
    """The quality of service that a publisher offered; the defaults are rclpy's.

    Policies are named as rmw names them in lower case.
    """

    history: str = "keep_last"
    depth: int = 10
    reliability: str = "reliable"
    durability: str = "volatile"
    deadline: int = INFINITE  # ns
    lifespan: int = INFINITE  # ns
    liveliness: str = "automatic"
    liveliness_lease_duration: int = INFINITE  # ns
    avoid_ros_namespace_conventions: bool = False

    @classmethod
    def of(cls, profile: Any) -> QosProfile:
        """Return the profile that one of rclpy or rosbags is."""
        if isinstance(profile, QosProfile):
            return profile
        values = {}
        for each in fields(cls):
            value = getattr(profile, each.name)
            if isinstance(value, Enum):
                value = value.name.lower()
            elif isinstance(value, QosTime):
                value = value.sec * 10**9 + value.nsec
            values[each.name] = getattr(value, "nanoseconds", value)
        return cls(**values)

    @property
    def summary(self) -> str:
        """Its first four policies, for a person."""
        names = ("history", "depth", "reliability", "durability")
        return " ".join(f"{name}: {getattr(self, name)}" for name in names)

    def document(self) -> dict[str, Any]:
        """Return this profile as rosbag2 0.26 writes it."""
        values = asdict(self)
        for name in _DURATIONS:
            seconds, rest = divmod(values[name], 10**9)
            values[name] = {"sec": seconds, "nsec": rest}
        return values


def as_yaml(document: object) -> str:
    """Write a document as YAML, its keys in their order."""
    return yaml.safe_dump(document, sort_keys=False, allow_unicode=True)


def qos_to_yaml(profiles: Sequence[QosProfile]) -> str:
    """Write the YAML list that rosbag2 puts in a channel's ``offered_qos_profiles``."""
    return as_yaml([profile.document() for profile in profiles]).rstrip()


def qos_from_yaml(document: Any, where: str = "offered_qos_profiles") -> tuple[QosProfile, ...]:
    """Read the profiles of a bag of any version: YAML text, or the list that it parses to.

    Args:
        document: the text or the list; None or an empty text means no profiles.
        where: the beginning of errors.

    Raises:
        BagError: the text is not YAML, or not a list of profiles.
    """
    try:
        return tuple(map(QosProfile.of, parse_qos(document or [])))
    except (ReaderError, KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise BagError(f"{where}: this is not a list of QoS profiles: {reason}") from None


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

    @property
    def is_latched(self) -> bool:
        """Whether all its publishers kept messages for those who come later."""
        return bool(self.qos) and all(q.durability == "transient_local" for q in self.qos)

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
    sequence: int = 0  # its number on its topic; 0 where none is kept


class Fault(NamedTuple):
    """Something that is wrong with a bag."""

    text: str  # a sentence
    messages: int = 0  # that are lost by it, as far as is known
