"""A bag's topics, messages and quality of service, as every kind of storage hands them out.

Quality of service is in the YAML of rosbag2: policies by name since Jazzy, by number before.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import yaml
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.metadata import dump_qos_v9, parse_qos

from us_sim.errors import BagError

_INFINITE = QosTime(*divmod(2**63 - 1, 10**9))  # what rmw calls RMW_DURATION_INFINITE
DEFAULT_QOS = Qos(
    history=QosHistory.KEEP_LAST,
    depth=10,
    reliability=QosReliability.RELIABLE,
    durability=QosDurability.VOLATILE,
    deadline=_INFINITE,
    lifespan=_INFINITE,
    liveliness=QosLiveliness.AUTOMATIC,
    liveliness_lease_duration=_INFINITE,
    avoid_ros_namespace_conventions=False,
)
"""The quality of service that a publisher offers by default, as rclpy's does."""


def qos_of(profile: Any) -> Qos:
    """Return a profile of rclpy as one of rosbags, whose policies have the same names."""
    durations = (profile.deadline, profile.lifespan, profile.liveliness_lease_duration)
    deadline, lifespan, lease = (QosTime(*divmod(each.nanoseconds, 10**9)) for each in durations)
    return Qos(
        QosHistory[profile.history.name],
        profile.depth,
        QosReliability[profile.reliability.name],
        QosDurability[profile.durability.name],
        deadline,
        lifespan,
        QosLiveliness[profile.liveliness.name],
        lease,
        profile.avoid_ros_namespace_conventions,
    )


def to_yaml(document: object) -> str:
    """Write a document as YAML, its keys in their order."""
    return yaml.safe_dump(document, sort_keys=False, allow_unicode=True)


def qos_to_yaml(profiles: Iterable[Qos]) -> str:
    """Write the YAML list that rosbag2 puts in a channel's ``offered_qos_profiles``."""
    return to_yaml(dump_qos_v9([*profiles])).rstrip()


def qos_from_yaml(document: Any, where: str = "offered_qos_profiles") -> tuple[Qos, ...]:
    """Read the profiles of a bag of any version: YAML text, or the list that it parses to.

    Args:
        document: the text or the list; None or an empty text means no profiles.
        where: the beginning of errors.

    Raises:
        BagError: the text is not YAML, or not a list of profiles.
    """
    try:
        return tuple(parse_qos(document or []))
    except (ReaderError, KeyError, TypeError, ValueError, AttributeError, RecursionError) as error:
        reason = " ".join(str(error).split())
        raise BagError(f"{where}: this is not a list of QoS profiles: {reason}") from None


LOST = "messages_lost"
"""The note that says how many messages of each topic are missing since the note before."""


@dataclass(frozen=True)
class BagTopic:
    """One topic of a bag."""

    name: str
    type_name: str  # package/msg/Type
    message_count: int
    qos: tuple[Qos, ...] = ()
    type_hash: str = ""  # RIHS01_…; empty before ROS 2 Iron
    encoding: str = "cdr"
    schema: str | None = None  # ros2msg text; None where the bag carries none

    @property
    def is_latched(self) -> bool:
        """Return whether all its publishers kept messages for those who come later."""
        return {q.durability for q in self.qos} == {QosDurability.TRANSIENT_LOCAL}

    def merge_topic(self, other: BagTopic, bag: str) -> BagTopic:
        """Return this topic with the messages of another channel or file of the same name.

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
