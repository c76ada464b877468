"""A bag's topics, messages and quality of service, as every kind of storage hands them out.

Quality of service is in the YAML of rosbag2: policies by name since Jazzy, by number before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import yaml

from us_sim.errors import BagError
from us_sim.settings.text_files import YamlError, load_yaml

INFINITE = 2**63 - 1  # ns, what rmw calls RMW_DURATION_INFINITE

_POLICIES = {
    "history": ("system_default", "keep_last", "keep_all", "unknown"),
    "reliability": ("system_default", "reliable", "best_effort", "unknown", "best_available"),
    "durability": ("system_default", "transient_local", "volatile", "unknown", "best_available"),
    "liveliness": (
        "system_default",
        "automatic",
        "manual_by_node",
        "manual_by_topic",
        "unknown",
        "best_available",
    ),
}
"""Policies in the order of their numbers in rmw/types.h, which rosbag2 before Jazzy wrote."""

_DURATIONS = ("deadline", "lifespan", "liveliness_lease_duration")


@dataclass(frozen=True)
class QosProfile:
    """The quality of service that a publisher offered; the defaults are rclpy's.

    Policies are named as rmw names them in lower case.

    Raises:
        BagError: a policy has no such name.
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

    def __post_init__(self) -> None:
        for policy, names in _POLICIES.items():
            if getattr(self, policy) not in names:
                raise BagError(
                    f"QoS {policy} cannot be {getattr(self, policy)!r}: use one of "
                    f"{', '.join(names)}"
                )

    @classmethod
    def of(cls, profile: object) -> QosProfile:
        """The profile that ``profile`` describes.

        Args:
            profile: a QosProfile, a mapping as in a bag's YAML, or an object with the attributes
                of ``rclpy.qos.QoSProfile``.

        Raises:
            BagError: it is none of these, or holds a policy that does not exist.
        """
        if isinstance(profile, QosProfile):
            return profile
        try:
            if isinstance(profile, Mapping):
                values = {name: profile[name] for name in cls.__dataclass_fields__}
            else:
                values = {name: getattr(profile, name) for name in cls.__dataclass_fields__}
        except (KeyError, AttributeError) as error:
            raise BagError(f"{repr(profile)[:200]} is no QoS profile: it lacks {error}") from None
        for policy in _POLICIES:
            values[policy] = _policy_name(policy, values[policy])
        for duration in _DURATIONS:
            values[duration] = _nanoseconds(duration, values[duration])
        try:
            values["depth"] = int(values["depth"])
        except (TypeError, ValueError, OverflowError):
            raise BagError(f"QoS depth is no whole number: {values['depth']!r}") from None
        return cls(**values)

    @property
    def summary(self) -> str:
        """Its first four policies, for a person."""
        names = ("history", "depth", "reliability", "durability")
        return " ".join(f"{name}: {getattr(self, name)}" for name in names)

    def document(self) -> dict[str, Any]:
        """This profile as rosbag2 0.26 writes it."""
        values = dict(vars(self))
        for name in _DURATIONS:
            seconds, rest = divmod(values[name], 10**9)
            values[name] = {"sec": seconds, "nsec": rest}
        return values


def as_yaml(document: object) -> str:
    """A document as YAML, its keys in their order."""
    return yaml.safe_dump(document, sort_keys=False, allow_unicode=True)


def qos_to_yaml(profiles: Sequence[QosProfile]) -> str:
    """The YAML list that rosbag2 puts in a channel's ``offered_qos_profiles``."""
    return as_yaml([profile.document() for profile in profiles]).rstrip()


def qos_from_yaml(document: object, where: str = "offered_qos_profiles") -> tuple[QosProfile, ...]:
    """The profiles of a bag of any version: YAML text, or the list that it parses to.

    Args:
        document: the text or the list; None or an empty text means no profiles.
        where: the beginning of errors.

    Raises:
        BagError: the text is not YAML, or not a list of profiles.
    """
    try:
        if isinstance(document, str):
            document = load_yaml(document)
        if document is None or document == "":
            return ()
        if not isinstance(document, list):
            raise BagError("this is not a list of QoS profiles")
        return tuple(QosProfile.of(item) for item in document)
    except YamlError as error:
        raise BagError(f"{where}: the QoS profiles are not YAML: {error}") from None
    except BagError as error:
        raise BagError(f"{where}: {error}") from None


def _policy_name(policy: str, value: Any) -> str:
    """Lower-case name of a policy that is a name, a number or an enum member."""
    names = _POLICIES[policy]
    name = getattr(value, "name", value)
    if isinstance(name, str):
        return name.lower()
    if isinstance(name, int) and 0 <= name < len(names):
        return names[name]
    raise BagError(f"QoS {policy} cannot be {value!r}: use one of {', '.join(names)}")


def _nanoseconds(duration: str, value: Any) -> int:
    """Nanoseconds of an integer, of ``{sec, nsec}``, or of an rclpy Duration."""
    try:
        if isinstance(value, Mapping):
            return int(value["sec"]) * 10**9 + int(value["nsec"])
        return int(getattr(value, "nanoseconds", value))
    except (KeyError, TypeError, ValueError, OverflowError):
        raise BagError(f"QoS {duration} is not a duration: {value!r}") from None


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
