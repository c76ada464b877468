"""The middleware that carries messages, as `rclpy` sees it, and the choice between two of them.

Cyclone DDS (`cyclone`) or zenoh (`zenoh_session`), by RMW_IMPLEMENTATION as in ROS 2; where that is
not set, zenoh only if Cyclone's library is missing. Neither is imported before it is chosen.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import count
from typing import Any, ClassVar, NamedTuple, Protocol, Self

CYCLONE, ZENOH = "rmw_cyclonedds_cpp", "rmw_zenoh_cpp"

numbers = count(1)
"""Numbers for nodes and endpoints, each used once in a process."""


class MiddlewareError(Exception):
    """The middleware refuses a request."""


@dataclass(frozen=True)
class EndpointQos:
    """The policies of one endpoint, with the numbers that rclpy's enumerations have.

    A duration of 0 is "not specified", which is infinite, as in rmw.
    """

    RELIABLE: ClassVar[int] = 1
    BEST_EFFORT: ClassVar[int] = 2
    TRANSIENT_LOCAL: ClassVar[int] = 1
    VOLATILE: ClassVar[int] = 2
    KEEP_LAST: ClassVar[int] = 1
    KEEP_ALL: ClassVar[int] = 2
    AUTOMATIC: ClassVar[int] = 1
    MANUAL_BY_TOPIC: ClassVar[int] = 3

    reliability: int = RELIABLE
    durability: int = VOLATILE
    history: int = KEEP_LAST
    depth: int = 10
    deadline: int = 0  # ns
    lifespan: int = 0  # ns
    liveliness: int = AUTOMATIC
    liveliness_lease_duration: int = 0  # ns


UNSPECIFIED = (0, 2**63 - 1)  # ns; as durations both mean infinite

# The values of each policy that are not left to the middleware, its default first.
_KNOWN = {
    "reliability": (EndpointQos.RELIABLE, EndpointQos.BEST_EFFORT),
    "durability": (EndpointQos.VOLATILE, EndpointQos.TRANSIENT_LOCAL),
    "history": (EndpointQos.KEEP_LAST, EndpointQos.KEEP_ALL),
    "liveliness": (EndpointQos.AUTOMATIC, EndpointQos.MANUAL_BY_TOPIC),
}


def qos_of_profile(profile: Any, default_depth: int = 1) -> EndpointQos:
    """The policies to ask for, given rclpy's profile (or anything with its attributes).

    SYSTEM_DEFAULT is reliable, volatile, keep last ``default_depth`` and automatic.

    Raises:
        MiddlewareError: a policy is UNKNOWN or BEST_AVAILABLE, or the depth is negative.
    """
    depth = int(profile.depth)
    if depth < 0:
        raise MiddlewareError(f"a history depth of {depth} cannot be kept; give at least 1")
    policies = {}
    for name, known in _KNOWN.items():
        policies[name] = int(getattr(profile, name)) or known[0]
        if policies[name] not in known:
            raise MiddlewareError(
                f"the {name} policy {getattr(profile, name)!r} cannot be asked for; choose one "
                f"that says what this endpoint needs"
            )
    for name in ("deadline", "lifespan", "liveliness_lease_duration"):
        value = getattr(profile, name)
        duration = int(getattr(value, "nanoseconds", value))
        policies[name] = 0 if duration in UNSPECIFIED else duration
    return EndpointQos(depth=depth or default_depth, **policies)


_RANGES = ("SUBNET", "LOCALHOST", "OFF", "SYSTEM_DEFAULT")


@dataclass(frozen=True)
class DiscoveryRange:
    """Where other processes are looked for."""

    name: str = "SUBNET"  # or LOCALHOST, OFF, SYSTEM_DEFAULT
    static_peers: tuple[str, ...] = ()  # addresses that are asked in addition

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] = os.environ) -> Self:
        """The range that the environment asks for; SUBNET by default.

        Raises:
            MiddlewareError: ROS_AUTOMATIC_DISCOVERY_RANGE has another value.
        """
        name = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE") or "SUBNET"
        if environment.get("ROS_LOCALHOST_ONLY") == "1":
            name = "LOCALHOST"
        if name not in _RANGES:
            raise MiddlewareError(
                f"ROS_AUTOMATIC_DISCOVERY_RANGE is {name!r}; set it to one of {', '.join(_RANGES)}"
            )
        peers = environment.get("ROS_STATIC_PEERS", "").split(";")
        return cls(name, tuple(peer.strip() for peer in peers if peer.strip()))


def loopback_fault() -> str:
    """A sentence on what is wrong with this computer's loopback interface; empty if nothing is."""
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            probe.connect(("127.0.0.1", 9))
    except OSError as error:
        return (
            f"this computer's loopback interface has no IPv4 ({error.strerror}): give it the "
            f"address 127.0.0.1/8 and bring it up"
        )
    return ""


class SampleInfo(NamedTuple):
    source_timestamp: int  # ns since 1970, when it was written, by the writer's clock
    received_timestamp: int  # ns since 1970, when it was taken here
    publication_handle: int  # this process's number for the writer; 0 where it has none
    sequence: int | None = None  # the sample's number among its writer's, where it is told


class RequestHeader(NamedTuple):
    """Which request of which client, and when."""

    client: Any  # the client's number or gid
    sequence: int  # the request's number
    info: SampleInfo


class Owner(NamedTuple):
    """The node that an endpoint belongs to."""

    number: int
    namespace: str
    name: str


@dataclass(frozen=True)
class GraphEndpoint:
    """A reader or writer in the domain, this process's included."""

    topic: str  # DDS name (``rt/us/image``), like the type's (``sensor_msgs::msg::dds_::Image_``)
    type_name: str
    is_writer: bool
    qos: EndpointQos
    gid: bytes  # 16 bytes, like the participant's
    participant: bytes
    user_data: dict[str, str]  # such as ``typehash``, ``serviceid`` and ``clientid``


@dataclass(frozen=True)
class GraphNode:
    """A ROS node and the gids of its endpoints."""

    namespace: str
    name: str
    reader_gids: tuple[bytes, ...] = ()
    writer_gids: tuple[bytes, ...] = ()
    participant: bytes = b""  # its gid; filled in for nodes that are announced
    number: int = 0  # its owner's, in the process that it is of


class Middleware(Protocol):
    """One context's place in the graph of a domain.

    The arguments of the four ``create_`` methods are the node that the endpoint is of, the absolute
    ROS name, the ROS type (``sensor_msgs/msg/Image``), and rclpy's QoSProfile. They return
    endpoints, all with ``close`` and ``gids`` (of readers and of writers): publishers ``write``
    (False if the sample was dropped); the others ``take`` (bytes and their origin, or None) and
    call back after ``set_on_data``, from another thread; publishers and subscriptions tell their
    ``matched_count``; clients ``send_request`` and say ``service_is_ready``; services
    ``send_response``, and say ``on_unanswered`` why a request will not be answered.

    Raises:
        MiddlewareError: a name or a quality of service is refused.
    """

    def create_publisher(
        self, owner: Owner, topic: str, kind: str, qos: Any, on_incompatible: Callable[[str], None]
    ) -> Any: ...

    def create_subscription(
        self, owner: Owner, topic: str, kind: str, qos: Any, on_incompatible: Callable[[str], None]
    ) -> Any: ...

    def create_client(self, owner: Owner, service: str, kind: str, qos: Any) -> Any: ...

    def create_service(self, owner: Owner, service: str, kind: str, qos: Any) -> Any: ...

    def announce(self, nodes: Iterable[GraphNode]) -> None:
        """Tell others which nodes this context has, and with which endpoints."""

    def nodes(self) -> list[GraphNode]:
        """All nodes: this context's first, then the others'."""

    def endpoints(self, topic: str | None = None) -> list[GraphEndpoint]:
        """All readers and writers, or those on one DDS topic."""

    def close(self) -> None:
        """Leave the domain, ending every endpoint. Nothing is called back after this."""


def connect(domain_id: int, enclave: str) -> Middleware:
    """Join a domain through the middleware that RMW_IMPLEMENTATION names.

    Raises:
        MiddlewareError: it is none of those known here, is not installed, or cannot be joined.
    """
    if implementation() == ZENOH:
        from .zenoh_session import Zenoh

        return Zenoh(domain_id, enclave)
    from .cyclone import Cyclone

    return Cyclone(domain_id, enclave)


def implementation(environment: Mapping[str, str] = os.environ) -> str:
    """The name of the middleware: RMW_IMPLEMENTATION, or else the one that is installed.

    Raises:
        MiddlewareError: the name is not known here, or nothing is installed.
    """
    name = environment.get("RMW_IMPLEMENTATION", "")
    if name and name not in (CYCLONE, ZENOH):
        raise MiddlewareError(
            f"RMW_IMPLEMENTATION is {name!r}, but without ROS 2 there are only {CYCLONE} and "
            f"{ZENOH}; set it to one of them"
        )
    missing = {}
    for each in [name] if name else [CYCLONE, ZENOH]:
        try:
            _import(each)
        except MiddlewareError as error:
            missing[each] = error
        else:
            return each
    raise MiddlewareError("; ".join(map(str, missing.values())))


def _import(name: str) -> None:
    if name == CYCLONE:
        from . import ddsc  # noqa: F401

        return
    try:
        import xxhash  # noqa: F401
        import zenoh  # noqa: F401
    except ImportError as error:
        raise MiddlewareError(
            f"zenoh cannot be used ({error}): run pip install eclipse-zenoh xxhash"
        ) from error
