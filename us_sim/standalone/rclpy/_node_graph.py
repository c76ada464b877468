"""What a node can ask about all nodes and topics that it sees."""

from typing import Any

from ..graph import Graph, GraphEndpoint
from ._context_handle import ContextHandle
from ._names import expand, require_full_name
from .duration import Duration, Infinite
from .qos import QoSProfile
from .topic_endpoint_info import TopicEndpointInfo, TopicEndpointTypeEnum

__all__ = ["NodeGraph"]


class NodeGraph:
    """The questions; `Node` answers what its own name and context are."""

    _rcl_context_handle: ContextHandle
    _rcl_name: str
    _rcl_namespace: str

    @property
    def _rcl_graph(self) -> Graph:
        return self._rcl_context_handle.graph

    def get_node_names(self) -> list[str]:
        """The names of all nodes, without namespaces."""
        return [node.name for node in self._rcl_graph.nodes()]

    def get_fully_qualified_node_names(self) -> list[str]:
        """The absolute names of all nodes."""
        return [f"{node.namespace.rstrip('/')}/{node.name}" for node in self._rcl_graph.nodes()]

    def get_node_names_and_namespaces(self) -> list[tuple[str, str]]:
        """Name and namespace of all nodes."""
        return [(node.name, node.namespace) for node in self._rcl_graph.nodes()]

    def get_topic_names_and_types(self, no_demangle: bool = False) -> list[tuple[str, list[str]]]:
        """All topics with their types; as DDS names them if not to be demangled."""
        found: dict[str, set[str]] = {}
        for endpoint in self._rcl_graph.endpoints():
            if no_demangle:
                found.setdefault(endpoint.topic, set()).add(endpoint.type_name)
            elif endpoint.topic.startswith("rt/"):
                found.setdefault(endpoint.topic[2:], set()).add(_type_name(endpoint.type_name))
        return [(name, sorted(types)) for name, types in sorted(found.items())]

    def count_publishers(self, topic_name: str) -> int:
        """How many publishers a topic has."""
        return len(self._rcl_endpoints_on(f"rt{self._rcl_full_name(topic_name)}", is_writer=True))

    def count_subscribers(self, topic_name: str) -> int:
        """How many subscriptions a topic has."""
        return len(self._rcl_endpoints_on(f"rt{self._rcl_full_name(topic_name)}", is_writer=False))

    def get_publishers_info_by_topic(
        self, topic_name: str, no_mangle: bool = False
    ) -> list[TopicEndpointInfo]:
        """Everything known about the publishers of a topic; a DDS topic if not to be mangled."""
        return self._rcl_infos(topic_name, no_mangle, is_writer=True)

    def get_subscriptions_info_by_topic(
        self, topic_name: str, no_mangle: bool = False
    ) -> list[TopicEndpointInfo]:
        """Everything known about the subscriptions to a topic; a DDS topic if not to be mangled."""
        return self._rcl_infos(topic_name, no_mangle, is_writer=False)

    def _rcl_remapped_topic(self, name: str) -> str:
        raise NotImplementedError

    def _rcl_full_name(self, name: str) -> str:
        full = expand(name, self._rcl_name, self._rcl_namespace)
        require_full_name(full, is_service=False)
        return full

    def _rcl_endpoints_on(self, dds_topic: str, is_writer: bool) -> list[GraphEndpoint]:
        return [e for e in self._rcl_graph.endpoints(dds_topic) if e.is_writer == is_writer]

    def _rcl_infos(self, name: str, no_mangle: bool, is_writer: bool) -> list[TopicEndpointInfo]:
        if not no_mangle:
            name = f"rt{self._rcl_remapped_topic(self._rcl_full_name(name))}"
        owners = {
            gid: node
            for node in self._rcl_graph.nodes()
            for gid in (node.writer_gids if is_writer else node.reader_gids)
        }
        return [
            _info(endpoint, owners.get(endpoint.gid))
            for endpoint in self._rcl_endpoints_on(name, is_writer)
        ]


def _type_name(dds_type: str) -> str:
    """The ROS type behind a DDS type; the name itself when it is none of ROS."""
    package, separator, rest = dds_type.partition("::dds_::")
    if not separator or not rest.endswith("_"):
        return dds_type
    return f"{package.replace('::', '/')}/{rest[:-1]}"


def _info(endpoint: GraphEndpoint, owner: Any) -> TopicEndpointInfo:
    kinds = TopicEndpointTypeEnum
    return TopicEndpointInfo(
        node_name="_NODE_NAME_UNKNOWN_" if owner is None else owner.name,
        node_namespace="_NODE_NAMESPACE_UNKNOWN_" if owner is None else owner.namespace,
        topic_type=_type_name(endpoint.type_name),
        endpoint_type=kinds.PUBLISHER if endpoint.is_writer else kinds.SUBSCRIPTION,
        endpoint_gid=list(endpoint.gid),
        qos_profile=_profile(endpoint.qos),
    )


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
