"""Which hosts a DDS domain reaches, and domains shared by the participants of one process.

Jazzy's environment decides: ROS_AUTOMATIC_DISCOVERY_RANGE (SUBNET, LOCALHOST, OFF or
SYSTEM_DEFAULT), ROS_STATIC_PEERS, and CYCLONEDDS_URI, which is applied last.

>>> from us_sim.standalone.domain import DiscoveryRange
>>> DiscoveryRange.from_environment({"ROS_STATIC_PEERS": "10.0.0.5;pc2"})
DiscoveryRange(name='SUBNET', static_peers=('10.0.0.5', 'pc2'))
"""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from html import escape

from .ddsc import DdsError, check, lib

_RANGES = ("SUBNET", "LOCALHOST", "OFF", "SYSTEM_DEFAULT")

# The largest participant index tried on a host: the number of processes that find each other
# without multicast, and the number of packets that announce one.
_MOST_PARTICIPANTS = 64

# A writer blocks once this much is not acknowledged; Cyclone's own 500 kB are two images.
_UNACKNOWLEDGED = "32 MB"
_SOCKET_BUFFER = "8 MB"

# How long a writer that is closed waits for a reader that acknowledges nothing. Cyclone's own 1 s
# for each writer would keep a process from ending after a peer hung or was killed.
_LINGER = "100 ms"


@dataclass(frozen=True)
class DiscoveryRange:
    """Where other participants are looked for."""

    name: str = "SUBNET"  # or LOCALHOST, OFF, SYSTEM_DEFAULT
    static_peers: tuple[str, ...] = ()  # addresses that are asked in addition

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] = os.environ) -> DiscoveryRange:
        """What the environment asks for; SUBNET if nothing.

        Raises:
            DdsError: ROS_AUTOMATIC_DISCOVERY_RANGE has another value.
        """
        name = environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE") or "SUBNET"
        if environment.get("ROS_LOCALHOST_ONLY") == "1":
            name = "LOCALHOST"
        if name not in _RANGES:
            raise DdsError(
                f"ROS_AUTOMATIC_DISCOVERY_RANGE is {name!r}; set it to one of {', '.join(_RANGES)}"
            )
        peers = environment.get("ROS_STATIC_PEERS", "").split(";")
        return cls(name, tuple(peer.strip() for peer in peers if peer.strip()))

    def configuration(self) -> str:
        """Cyclone DDS's XML for this range."""
        general = discovery = ""
        peers = list(self.static_peers)
        if self.name == "LOCALHOST":
            # Cyclone drops what arrives on the loopback interface unless it is told to use it.
            # There, datagrams of 64 KiB are safe and save most of the work on an image.
            general += (
                "<Interfaces><NetworkInterface address='127.0.0.1' multicast='false'/></Interfaces>"
                "<MaxMessageSize>65500B</MaxMessageSize><FragmentSize>65000B</FragmentSize>"
            )
            peers.insert(0, "localhost")
        if self.name in ("LOCALHOST", "OFF"):
            general += "<AllowMulticast>false</AllowMulticast>"
        if self.name == "OFF":
            # Nobody else has this tag, so nobody is found even on the same host.
            tag = f"ros_discovery_off_{os.getpid()}"
            discovery += f"<ParticipantIndex>none</ParticipantIndex><Tag>{tag}</Tag>"
        elif self.name != "SYSTEM_DEFAULT":
            discovery += (
                "<ParticipantIndex>auto</ParticipantIndex>"
                f"<MaxAutoParticipantIndex>{_MOST_PARTICIPANTS}</MaxAutoParticipantIndex>"
            )
        if peers and self.name in ("LOCALHOST", "SUBNET"):
            addresses = "".join(f"<Peer address='{escape(peer)}'/>" for peer in peers)
            discovery += f"<Peers>{addresses}</Peers>"
        return (
            f"<CycloneDDS><Domain><General>{general}</General><Discovery>{discovery}</Discovery>"
            f"<Internal><SocketReceiveBufferSize max='{_SOCKET_BUFFER}'/>"
            f"<Watermarks><WhcHigh>{_UNACKNOWLEDGED}</WhcHigh></Watermarks>"
            f"<WriterLingerDuration>{_LINGER}</WriterLingerDuration></Internal>"
            "</Domain></CycloneDDS>"
        )


@dataclass
class _Domain:
    handle: int
    reach: DiscoveryRange
    users: int = 1


_domains: dict[int, _Domain] = {}
_lock = threading.Lock()


def acquire_domain(domain_id: int, reach: DiscoveryRange) -> None:
    """Configure the domain if this process has no participant in it yet.

    Raises:
        DdsError: the number is none, or this process is in the domain with another range.
    """
    if not 0 <= domain_id <= 232:
        raise DdsError(f"the domain id {domain_id} is not one of 0 to 232; set ROS_DOMAIN_ID")
    with _lock:
        domain = _domains.get(domain_id)
        if domain is None:
            configuration = f"{reach.configuration()},{os.environ.get('CYCLONEDDS_URI', '')}"
            handle = check(
                lib.dds_create_domain(domain_id, configuration.encode()),
                f"DDS domain {domain_id} cannot be set up; {_what_to_check()}",
            )
            _domains[domain_id] = _Domain(handle, reach)
        elif domain.reach != reach:
            raise DdsError(
                f"this process is in domain {domain_id} with discovery range {domain.reach.name}, "
                f"so another of its contexts cannot have {reach.name} there"
            )
        else:
            domain.users += 1


def _what_to_check() -> str:
    """What may keep DDS from being set up here."""
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            probe.connect(("127.0.0.1", 9))
    except OSError as error:
        return (
            f"this computer's loopback interface has no IPv4 ({error.strerror}): give it the "
            f"address 127.0.0.1/8 and bring it up"
        )
    return "check CYCLONEDDS_URI if it is set"


def release_domain(domain_id: int) -> None:
    """Undo one `acquire_domain`; the last one ends the domain."""
    with _lock:
        domain = _domains[domain_id]
        domain.users -= 1
        if not domain.users:
            del _domains[domain_id]
            lib.dds_delete(domain.handle)
