"""What a node can ask about all nodes, topics and services that it sees."""

import time
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

from . import _demangling as demangling
from ._context_handle import ContextHandle
from ._names import expand
from ._rclpy_pybind11 import NodeNameNonExistentError
from .duration import Duration, Infinite
from .qos import QoSProfile
from .topic_endpoint_info import TopicEndpointInfo, TopicEndpointTypeEnum
from .type_hash import TypeHash
from .validate_full_topic_name import validate_full_topic_name

if TYPE_CHECKING:
    from ..graph import Graph, GraphEndpoint

__all__ = ["NodeGraph"]

NamesAndTypes = list[tuple[str, list[str]]]

_LONGEST_WAIT = 0.25  # s; the graph's changes wake it earlier


class NodeGraph:
    """The questions; `Node` answers what its own name and context are."""

    _context_handle: ContextHandle

    if TYPE_CHECKING:

        def get_name(self) -> str: ...
        def get_namespace(self) -> str: ...
        def _remapped_topic(self, name: str) -> str: ...

    @property
    def _graph(self) -> "Graph":
        return self._context_handle.participant.graph

    def get_node_names(self) -> list[str]:
        """The names of all nodes, without namespaces."""
        return [node.name for node in self._graph.nodes()]

    def get_fully_qualified_node_names(self) -> list[str]:
        """The absolute names of all nodes."""
        return [_join(node.namespace, node.name) for node in self._graph.nodes()]

    def get_node_names_and_namespaces(self) -> list[tuple[str, str]]:
        """Name and namespace of all nodes."""
        return [(node.name, node.namespace) for node in self._graph.nodes()]

    def get_node_names_and_namespaces_with_enclaves(self) -> list[tuple[str, str, str]]:
        """Name, namespace and security enclave of all nodes."""
        return [(node.name, node.namespace, node.enclave) for node in self._graph.nodes()]

    def get_topic_names_and_types(self, no_demangle: bool = False) -> NamesAndTypes:
        """All topics with their types; as DDS names them if not to be demangled."""
        return _topics(self._graph.endpoints(), no_demangle)

    def get_service_names_and_types(self) -> NamesAndTypes:
        """All services with their types."""
        return _services(self._graph.endpoints(), None)

    def get_publisher_names_and_types_by_node(
        self, node_name: str, node_namespace: str, no_demangle: bool = False
    ) -> NamesAndTypes:
        """The topics that a node publishes; raises NodeNameNonExistentError for no such node."""
        return _topics(self._endpoints_of(node_name, node_namespace, True), no_demangle)

    def get_subscriber_names_and_types_by_node(
        self, node_name: str, node_namespace: str, no_demangle: bool = False
    ) -> NamesAndTypes:
        """The topics a node subscribes to; raises NodeNameNonExistentError for no such node."""
        return _topics(self._endpoints_of(node_name, node_namespace, False), no_demangle)

    def get_service_names_and_types_by_node(
        self, node_name: str, node_namespace: str
    ) -> NamesAndTypes:
        """The services that a node offers; raises NodeNameNonExistentError for no such node."""
        return _services(self._endpoints_of(node_name, node_namespace, False), "rq/")

    def get_client_names_and_types_by_node(
        self, node_name: str, node_namespace: str
    ) -> NamesAndTypes:
        """The services that a node uses; raises NodeNameNonExistentError for no such node."""
        return _services(self._endpoints_of(node_name, node_namespace, False), "rr/")

    def count_publishers(self, topic_name: str) -> int:
        """How many publishers a topic has."""
        return self._count(f"rt{self._full_name(topic_name)}", is_writer=True)

    def count_subscribers(self, topic_name: str) -> int:
        """How many subscriptions a topic has."""
        return self._count(f"rt{self._full_name(topic_name)}", is_writer=False)

    def count_services(self, service_name: str) -> int:
        """How many nodes offer a service."""
        name = self._full_name(service_name, is_service=True)
        return self._count(f"rq{name}Request", is_writer=False)

    def count_clients(self, service_name: str) -> int:
        """How many clients a service has."""
        name = self._full_name(service_name, is_service=True)
        return self._count(f"rr{name}Reply", is_writer=False)

    def get_publishers_info_by_topic(
        self, topic_name: str, no_mangle: bool = False
    ) -> list[TopicEndpointInfo]:
        """Everything known about the publishers of a topic; a DDS topic if not to be mangled."""
        return self._infos(topic_name, no_mangle, is_writer=True)

    def get_subscriptions_info_by_topic(
        self, topic_name: str, no_mangle: bool = False
    ) -> list[TopicEndpointInfo]:
        """Everything known about the subscriptions to a topic; a DDS topic if not to be mangled."""
        return self._infos(topic_name, no_mangle, is_writer=False)

    def wait_for_node(self, fully_qualified_node_name: str, timeout: float) -> bool:
        """Wait until a node is there; whether it was within so many seconds."""
        name = "/" + fully_qualified_node_name.lstrip("/")
        deadline = time.monotonic() + timeout
        changed = self._context_handle.graph_changed
        while name not in self.get_fully_qualified_node_names():
            rest = deadline - time.monotonic()
            if rest <= 0 or not self._context_handle.ok():
                return False
            with changed:
                changed.wait(min(rest, _LONGEST_WAIT))
        return True

    def _full_name(self, name: str, is_service: bool = False) -> str:
        full = expand(name, self.get_name(), self.get_namespace())
        validate_full_topic_name(full, is_service=is_service)
        return full

    def _count(self, dds_topic: str, is_writer: bool) -> int:
        return sum(e.is_writer == is_writer for e in self._graph.endpoints(dds_topic))

    def _endpoints_of(
        self, node_name: str, node_namespace: str, is_writer: bool
    ) -> "list[GraphEndpoint]":
        graph = self._graph
        gids: set[bytes] = set()
        found = False
        for node in graph.nodes():
            if (node.name, node.namespace) == (node_name, node_namespace):
                found = True
                gids.update(node.writer_gids if is_writer else node.reader_gids)
        if not found:
            raise NodeNameNonExistentError(
                f"cannot get information about node '{node_name}' in namespace "
                f"'{node_namespace}': no such node is known"
            )
        return [endpoint for endpoint in graph.endpoints() if endpoint.gid in gids]

    def _infos(self, name: str, no_mangle: bool, is_writer: bool) -> list[TopicEndpointInfo]:
        dds_topic = name if no_mangle else f"rt{self._remapped_topic(self._full_name(name))}"
        graph = self._graph
        owners = {
            gid: node
            for node in graph.nodes()
            for gid in (node.writer_gids if is_writer else node.reader_gids)
        }
        return [
            _info(endpoint, owners.get(endpoint.gid))
            for endpoint in graph.endpoints(dds_topic)
            if endpoint.is_writer == is_writer
        ]


def _join(namespace: str, name: str) -> str:
    return f"{namespace.rstrip('/')}/{name}"


def _topics(endpoints: "Iterable[GraphEndpoint]", no_demangle: bool) -> NamesAndTypes:
    if no_demangle:
        return _grouped(endpoints, lambda topic: topic, lambda type_: type_)
    return _grouped(endpoints, demangling.topic_name, demangling.type_name)


def _services(endpoints: "Iterable[GraphEndpoint]", prefix: str | None) -> NamesAndTypes:
    return _grouped(
        endpoints,
        lambda topic: demangling.service_name(topic, prefix),
        demangling.service_type_name,
    )


def _grouped(
    endpoints: "Iterable[GraphEndpoint]",
    name_of: Callable[[str], str | None],
    type_of: Callable[[str], str],
) -> NamesAndTypes:
    found: dict[str, set[str]] = {}
    for endpoint in endpoints:
        name = name_of(endpoint.topic)
        if name is not None:
            found.setdefault(name, set()).add(type_of(endpoint.type_name))
    return [(name, sorted(types)) for name, types in sorted(found.items())]


def _info(endpoint: "GraphEndpoint", owner: Any) -> TopicEndpointInfo:
    return TopicEndpointInfo(
        node_name="_NODE_NAME_UNKNOWN_" if owner is None else owner.name,
        node_namespace="_NODE_NAMESPACE_UNKNOWN_" if owner is None else owner.namespace,
        topic_type=demangling.type_name(endpoint.type_name),
        topic_type_hash=_hash(endpoint.user_data.get("typehash", "")),
        endpoint_type=TopicEndpointTypeEnum.PUBLISHER
        if endpoint.is_writer
        else TopicEndpointTypeEnum.SUBSCRIPTION,
        endpoint_gid=list(endpoint.gid),
        qos_profile=_profile(endpoint.qos),
    )


def _hash(text: str) -> TypeHash:
    version, _, value = text.removeprefix("RIHS").partition("_")
    if not version.isdecimal() or len(value) != 64:
        return TypeHash()
    return TypeHash(int(version), bytes.fromhex(value))


def _profile(qos: Any) -> QoSProfile:
    def duration(nanoseconds: int) -> Duration:
        return Duration(nanoseconds=nanoseconds) if nanoseconds else Infinite

    return QoSProfile(
        history=qos.history,
        depth=qos.depth,
        reliability=qos.reliability,
        durability=qos.durability,
        lifespan=duration(qos.lifespan),
        deadline=duration(qos.deadline),
        liveliness=qos.liveliness,
        liveliness_lease_duration=duration(qos.liveliness_lease_duration),
    )
