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
from typing import Any

from us_sim.standalone import ddsc
from us_sim.standalone.ddsc import DdsError, check, guid_of, lib
from us_sim.standalone.dispatcher import Dispatcher
from us_sim.standalone.domain import DiscoveryRange, acquire_domain, release_domain
from us_sim.standalone.endpoint_event import EndpointEvent
from us_sim.standalone.endpoint_qos import EndpointQos, dds_qos, participant_qos, qos_of_profile
from us_sim.standalone.endpoints import Endpoint, Reader, SampleInfo, Writer

__all__ = ["DdsError", "EndpointEvent", "Participant", "Reader", "SampleInfo", "Writer"]


class Participant:
    """This process in a DDS domain; several may share a domain.

    ``graph`` tells what else is there (`us_sim.standalone.graph`).
    """

    def __init__(
        self, domain_id: int, enclave: str = "/", reach: DiscoveryRange | None = None
    ) -> None:
        """Join the domain, with the discovery range that the environment asks for by default.

        Raises:
            DdsError: the domain cannot be joined.
        """
        from us_sim.standalone.graph import Graph

        self.domain_id = domain_id
        self.enclave = enclave
        self._endpoints: set[Endpoint] = set()
        self._topics: dict[tuple[str, str], int] = {}
        self._lock = threading.Lock()
        self._closed = False
        acquire_domain(domain_id, reach or DiscoveryRange.from_environment())
        try:
            with participant_qos(f"enclave={enclave};") as qos:
                self._handle = check(
                    lib.dds_create_participant(domain_id, qos, None),
                    f"DDS domain {domain_id} cannot be joined; "
                    f"too many processes on this host may be in it",
                )
        except DdsError:
            release_domain(domain_id)
            raise
        self.gid = guid_of(self._handle)  # 16 bytes
        self._dispatcher = Dispatcher(self._handle)
        self.graph = Graph(self)
        _open_participants.add(self)

    def create_writer(self, dds_topic: str, dds_type: str, qos: Any, user_data: str = "") -> Writer:
        """A writer on a topic.

        Args:
            dds_topic: for example ``rt/us/image``.
            dds_type: for example ``sensor_msgs::msg::dds_::Image_``.
            qos: a QoSProfile of rclpy's, or an EndpointQos.
            user_data: for example ``typehash=RIHS01_…;``.

        Raises:
            DdsError: the topic or the quality of service is refused.
        """
        endpoint_qos = self._resolve(dds_topic, qos, is_writer=True)
        with self._lock, dds_qos(endpoint_qos, user_data) as handle:
            writer = check(
                lib.dds_create_writer(self._handle, self._topic(dds_topic, dds_type), handle, None),
                f"no writer can be made on {dds_topic!r}; check its quality of service",
            )
        return self._remember(Writer(self, writer, endpoint_qos))

    def create_reader(
        self,
        dds_topic: str,
        dds_type: str,
        qos: Any,
        user_data: str = "",
        ignore_own: bool = False,
    ) -> Reader:
        """A reader on a topic; arguments as for `create_writer`.

        Args:
            ignore_own: leave out what this participant's own writers write.
        """
        endpoint_qos = self._resolve(dds_topic, qos, is_writer=False)
        with self._lock, dds_qos(endpoint_qos, user_data, ignore_own) as handle:
            reader = check(
                lib.dds_create_reader(self._handle, self._topic(dds_topic, dds_type), handle, None),
                f"no reader can be made on {dds_topic!r}; check its quality of service",
            )
        return self._remember(Reader(self, reader, endpoint_qos))

    def close(self) -> None:
        """Leave the domain, ending every endpoint. Nothing is called back after this."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
        _open_participants.discard(self)
        self._silence()
        self.graph.close()
        for endpoint in list(self._endpoints):
            endpoint._end()
        lib.dds_delete(self._handle)
        release_domain(self.domain_id)

    def __enter__(self) -> Participant:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _silence(self) -> None:
        """Receive nothing more and end the thread that calls back."""
        for endpoint in list(self._endpoints):
            if isinstance(endpoint, Reader):
                endpoint._end()
        self._dispatcher.close()

    def _resolve(self, dds_topic: str, qos: Any, is_writer: bool) -> EndpointQos:
        if self._closed:
            raise DdsError(f"the participant is closed, so {dds_topic!r} cannot be joined")
        if isinstance(qos, EndpointQos):
            return qos
        opposite = [
            endpoint.qos
            for endpoint in self.graph.endpoints(dds_topic)
            if endpoint.is_writer != is_writer
        ]
        return qos_of_profile(qos, is_writer, opposite)

    def _topic(self, dds_topic: str, dds_type: str) -> int:
        key = (dds_topic, dds_type)
        if key not in self._topics:
            descriptor = ddsc.topic_descriptor(dds_type)
            self._topics[key] = check(
                lib.dds_create_topic(
                    self._handle, ct.byref(descriptor), dds_topic.encode(), None, None
                ),
                f"there can be no topic {dds_topic!r} of type {dds_type!r}",
            )
        return self._topics[key]

    def _remember(self, endpoint: Any) -> Any:
        self._endpoints.add(endpoint)
        return endpoint


_open_participants: weakref.WeakSet[Participant] = weakref.WeakSet()


@atexit.register
def _leave_all_domains() -> None:
    """Tell the others at once, instead of letting their leases on us run out (10 s)."""
    participants = list(_open_participants)
    for participant in participants:
        participant._silence()  # before any is gone, as callbacks may use all of them
    for participant in participants:
        participant.close()
