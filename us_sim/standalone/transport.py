"""Serialized samples over DDS, as ROS 2's Cyclone DDS middleware exchanges them.

Topics and types have their DDS names here (``rt/us/image``, ``sensor_msgs::msg::dds_::Image_``),
and samples are the bytes of `us_sim.standalone.cdr`.

>>> from us_sim.standalone.domain import DiscoveryRange
>>> from us_sim.standalone.endpoint_qos import EndpointQos
>>> from us_sim.standalone.transport import Participant
>>> with Participant(domain_id=87, reach=DiscoveryRange("OFF")) as participant:
...     topic = ("rt/depth", "std_msgs::msg::dds_::Float32_", EndpointQos())
...     reader, writer = participant.create_reader(*topic), participant.create_writer(*topic)
...     accepted = writer.write(bytes.fromhex("00010000 0000803f"))
...     data, info = reader.take()
>>> accepted, data.hex()
(True, '000100000000803f')
"""

from __future__ import annotations

import atexit
import ctypes as ct
import threading
import weakref
from collections.abc import Callable
from typing import Any

from . import ddsc
from .ddsc import DdsError, check, guid_of, lib
from .dispatcher import Dispatcher
from .domain import DiscoveryRange, acquire_domain, release_domain
from .endpoint_qos import EndpointQos, dds_qos, participant_qos, qos_of_profile
from .endpoints import Endpoint, Reader, SampleInfo, Writer

__all__ = ["DdsError", "Participant", "Reader", "SampleInfo", "Writer"]


class Participant:
    """This process in a DDS domain; several may share a domain.

    What else is there, `graph.Graph` tells.
    """

    def __init__(
        self, domain_id: int, enclave: str = "/", reach: DiscoveryRange | None = None
    ) -> None:
        """Join the domain, with the discovery range that the environment asks for by default.

        Raises:
            DdsError: the domain cannot be joined.
        """
        self.domain_id = domain_id
        self.enclave = enclave
        self._endpoints: weakref.WeakSet[Endpoint] = weakref.WeakSet()
        self._topics: dict[tuple[str, str], int] = {}
        self._lock = threading.Lock()
        self._closed = False
        acquire_domain(domain_id, reach or DiscoveryRange.from_environment())
        try:
            with participant_qos(f"enclave={enclave};") as qos:
                self.handle = check(
                    lib.dds_create_participant(domain_id, qos, None),
                    f"DDS domain {domain_id} cannot be joined; "
                    f"too many processes on this host may be in it",
                )
        except DdsError:
            release_domain(domain_id)
            raise
        self.gid = guid_of(self.handle)  # 16 bytes
        self.dispatcher = Dispatcher(self.handle)
        _open_participants.add(self)

    def create_writer(self, *arguments: Any, **options: Any) -> Writer:
        """A writer on a topic; arguments as for `create_reader`, except for ``ignore_own``."""
        return self._create(Writer, *arguments, **options)

    def create_reader(self, *arguments: Any, **options: Any) -> Reader:
        """A reader on a topic.

        Args:
            dds_topic: for example ``rt/us/image``.
            dds_type: for example ``sensor_msgs::msg::dds_::Image_``.
            qos: a QoSProfile of rclpy's, or an EndpointQos.
            user_data: for example ``typehash=RIHS01_…;``.
            on_incompatible: called with the name of the policy by which the other side was refused.
            ignore_own: leave out what this participant's own writers write.

        Raises:
            DdsError: the topic or the quality of service is refused.
        """
        return self._create(Reader, *arguments, **options)

    def _create(
        self,
        cls: type[Endpoint],
        dds_topic: str,
        dds_type: str,
        qos: Any,
        user_data: str = "",
        on_incompatible: Callable[[str], None] | None = None,
        ignore_own: bool = False,
    ) -> Any:
        if self._closed:
            raise DdsError(f"the participant is closed, so {dds_topic!r} cannot be joined")
        policies = qos if isinstance(qos, EndpointQos) else qos_of_profile(qos)
        kind = cls.__name__.lower()
        create = getattr(lib, f"dds_create_{kind}")
        with self._lock, dds_qos(policies, user_data, ignore_own) as dds_policies:
            handle = check(
                create(self.handle, self._topic(dds_topic, dds_type), dds_policies, None),
                f"no {kind} can be made on {dds_topic!r}; check its quality of service",
            )
        endpoint = cls(self.dispatcher, handle, policies, on_incompatible)
        self._endpoints.add(endpoint)
        return endpoint

    def close(self) -> None:
        """Leave the domain, ending every endpoint. Nothing is called back after this."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
        _open_participants.discard(self)
        self._silence()
        for endpoint in list(self._endpoints):
            endpoint.end()
        lib.dds_delete(self.handle)
        release_domain(self.domain_id)

    def __enter__(self) -> Participant:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _silence(self) -> None:
        """Receive nothing more and end the thread that calls back."""
        for endpoint in list(self._endpoints):
            if isinstance(endpoint, Reader):
                endpoint.end()
        self.dispatcher.close()

    def _topic(self, dds_topic: str, dds_type: str) -> int:
        key = (dds_topic, dds_type)
        if key not in self._topics:
            descriptor = ddsc.topic_descriptor(dds_type)
            self._topics[key] = check(
                lib.dds_create_topic(
                    self.handle, ct.byref(descriptor), dds_topic.encode(), None, None
                ),
                f"there can be no topic {dds_topic!r} of type {dds_type!r}",
            )
        return self._topics[key]


_open_participants: weakref.WeakSet[Participant] = weakref.WeakSet()


@atexit.register
def _leave_all_domains() -> None:
    """Tell the others at once, instead of letting their leases on us run out (10 s)."""
    participants = list(_open_participants)
    for participant in participants:
        participant._silence()  # before any is gone, as callbacks may use all of them
    for participant in participants:
        participant.close()
