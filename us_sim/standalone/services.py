"""Requests and responses as rmw_cyclonedds maps services to DDS topics.

A request carries, after the CDR header, the client's number (64 bits) and a sequence number
(64 bits), which the response repeats. Both endpoints of a server, or of a client, share an id in
their USER_DATA, so that a client knows when both directions are connected.
"""

from __future__ import annotations

import struct
import time
from collections.abc import Callable
from itertools import count
from typing import Any

from .interfaces import dds_name, type_hash
from .middleware import RequestHeader, SampleInfo
from .transport import Participant

_HEADER = struct.Struct("<Qq")
_LONGEST_WAIT = 0.1  # s, for a client's reader to be discovered, as rmw_cyclonedds waits

_endpoint_numbers = count(1)
_request_numbers = count(1)


class _ServiceEndpoint:
    """A writer of one direction and a reader of the other."""

    _key: str  # what the id is called in the USER_DATA

    def __init__(self, participant: Participant, service: str, type_name: str, qos: Any) -> None:
        """Offer or use a service.

        Args:
            service: the full ROS name, ``/node/get_parameters``.
            type_name: ``rcl_interfaces/srv/GetParameters``.
            qos: rclpy's QoSProfile or an EndpointQos.
        """
        number = next(_endpoint_numbers)
        identity = participant.gid[:12] + number.to_bytes(4, "big")
        own_id = ".".join(f"{byte:x}" for byte in identity)

        def arguments(prefix: str, suffix: str, part: str) -> tuple[str, str, Any, str]:
            return (
                f"{prefix}{service}{suffix}",
                dds_name(f"{type_name}_{part}"),
                qos,
                f"{self._key}={own_id};typehash={type_hash(f'{type_name}_{part}')};",
            )

        request = arguments("rq", "Request", "Request")
        response = arguments("rr", "Reply", "Response")
        is_server = isinstance(self, ServiceServer)
        self._writer = participant.create_writer(*(response if is_server else request))
        self._reader = participant.create_reader(*(request if is_server else response))
        self.gids = [self._reader.gid], [self._writer.gid]

    def set_on_data(self, callback: Callable[[], None] | None) -> None:
        self._reader.set_on_data(callback)

    def close(self) -> None:
        self._reader.close()
        self._writer.close()

    def take(self) -> tuple[bytes, RequestHeader] | None:
        """The next request or response, serialized, with its origin; None if there is none."""
        while (sample := self._reader.take()) is not None:
            data, info = sample
            if not self._understands(info) or len(data) < 4 + _HEADER.size:
                continue
            client, sequence = _HEADER.unpack_from(data, 4)
            header = RequestHeader(client, sequence, info)
            return data[:4] + data[4 + _HEADER.size :], header
        return None

    def _understands(self, info: SampleInfo) -> bool:  # noqa: ARG002
        """Whether the writer puts the header before the message."""
        return True

    def _send(self, data: bytes, client: int, sequence: int) -> bool:
        return self._writer.write(data[:4] + _HEADER.pack(client, sequence), memoryview(data)[4:])


class ServiceServer(_ServiceEndpoint):
    """Takes requests for a service and sends the responses."""

    _key = "serviceid"
    on_unanswered: Callable[[str], object] | None = None  # told why, for each such request

    def _understands(self, info: SampleInfo) -> bool:
        """Whether a client of Cyclone's sent it, each of which has had an id since ROS 2 Foxy.

        Fast DDS names the request in inline QoS instead, which Cyclone's C interface hides. Of a
        writer that has gone nothing is known; its request is taken, as rmw_cyclonedds takes it.
        """
        client = self._reader.user_data_of(info.publication_handle)
        if client is None or "clientid" in client:
            return True
        if self.on_unanswered is not None:
            self.on_unanswered(
                "since its client does not run on Cyclone DDS: set "
                "RMW_IMPLEMENTATION=rmw_cyclonedds_cpp there, or rmw_zenoh_cpp on both sides"
            )
        return False

    def send_response(self, data: bytes, header: RequestHeader) -> bool:
        """Answer a request; False if the client's reader was not there within 0.1 s."""
        deadline = time.monotonic() + _LONGEST_WAIT
        while not self._client_listens(header.info.publication_handle):
            if time.monotonic() > deadline:
                return False
            time.sleep(0.002)
        return self._send(data, header.client, header.sequence)

    def _client_listens(self, request_writer: int) -> bool:
        """Whether the response would be received, or there is nobody left to receive it."""
        client = self._reader.user_data_of(request_writer)
        if client is None or "clientid" not in client:
            return True
        readers = self._writer.matched_user_data()
        return any(reader.get("clientid") == client["clientid"] for reader in readers)


class ServiceClient(_ServiceEndpoint):
    """Sends requests to a service and takes the responses to its own."""

    _key = "clientid"

    def __init__(self, participant: Participant, service: str, type_name: str, qos: Any) -> None:
        super().__init__(participant, service, type_name, qos)
        self._number = self._writer.instance_handle()

    def service_is_ready(self) -> bool:
        """Whether a server is connected in both directions that understands the header.

        A server on Fast DDS, without an id, may take all memory to read it (rmw_cyclonedds#577).
        """
        readers = self._writer.matched_user_data()
        writers = self._reader.matched_user_data()
        servers = {reader["serviceid"] for reader in readers if "serviceid" in reader}
        return any(writer.get("serviceid") in servers for writer in writers)

    def send_request(self, data: bytes) -> int:
        """Send a serialized request; returns its sequence number."""
        sequence = next(_request_numbers)
        self._send(data, self._number, sequence)
        return sequence

    def take(self) -> tuple[bytes, RequestHeader] | None:
        """The next response to one of this client's requests; None if there is none."""
        while (response := super().take()) is not None:
            if response[1].client == self._number:
                return response
        return None
