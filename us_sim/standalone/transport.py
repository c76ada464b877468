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
import time
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from us_sim.standalone import ddsc
from us_sim.standalone.ddsc import DdsError, IoVector, RawSampleInfo, check, guid_of, lib
from us_sim.standalone.dispatcher import Dispatcher
from us_sim.standalone.domain import DiscoveryRange, acquire_domain, release_domain
from us_sim.standalone.endpoint_event import EndpointEvent, read_events, status_mask
from us_sim.standalone.endpoint_qos import (
    EndpointQos,
    dds_qos,
    participant_qos,
    qos_of_profile,
    user_data,
)

__all__ = ["DdsError", "EndpointEvent", "Participant", "Reader", "SampleInfo", "Writer"]

_DATA_AVAILABLE = 1 << 8


@dataclass(frozen=True)
class SampleInfo:
    """Where a sample came from.

    Attributes:
        source_timestamp: ns since 1970, when it was written, by the writer's clock.
        received_timestamp: ns since 1970, when it was taken here.
        publication_handle: this process's number for the writer.
    """

    source_timestamp: int
    received_timestamp: int
    publication_handle: int


class _Endpoint:
    """What readers and writers have in common."""

    _side: str  # the other side, as the C functions call it: publication or subscription

    def __init__(self, participant: Participant, handle: int, qos: EndpointQos) -> None:
        self._participant = participant
        self._handle = handle
        self._closed = False
        self.qos = qos
        self.gid = guid_of(handle)  # 16 bytes
        self._on_event: Callable[[EndpointEvent], None] | None = None
        self._token = participant._dispatcher.attach(handle, self._mask(), self._status_changed)

    @property
    def on_event(self) -> Callable[[EndpointEvent], None] | None:
        """Called with each `EndpointEvent`, also with those from before it was set."""
        return self._on_event

    @on_event.setter
    def on_event(self, callback: Callable[[EndpointEvent], None] | None) -> None:
        self._on_event = callback
        if not self._closed:
            check(lib.dds_set_status_mask(self._handle, self._mask()), "the endpoint is closed")
            self._participant._dispatcher.call_soon(self._status_changed)

    def matched_count(self) -> int:
        """How many endpoints are connected to this one."""
        return max(0, self._matched(None, 0))

    def matched_user_data(self) -> list[dict[str, str]]:
        """The USER_DATA of each endpoint that is connected to this one."""
        handles = (ct.c_uint64 * (self.matched_count() + 8))()
        found = self._matched(handles, len(handles))
        data = [
            self._user_data_of(handle) for handle in handles[: min(max(found, 0), len(handles))]
        ]
        return [entry for entry in data if entry is not None]

    def close(self) -> None:
        """Leave the topic. Callbacks that are running may end after this."""
        if not self._closed:
            self._closed = True
            self._participant._dispatcher.detach(self._token)
            self._participant._endpoints.discard(self)
            lib.dds_delete(self._handle)

    def _matched(self, handles: Any, size: int) -> int:
        return getattr(lib, f"dds_get_matched_{self._side}s")(self._handle, handles, size)

    def _user_data_of(self, handle: int) -> dict[str, str] | None:
        endpoint = getattr(lib, f"dds_get_matched_{self._side}_data")(self._handle, handle)
        if not endpoint:
            return None
        try:
            return user_data(endpoint.contents.qos)
        finally:
            lib.dds_builtintopic_free_endpoint(endpoint)

    def _mask(self) -> int:
        # Statuses that nobody asks for are left alone, so that who asks later still learns of them.
        return 0 if self._on_event is None else status_mask(self._side)

    def _status_changed(self) -> None:
        status = ct.c_uint32()
        if self._closed or lib.dds_take_status(self._handle, ct.byref(status), self._mask()) < 0:
            return
        self._notify(status.value)

    def _notify(self, status: int) -> None:
        callback = self._on_event
        if callback is not None:
            for event in read_events(self._handle, self._side, status):
                callback(event)


class Writer(_Endpoint):
    """Publishes serialized samples.

    ``on_event`` may be set to a function of an `EndpointEvent`, which another thread calls.
    """

    _side = "subscription"

    def __init__(self, participant: Participant, handle: int, qos: EndpointQos) -> None:
        super().__init__(participant, handle, qos)
        sertype = ct.c_void_p()
        check(lib.dds_get_entity_sertype(handle, ct.byref(sertype)), "the writer has no type")
        self._sertype = sertype

    def write(self, data: bytes | bytearray | memoryview) -> bool:
        """Send one sample: a four-byte CDR header and at least one byte.

        Returns:
            False if a reliable reader kept the writer waiting for 0.1 s, so that the sample was
            not accepted.

        Raises:
            DdsError: the writer is closed, or the bytes are no sample.
        """
        return self.write_parts(data)

    def write_parts(self, *parts: bytes | bytearray | memoryview) -> bool:
        """Send one sample that is the parts put together; the first holds the CDR header."""
        whole = [bytes(part) for part in parts]
        size = sum(map(len, whole))
        padding = -size % 4  # RTPS wants samples in multiples of four; the header says how many
        if padding:
            whole[0] = whole[0][:3] + bytes([padding]) + whole[0][4:]
            whole.append(bytes(padding))
        vectors = (IoVector * len(whole))(
            *(IoVector(ct.cast(ct.c_char_p(part), ct.c_void_p), len(part)) for part in whole)
        )
        if self._closed:
            raise DdsError("the writer is closed, so nothing can be published with it")
        serialized = lib.ddsi_serdata_from_ser_iov(
            self._sertype, ddsc.SAMPLE_OF_DATA, len(whole), vectors, size + padding
        )
        if not serialized:
            raise DdsError(f"{size} bytes are not a sample; serialize the message first")
        returned = lib.dds_writecdr(self._handle, serialized)
        if returned == ddsc.RETURN_TIMEOUT:
            return False
        check(returned, "a sample cannot be written; the writer may have been closed")
        return True

    def wait_for_acked(self, timeout: float) -> bool:
        """Whether all readers had acknowledged all samples within ``timeout`` seconds."""
        duration = ddsc.INFINITY if timeout < 0 else int(timeout * 1e9)
        returned = lib.dds_wait_for_acks(self._handle, duration)
        if returned == ddsc.RETURN_TIMEOUT:
            return False
        check(returned, "nothing can be acknowledged to a closed writer")
        return True

    def assert_liveliness(self) -> None:
        """Say that this writer is alive, where its liveliness is MANUAL_BY_TOPIC."""
        check(lib.dds_assert_liveliness(self._handle), "the writer is closed")


class Reader(_Endpoint):
    """Receives serialized samples.

    ``on_data`` may be set to a function without arguments that is called, from another thread,
    when samples may be waiting; ``on_event`` as for writers.
    """

    _side = "publication"

    def __init__(self, participant: Participant, handle: int, qos: EndpointQos) -> None:
        self._on_data: Callable[[], None] | None = None
        super().__init__(participant, handle, qos)

    @property
    def on_data(self) -> Callable[[], None] | None:
        """Called when data may be waiting, and once after it was set."""
        return self._on_data

    @on_data.setter
    def on_data(self, callback: Callable[[], None] | None) -> None:
        self._on_data = callback
        if callback is not None:
            self._participant._dispatcher.call_soon(callback)

    def take(self) -> tuple[bytes, SampleInfo] | None:
        """The oldest sample that is waiting, removed from the reader; None if there is none."""
        serialized, info = ct.c_void_p(), RawSampleInfo()
        while not self._closed:
            taken = lib.dds_takecdr(
                self._handle, ct.byref(serialized), 1, ct.byref(info), ddsc.ANY_STATE
            )
            if taken <= 0:
                return None
            if not info.valid_data:
                lib.ddsi_serdata_unref(serialized)
                continue
            data = _bytes_of(serialized)
            lib.ddsi_serdata_unref(serialized)
            return data, SampleInfo(info.source_timestamp, time.time_ns(), info.publication_handle)
        return None

    def user_data_of(self, publication_handle: int) -> dict[str, str] | None:
        """The USER_DATA of a writer that is connected to this reader; None if it has gone."""
        return self._user_data_of(publication_handle)

    def _mask(self) -> int:
        return super()._mask() | _DATA_AVAILABLE

    def _notify(self, status: int) -> None:
        callback = self._on_data
        if status & _DATA_AVAILABLE and callback is not None:
            callback()
        super()._notify(status)


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
        self._endpoints: set[_Endpoint] = set()
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
            endpoint._closed = True
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
                endpoint._closed = True
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


def _bytes_of(serialized: ct.c_void_p) -> bytes:
    """The sample's bytes, without the padding that its header admits to."""
    vector = IoVector()
    size = lib.ddsi_serdata_size(serialized)
    reference = lib.ddsi_serdata_to_ser_ref(serialized, 0, size, ct.byref(vector))
    data = ct.string_at(vector.base, vector.length)
    lib.ddsi_serdata_to_ser_unref(reference, ct.byref(vector))
    padding = data[3] & 3
    if padding:
        return data[:2] + b"\x00\x00" + data[4 : len(data) - padding]
    return data
