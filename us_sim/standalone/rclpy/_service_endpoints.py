"""What stands behind clients and services: a DDS reader of one topic and a writer of another."""

from dataclasses import dataclass
from typing import Any

from ..messages import serialize
from ..services import RequestHeader, ServiceClient, ServiceServer
from ._endpoints import Endpoint, Inbox, NodeLink, message_of
from ._rclpy_pybind11 import RCLError, rmw_request_id_t, rmw_service_info_t
from .logging import get_logger
from .qos import QoSProfile

__all__ = ["ClientHandle", "ServiceHandle"]


class _ServiceEndpoint(Endpoint):
    """One side of a service: a reader of one topic and a writer of another."""

    _endpoint: ServiceClient | ServiceServer
    inbox: Inbox

    @property
    def gids(self) -> tuple[bytes, bytes]:
        """Of the reader and of the writer."""
        return self._endpoint.reader_gid, self._endpoint.writer_gid

    def destroy(self) -> None:
        """Leave both topics."""
        if not self._destroyed:
            self._destroyed = True
            self._endpoint.close()


class ClientHandle(_ServiceEndpoint):
    """Sends requests and reads responses."""

    def __init__(self, link: NodeLink, srv_type: Any, name: str, qos: QoSProfile) -> None:
        super().__init__(link, name)
        self._client = ServiceClient(link.context.participant, name, srv_type.__msgtype__, qos)
        self._endpoint = self._client
        self.inbox = Inbox(self._client.take_response, self._wake)
        self._client.on_data = self.inbox.notify

    @property
    def service_name(self) -> str:
        self._require_existence()
        return self._name

    def send_request(self, request: Any) -> int:
        """Send a request; the response will have the same sequence number."""
        self._require_existence()
        if not self._context.ok():
            raise RCLError("failed to send request: the client's context is invalid")
        return self._client.send_request(serialize(request))

    def take_response(self, response_type: Any) -> tuple[rmw_service_info_t | None, Any]:
        """A response that came, and to which request."""
        self._require_existence()
        taken = self.inbox.take()
        if taken is None:
            return None, None
        data, header = taken
        return _service_info(header), message_of(data, response_type)

    def service_server_is_available(self) -> bool:
        """Whether a service is connected in both directions."""
        self._require_existence()
        return self._client.service_is_ready()


class ServiceHandle(_ServiceEndpoint):
    """Reads requests and sends responses."""

    def __init__(self, link: NodeLink, srv_type: Any, name: str, qos: QoSProfile) -> None:
        super().__init__(link, name)
        self._server = ServiceServer(link.context.participant, name, srv_type.__msgtype__, qos)
        self._endpoint = self._server
        self.inbox = Inbox(self._server.take_request, self._wake)
        self._server.on_data = self.inbox.notify

    @property
    def name(self) -> str:
        self._require_existence()
        return self._name

    def service_take_request(self, request_type: Any) -> tuple[Any, rmw_service_info_t | None]:
        """A request that came, and whose it is; bytes that are no request are not one."""
        self._require_existence()
        taken = self.inbox.take()
        if taken is None:
            return None, None
        data, header = taken
        try:
            return message_of(data, request_type), _service_info(header)
        except RCLError as error:
            get_logger("rclpy").warning(
                f"a request for {self._name} is not answered: {error}; a client on Fast DDS cannot "
                f"call a service on Cyclone DDS: set RMW_IMPLEMENTATION=rmw_cyclonedds_cpp there",
                throttle_duration_sec=5.0,
            )
            return None, None

    def service_send_response(self, response: Any, request_id: rmw_request_id_t) -> None:
        """Answer a request; nothing happens when the client has gone."""
        self._require_existence()
        if self._context.ok() and isinstance(request_id, _RequestId):
            self._server.send_response(serialize(response), request_id.header)


@dataclass(frozen=True)
class _RequestId(rmw_request_id_t):
    header: Any = None  # RequestHeader


def _service_info(header: RequestHeader) -> rmw_service_info_t:
    return rmw_service_info_t(
        source_timestamp=header.source_timestamp,
        received_timestamp=header.received_timestamp,
        request_id=_RequestId(header.sequence, header.client, header),
    )
