"""Serialized samples over DDS, as ROS 2's Cyclone DDS middleware exchanges them.

Topics and types have their DDS names here (``rt/us/image``, ``sensor_msgs::msg::dds_::Image_``),
and samples are the bytes of `us_sim.standalone.cdr`. The hosts that a domain reaches are set by
Jazzy's environment: ROS_AUTOMATIC_DISCOVERY_RANGE (SUBNET, LOCALHOST, OFF or SYSTEM_DEFAULT),
ROS_STATIC_PEERS, and CYCLONEDDS_URI, which is applied last.

>>> from us_sim.standalone.middleware import EndpointQos
>>> from us_sim.standalone.transport import DiscoveryRange, Participant
>>> DiscoveryRange.from_environment({"ROS_STATIC_PEERS": "10.0.0.5;pc2"})
DiscoveryRange(name='SUBNET', static_peers=('10.0.0.5', 'pc2'))
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
import logging
import os
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from html import escape
from itertools import count
from typing import Any

from . import ddsc, middleware
from .ddsc import (
    INFINITY,
    DdsError,
    IoVector,
    RawSampleInfo,
    check,
    dds_qos,
    guid_of,
    lib,
    participant_qos,
    user_data,
)
from .middleware import EndpointQos, SampleInfo, qos_of_profile


class DiscoveryRange(middleware.DiscoveryRange):
    """Where other participants are looked for, and how Cyclone DDS is told so."""

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
            # The largest index tried on a host: the number of processes that find each other
            # without multicast, and the number of packets that announce one.
            discovery += (
                "<ParticipantIndex>auto</ParticipantIndex>"
                "<MaxAutoParticipantIndex>64</MaxAutoParticipantIndex>"
            )
        if peers and self.name in ("LOCALHOST", "SUBNET"):
            addresses = "".join(f"<Peer address='{escape(peer)}'/>" for peer in peers)
            discovery += f"<Peers>{addresses}</Peers>"
        # A writer blocks once WhcHigh is not acknowledged; Cyclone's own 500 kB are two images.
        # A writer that is closed waits for a reader that acknowledges nothing; Cyclone's own 1 s
        # for each would keep a process from ending after a peer hung or was killed.
        return (
            f"<CycloneDDS><Domain><General>{general}</General><Discovery>{discovery}</Discovery>"
            "<Internal><SocketReceiveBufferSize max='8 MB'/>"
            "<Watermarks><WhcHigh>32 MB</WhcHigh></Watermarks>"
            "<WriterLingerDuration>100 ms</WriterLingerDuration></Internal>"
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
            hint = middleware.loopback_fault() or "check CYCLONEDDS_URI if it is set"
            configuration = f"{reach.configuration()},{os.environ.get('CYCLONEDDS_URI', '')}"
            handle = check(
                lib.dds_create_domain(domain_id, configuration.encode()),
                f"DDS domain {domain_id} cannot be set up; {hint}",
            )
            _domains[domain_id] = _Domain(handle, reach)
        elif domain.reach != reach:
            raise DdsError(
                f"this process is in domain {domain_id} with discovery range {domain.reach.name}, "
                f"so another of its contexts cannot have {reach.name} there"
            )
        else:
            domain.users += 1


def release_domain(domain_id: int) -> None:
    with _lock:
        domain = _domains[domain_id]
        domain.users -= 1
        if not domain.users:
            del _domains[domain_id]
            lib.dds_delete(domain.handle)


_WAKE_UP = 0  # the token of the guard condition


class Dispatcher:
    """Calls the handlers of entities whose status changed, always from its own thread.

    A Cyclone listener would run Python on the thread that receives for the whole process, and stall
    it whenever the interpreter's lock is held elsewhere. A wait set costs one more thread switch
    (some 30 µs) and leaves DDS alone; at exit the thread is blocked in C and ends with the
    process.
    """

    def __init__(self, participant: int) -> None:
        """Start waiting; ``participant`` is the C handle of the DDS participant."""
        self._waitset = check(lib.dds_create_waitset(participant), "no wait set can be made")
        self._wake_up = check(
            lib.dds_create_guardcondition(participant), "no condition can be made"
        )
        lib.dds_waitset_attach(self._waitset, self._wake_up, _WAKE_UP)
        self._closed = False
        self._soon: deque[Callable[[], None]] = deque()
        self._tokens = count(_WAKE_UP + 1)
        self._handlers: dict[int, Callable[[], None]] = {}
        self._thread = threading.Thread(target=self._run, name="DDS dispatcher", daemon=True)
        self._thread.start()

    def attach(self, entity: int, status_mask: int, handler: Callable[[], None]) -> int:
        """Call ``handler`` whenever one of these status bits is set; returns a token."""
        token = next(self._tokens)
        self._handlers[token] = handler
        check(lib.dds_set_status_mask(entity, status_mask), "the endpoint is closed")
        check(lib.dds_waitset_attach(self._waitset, entity, token), "the endpoint is closed")
        return token

    def detach(self, token: int) -> None:
        """Call this token's handler no more (deleting the entity ends the waiting for it)."""
        self._handlers.pop(token, None)

    def call_soon(self, handler: Callable[[], None]) -> None:
        self._soon.append(handler)
        lib.dds_set_guardcondition(self._wake_up, True)

    def close(self) -> None:
        """End the thread, giving the handler that it may be in a second to finish."""
        self._closed = True
        lib.dds_set_guardcondition(self._wake_up, True)
        if threading.current_thread() is not self._thread:
            # Not for ever: the handler may wait for a lock that the caller holds.
            self._thread.join(timeout=1.0)

    def _run(self) -> None:
        tokens = (ct.c_ssize_t * 64)()
        was_set = ct.c_bool()
        while not self._closed:
            triggered = lib.dds_waitset_wait(self._waitset, tokens, len(tokens), INFINITY)
            if triggered < 0:
                return
            for token in tokens[: min(triggered, len(tokens))]:
                if token != _WAKE_UP:
                    self._call(self._handlers.get(token))
                    continue
                lib.dds_take_guardcondition(self._wake_up, ct.byref(was_set))
                while self._soon:
                    self._call(self._soon.popleft())

    def _call(self, handler: Callable[[], None] | None) -> None:
        if handler is None or self._closed:
            return
        try:
            handler()
        except Exception:
            logging.getLogger(__name__).exception("a callback of the transport failed")


_DATA_AVAILABLE = 1 << 8

# The policies by DDS's numbers (dds_qos_policy_id), with the names that rclpy has for them.
_POLICIES = {
    2: "DURABILITY",
    4: "DEADLINE",
    8: "LIVELINESS",
    11: "RELIABILITY",
    13: "HISTORY",
    21: "LIFESPAN",
}


class _IncompatibleQos(ct.Structure):
    """dds_offered_incompatible_qos_status_t, and the same for requested ones"""

    _fields_ = (
        ("total_count", ct.c_uint32),
        ("total_count_change", ct.c_int32),
        ("last_policy", ct.c_uint32),
    )


class Endpoint:
    """Base of readers and writers.

    ``on_incompatible`` is called, from another thread, with the name of the policy by which an
    endpoint on the other side was refused (``RELIABILITY``).
    """

    _side: str  # the other side, as the C functions call it: publication or subscription
    _incompatible: tuple[int, str]  # the status's bit, and the first word of the C function

    def __init__(
        self,
        dispatcher: Dispatcher,
        handle: int,
        qos: EndpointQos,
        on_incompatible: Callable[[str], None] | None = None,
    ) -> None:
        self._dispatcher = dispatcher
        self._handle = handle
        self._closed = False
        # Held while samples are in Python's hands: their memory belongs to the domain.
        self._in_use = threading.Lock()
        self.qos = qos
        self.gid = guid_of(handle)  # 16 bytes
        self.gids = ([self.gid], []) if isinstance(self, Reader) else ([], [self.gid])
        self._on_incompatible = on_incompatible
        self._mask = self._incompatible[0] | _DATA_AVAILABLE * isinstance(self, Reader)
        self._token = dispatcher.attach(handle, self._mask, self._status_changed)
        self._status_changed()  # changes before it was attached are not told again

    def matched_count(self) -> int:
        return max(0, self._matched(None, 0))

    def matched_user_data(self) -> list[dict[str, str]]:
        """The USER_DATA of each endpoint that is connected to this one."""
        handles = (ct.c_uint64 * (self.matched_count() + 8))()
        found = self._matched(handles, len(handles))
        data = map(self.user_data_of, handles[: min(max(found, 0), len(handles))])
        return [entry for entry in data if entry is not None]

    def close(self) -> None:
        """Leave the topic. Callbacks that are running may end after this."""
        if self.end():
            self._dispatcher.detach(self._token)
            lib.dds_delete(self._handle)

    def end(self) -> bool:
        """Neither give nor take samples any more; False if that was so already."""
        with self._in_use:
            was_open, self._closed = not self._closed, True
        return was_open

    def instance_handle(self) -> int:
        """64 bits that no other endpoint has."""
        handle = ct.c_uint64()
        check(lib.dds_get_instance_handle(self._handle, ct.byref(handle)), "the endpoint is closed")
        return handle.value

    def _matched(self, handles: Any, size: int) -> int:
        return getattr(lib, f"dds_get_matched_{self._side}s")(self._handle, handles, size)

    def user_data_of(self, handle: int) -> dict[str, str] | None:
        """The USER_DATA of an endpoint that is connected to this one; None if it has gone."""
        endpoint = getattr(lib, f"dds_get_matched_{self._side}_data")(self._handle, handle)
        if not endpoint:
            return None
        try:
            return user_data(endpoint.contents.qos)
        finally:
            lib.dds_builtintopic_free_endpoint(endpoint)

    def _status_changed(self) -> None:
        status = ct.c_uint32()
        if self._closed or lib.dds_take_status(self._handle, ct.byref(status), self._mask) < 0:
            return
        self._notify(status.value)

    def _notify(self, status: int) -> None:
        bit, word = self._incompatible
        result = _IncompatibleQos()
        if self._on_incompatible is None or not status & bit:
            return
        read = getattr(lib, f"dds_get_{word}_incompatible_qos_status")
        if read(self._handle, ct.byref(result)) >= 0:
            self._on_incompatible(_POLICIES.get(result.last_policy, "INVALID"))


class Writer(Endpoint):
    _side = "subscription"
    _incompatible = (1 << 3, "offered")

    def set_type(self, participant: int, dds_type: str) -> None:
        """Prepare for samples of a type; `Participant` does so."""
        self._sertype = ddsc.serialized_type(self._handle, participant, dds_type)

    def write(self, *parts: bytes | bytearray | memoryview) -> bool:
        """Send one sample, in parts: a four-byte CDR header, all in the first, and a byte or more.

        Returns:
            False if a reliable reader kept the writer waiting for 0.1 s, so that the sample was
            not accepted.

        Raises:
            DdsError: the writer is closed, or the bytes are no sample.
        """
        first, *others = (bytes(part) for part in parts)
        size = len(first) + sum(map(len, others))
        padding = -size % 4  # RTPS wants samples in multiples of four; the header says how many
        others.append(bytes(padding))
        header = first[:3] + bytes([padding]) if padding else first[:4]
        vectors = (IoVector * (len(others) + 2))(
            IoVector(_address(header), len(header)),
            IoVector(_address(first) + 4, max(0, len(first) - 4)),
            *(IoVector(_address(part), len(part)) for part in others),
        )
        with self._in_use:
            if self._closed:
                raise DdsError("the writer is closed, so nothing can be published with it")
            serialized = lib.ddsi_serdata_from_ser_iov(
                self._sertype, ddsc.SAMPLE_OF_DATA, len(vectors), vectors, size + padding
            )
            if not serialized:
                raise DdsError(f"{size} bytes are not a sample; serialize the message first")
            returned = lib.dds_writecdr(self._handle, serialized)
        if returned == ddsc.RETURN_TIMEOUT:
            return False
        check(returned, "a sample cannot be written; the writer may have been closed")
        return True


class Reader(Endpoint):
    _side = "publication"
    _incompatible = (1 << 4, "requested")
    _on_data: Callable[[], None] | None = None

    def set_on_data(self, callback: Callable[[], None] | None) -> None:
        """Have a function called from another thread now and when samples may be waiting."""
        self._on_data = callback
        if callback is not None:
            self._dispatcher.call_soon(callback)

    def take(self) -> tuple[bytes, SampleInfo] | None:
        """The oldest sample that is waiting, removed from the reader; None if there is none."""
        serialized, info = ct.c_void_p(), RawSampleInfo()
        with self._in_use:
            arguments = (ct.byref(serialized), 1, ct.byref(info), ddsc.ANY_STATE)
            while not self._closed and lib.dds_takecdr(self._handle, *arguments) > 0:
                data = _bytes_of(serialized) if info.valid_data else None
                lib.ddsi_serdata_unref(serialized)
                if data is not None:
                    return data, SampleInfo(
                        info.source_timestamp, time.time_ns(), info.publication_handle
                    )
        return None

    def _notify(self, status: int) -> None:
        callback = self._on_data
        if status & _DATA_AVAILABLE and callback is not None:
            callback()
        super()._notify(status)


def _address(data: bytes) -> int:
    """Where the bytes are; whoever asks keeps them alive."""
    return ct.cast(ct.c_char_p(data), ct.c_void_p).value or 0


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
            ignore_own: leave out samples of this participant's own writers.

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
        if isinstance(endpoint, Writer):
            endpoint.set_type(self.handle, dds_type)
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
