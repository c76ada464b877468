"""A context's place in a DDS domain, through Eclipse Cyclone DDS, as rmw_cyclonedds has it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from .graph import Graph
from .interfaces import dds_name, type_hash
from .middleware import Owner
from .services import ServiceClient, ServiceServer
from .transport import Participant, Reader, Writer


class Cyclone:
    """The `Middleware` that speaks DDS; what its methods take and return is described there."""

    def __init__(self, domain_id: int, enclave: str) -> None:
        self._participant = Participant(domain_id, enclave)
        self._graph = Graph(self._participant)
        self.announce = self._graph.announce
        self.nodes = self._graph.nodes
        self.endpoints = self._graph.endpoints

    def create_publisher(
        self, owner: Owner, topic: str, kind: str, qos: Any, on_incompatible: Callable[[str], None]
    ) -> Writer:
        del owner  # which endpoints a node has is announced for all of them together
        return self._participant.create_writer(*_topic(topic, kind, qos), on_incompatible)

    def create_subscription(
        self, owner: Owner, topic: str, kind: str, qos: Any, on_incompatible: Callable[[str], None]
    ) -> Reader:
        del owner
        return self._participant.create_reader(*_topic(topic, kind, qos), on_incompatible)

    def create_client(self, owner: Owner, service: str, kind: str, qos: Any) -> ServiceClient:
        del owner
        return ServiceClient(self._participant, service, kind, qos)

    def create_service(self, owner: Owner, service: str, kind: str, qos: Any) -> ServiceServer:
        del owner
        return ServiceServer(self._participant, service, kind, qos)

    def close(self) -> None:
        self._graph.close()
        self._participant.close()


def _topic(topic: str, kind: str, qos: Any) -> tuple[str, str, Any, str]:
    """The topic in DDS, the type in DDS, the quality of service, and USER_DATA."""
    name = topic[1:] if qos.avoid_ros_namespace_conventions else f"rt{topic}"
    return name, dds_name(kind), qos, f"typehash={type_hash(kind)};"
