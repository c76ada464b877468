"""A node's own names, and what it can ask about all nodes and topics that it sees."""

from typing import Any

from ..graph import Graph, GraphEndpoint
from ._names import error_in_full_topic_name, expand, require_topic_name
from ._rclpy_pybind11 import RCLError
from ._remapping import SERVICE, TOPIC, RemapRule, remap
from .context import Context
from .duration import Duration, Infinite
from .qos import QoSProfile
from .topic_endpoint_info import TopicEndpointInfo, TopicEndpointTypeEnum


class NodeGraph:
    """Names and questions; `Node` says what its own name and context are."""

    _context: Context
    _rcl_name: str
    _rcl_namespace: str
    _rcl_remap_rules: list[RemapRule]

    def get_name(self) -> str:
        """This node's name, without namespace."""
        return self._rcl_name

    def get_namespace(self) -> str:
        """This node's namespace, which begins with a slash."""
        return self._rcl_namespace

    def get_fully_qualified_name(self) -> str:
        """This node's absolute name."""
        return f"{self._rcl_namespace.rstrip('/')}/{self._rcl_name}"

    def resolve_topic_name(self, topic: str, *, only_expand: bool = False) -> str:
        """The absolute name that a topic has for this node, remapped unless `only_expand`."""
        return self._rcl_resolve(topic, TOPIC, only_expand)

    def resolve_service_name(self, service: str, *, only_expand: bool = False) -> str:
        """The absolute name that a service has for this node, remapped unless `only_expand`."""
        return self._rcl_resolve(service, SERVICE, only_expand)

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

    @property
    def _rcl_graph(self) -> Graph:
        return self._context._graph

    def _rcl_resolve(self, name: str, kind: int, only_expand: bool) -> str:
        try:
            full = expand(name, self._rcl_name, self._rcl_namespace)
            if not only_expand:
                full = self._rcl_remapped(kind, full)
        except ValueError as error:
            raise RCLError(f"failed to resolve name: {error}") from None
        if fault := error_in_full_topic_name(full):
            raise RCLError(f"failed to resolve name: {fault[0]}")
        return full

    def _rcl_remapped(self, kind: int, name: str) -> str:
        return remap(self._rcl_remap_rules, kind, name, self._rcl_name, self._rcl_namespace)

    def _rcl_full_name(self, name: str, is_service: bool = False) -> str:
        full = expand(name, self._rcl_name, self._rcl_namespace)
        require_topic_name(full, is_service=is_service, is_full=True)
        return full

    def _rcl_endpoints_on(self, dds_topic: str, is_writer: bool) -> list[GraphEndpoint]:
        return [e for e in self._rcl_graph.endpoints(dds_topic) if e.is_writer == is_writer]

    def _rcl_infos(self, name: str, no_mangle: bool, is_writer: bool) -> list[TopicEndpointInfo]:
        if not no_mangle:
            name = f"rt{self._rcl_remapped(TOPIC, self._rcl_full_name(name))}"
        owners = {
            gid: (node.name, node.namespace)
            for node in self._rcl_graph.nodes()
            for gid in (node.writer_gids if is_writer else node.reader_gids)
        }
        unknown = ("_NODE_NAME_UNKNOWN_", "_NODE_NAMESPACE_UNKNOWN_")
        kinds = TopicEndpointTypeEnum
        return [
            TopicEndpointInfo(
                *owners.get(endpoint.gid, unknown),
                topic_type=_type_name(endpoint.type_name),
                endpoint_type=kinds.PUBLISHER if is_writer else kinds.SUBSCRIPTION,
                endpoint_gid=list(endpoint.gid),
                qos_profile=_profile(endpoint.qos),
            )
            for endpoint in self._rcl_endpoints_on(name, is_writer)
        ]


def _type_name(dds_type: str) -> str:
    """The ROS type behind a DDS type; the name itself when it is none of ROS."""
    package, separator, rest = dds_type.partition("::dds_::")
    if not separator or not rest.endswith("_"):
        return dds_type
    return f"{package.replace('::', '/')}/{rest[:-1]}"


def _profile(qos: Any) -> QoSProfile:
    policies = vars(qos).copy()
    for name in ("lifespan", "deadline", "liveliness_lease_duration"):
        policies[name] = Duration(nanoseconds=policies[name]) if policies[name] else Infinite
    return QoSProfile(**policies)
