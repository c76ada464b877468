"""The names and bytes by which rmw_zenoh's nodes know each other: keys, tokens, attachments.

They are those of rmw_zenoh_cpp 0.2 (ROS 2 Jazzy), as its design.md, liveliness_utils.cpp and
attachment_helpers.cpp have them; see https://github.com/ros2/rmw_zenoh.
"""

from __future__ import annotations

import re
import struct
from dataclasses import astuple, dataclass, replace

import xxhash

from .middleware import EndpointQos

NODE, PUBLISHER, SUBSCRIPTION, SERVICE, CLIENT = "NN", "MP", "MS", "SS", "SC"

DEFAULT_DEPTH = 42
"""The depth that 0 stands for."""

_SPACE = "@ros2_lv"
_OF_NODE, _OF_ENDPOINT = 9, 13  # the parts of a token
_DEFAULT_QOS = EndpointQos(depth=DEFAULT_DEPTH)
_INFINITE = (9223372036, 854775807)  # rmw_time_t: s, ns
_QOS = "{}:{}:{},{}:{},{}:{},{}:{},{},{}"
_ATTACHMENT = struct.Struct("<qqB16s")
_GID_SIZE = 16


def all_tokens(domain: int) -> str:
    """The key expression of every token in a domain."""
    return f"{_SPACE}/{domain}/**"


def key_of(domain: int, name: str, type_name: str, type_hash: str) -> str:
    """The key on which a topic's samples, or a service's requests, travel.

    >>> key_of(0, "/robot1/chatter", "std_msgs::msg::dds_::String_", "RIHS01_df66")
    '0/robot1/chatter/std_msgs::msg::dds_::String_/RIHS01_df66'
    """
    return f"{domain}/{name.strip('/')}/{type_name}/{type_hash}"


def attachment(sequence: int, timestamp: int, gid: bytes) -> bytes:
    """The bytes beside a sample: its number, its time (ns since 1970) and its sender.

    In zenoh's serialization: two signed numbers of 64 bits, then the bytes after their number.
    """
    return _ATTACHMENT.pack(sequence, timestamp, len(gid), gid)


def read_attachment(data: bytes) -> tuple[int, int, bytes] | None:
    """The number, time and gid in an attachment; None if it is none of rmw_zenoh's."""
    if len(data) != _ATTACHMENT.size:
        return None
    sequence, timestamp, size, gid = _ATTACHMENT.unpack(data)
    return (sequence, timestamp, gid) if size == _GID_SIZE else None


@dataclass(frozen=True)
class Entity:
    """A node, or an endpoint of one, as its liveliness token tells of it."""

    domain: int
    session: str  # zenoh's id, in hexadecimal
    node_number: int
    number: int  # its own; a node's is node_number
    kind: str
    enclave: str
    namespace: str
    node: str
    name: str = ""  # of the topic or service; nodes have none, nor what follows
    type_name: str = ""  # as in DDS
    type_hash: str = ""
    qos: EndpointQos = _DEFAULT_QOS

    @property
    def token(self) -> str:
        """The key that is alive as long as the entity is."""
        *parts, _ = astuple(self)
        text = [_mangled(str(part)) for part in parts[: _OF_NODE - 1]]
        if self.kind != NODE:
            text += [*(_mangled(part) for part in parts[_OF_NODE - 1 :]), qos_text(self.qos)]
        return "/".join([_SPACE, *text])

    @property
    def gid(self) -> bytes:
        """The hash of its token: 16 bytes, the lowest first."""
        return xxhash.xxh3_128_digest(self.token.encode())[::-1]

    @property
    def key(self) -> str:
        """The key of its topic or service."""
        return key_of(self.domain, self.name, self.type_name, self.type_hash)


def read_token(token: str) -> Entity | None:
    """The entity that a token tells of; None if it is none of rmw_zenoh's."""
    parts = [part.replace("%", "/") for part in token.split("/")]
    kind = parts[5] if len(parts) >= _OF_NODE else ""
    if kind not in (NODE, PUBLISHER, SUBSCRIPTION, SERVICE, CLIENT):
        return None
    size = _OF_NODE if kind == NODE else _OF_ENDPOINT  # Lyrical adds more, which counts for no gid
    if len(parts) < size or parts[0] != _SPACE or not all(parts):
        return None
    _, domain, session, node_number, number, _, *names = parts[:size]
    try:
        qos = _DEFAULT_QOS if kind == NODE else read_qos(names.pop())
        numbers = int(node_number), int(number)
        entity = Entity(int(domain), session, *numbers, kind, *names)  # type: ignore[arg-type]
        return replace(entity, qos=qos)
    except ValueError:
        return None


def _mangled(name: str) -> str:
    return name.replace("/", "%")


def qos_text(qos: EndpointQos) -> str:
    """Reliability:durability:history,depth:deadline:lifespan:liveliness,lease; empty if default.

    >>> qos_text(EndpointQos(depth=7, reliability=EndpointQos.BEST_EFFORT, deadline=2_000_000_001))
    '2::,7:2,1:,:,,'
    """
    pairs = zip(_numbers(qos), _DEFAULTS, strict=True)
    return _QOS.format(*("" if number == default else number for number, default in pairs))


def read_qos(text: str) -> EndpointQos:
    """The policies in a token; raises ValueError where the text is none of `qos_text`'s."""
    parts = re.split("[:,]", text)
    pairs = zip(parts, _DEFAULTS, strict=True)
    numbers = [int(part) if part else default for part, default in pairs]
    if _QOS.format(*parts) != text:
        raise ValueError(text)

    def duration(first: int) -> int:
        seconds, nanoseconds = both = numbers[first], numbers[first + 1]
        return 0 if both == _INFINITE else seconds * 10**9 + nanoseconds

    reliability, durability, history, depth = numbers[:4]
    times = duration(4), duration(6), numbers[8], duration(9)
    return EndpointQos(reliability, durability, history, depth, *times)


def _numbers(qos: EndpointQos) -> list[int]:
    def duration(nanoseconds: int) -> tuple[int, int]:
        return divmod(nanoseconds, 10**9) if nanoseconds else _INFINITE

    deadline, lifespan = duration(qos.deadline), duration(qos.lifespan)
    lease = duration(qos.liveliness_lease_duration)
    policies = qos.reliability, qos.durability, qos.history, qos.depth
    return [*policies, *deadline, *lifespan, qos.liveliness, *lease]


_DEFAULTS = _numbers(_DEFAULT_QOS)
