"""Readers and writers of serialized samples; `transport.Participant` makes them."""

from __future__ import annotations

import ctypes as ct
import threading
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from . import ddsc
from .ddsc import DdsError, IoVector, RawSampleInfo, check, guid_of, lib
from .dispatcher import Dispatcher
from .endpoint_qos import EndpointQos, user_data

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


class SampleInfo(NamedTuple):
    """Where a sample came from."""

    source_timestamp: int  # ns since 1970, when it was written, by the writer's clock
    received_timestamp: int  # ns since 1970, when it was taken here
    publication_handle: int  # this process's number for the writer


class Endpoint:
    """What readers and writers have in common.

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
        self._status_changed()  # what happened before it was attached is not told again

    def matched_count(self) -> int:
        """How many endpoints are connected to this one."""
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
    """Publishes serialized samples."""

    _side = "subscription"
    _incompatible = (1 << 3, "offered")

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._sertype = ct.c_void_p()
        check(
            lib.dds_get_entity_sertype(self._handle, ct.byref(self._sertype)),
            "the writer has no type",
        )

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
    """Receives serialized samples."""

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
