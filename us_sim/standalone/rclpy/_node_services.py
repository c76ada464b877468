"""The clients and services of a node."""

from collections.abc import Callable, Iterator
from typing import Any

from ._node_parts import NodeParts
from ._service_endpoints import ClientHandle, ServiceHandle
from ._type_support import require_service_class
from .callback_groups import CallbackGroup
from .client import Client
from .qos import QoSProfile, qos_profile_services_default
from .service import Service

__all__ = ["NodeServices"]


class NodeServices(NodeParts):
    """Makes, lists and destroys clients and services."""

    def __init__(self) -> None:
        super().__init__()
        self._clients: list[Client] = []
        self._services: list[Service] = []

    @property
    def clients(self) -> Iterator[Client]:
        yield from self._clients

    @property
    def services(self) -> Iterator[Service]:
        yield from self._services

    def create_client(
        self,
        srv_type: Any,
        srv_name: str,
        *,
        qos_profile: QoSProfile = qos_profile_services_default,
        callback_group: CallbackGroup | None = None,
    ) -> Client:
        """Use a service; raises InvalidServiceNameException when the name is not allowed."""
        require_service_class(srv_type)
        group = callback_group or self._default_callback_group
        full_name = self._resolved(srv_name, is_service=True)
        handle = ClientHandle(self._link, srv_type, full_name, qos_profile)
        client = Client(self._context, handle, srv_type, srv_name, qos_profile, group)
        group.add_entity(client)
        self._clients.append(client)
        self._know_service_endpoint(handle.gids)
        return client

    def create_service(
        self,
        srv_type: Any,
        srv_name: str,
        callback: Callable[..., Any],
        *,
        qos_profile: QoSProfile = qos_profile_services_default,
        callback_group: CallbackGroup | None = None,
    ) -> Service:
        """Offer a service; raises InvalidServiceNameException when the name is not allowed.

        The callback takes a request and an empty response, and returns the response.
        """
        require_service_class(srv_type)
        group = callback_group or self._default_callback_group
        full_name = self._resolved(srv_name, is_service=True)
        handle = ServiceHandle(self._link, srv_type, full_name, qos_profile)
        service = Service(handle, srv_type, srv_name, callback, group, qos_profile)
        group.add_entity(service)
        self._services.append(service)
        self._know_service_endpoint(handle.gids)
        return service

    def destroy_client(self, client: Client) -> bool:
        """Stop using a service; False when it is none of this node's."""
        if not self._destroy(client, self._clients):
            return False
        self._forget_service_endpoint(client.handle.gids)
        return True

    def destroy_service(self, service: Service) -> bool:
        """Stop offering a service; False when it is none of this node's."""
        if not self._destroy(service, self._services):
            return False
        self._forget_service_endpoint(service.handle.gids)
        return True

    def _know_service_endpoint(self, gids: tuple[bytes, bytes]) -> None:
        self._local_node.readers.append(gids[0])
        self._local_node.writers.append(gids[1])
        self._joined()

    def _forget_service_endpoint(self, gids: tuple[bytes, bytes]) -> None:
        self._local_node.readers.remove(gids[0])
        self._local_node.writers.remove(gids[1])
        self._joined()
