"""Nodes: what publishers, subscriptions, timers, services and parameters belong to.

>>> from us_sim.standalone.rclpy.context import Context
>>> with Context() as context:  # a script would call rclpy.init() instead
...     node = Node("probe", namespace="left", context=context)
...     print(node.get_fully_qualified_name(), node.resolve_topic_name("~/image"))
...     node.destroy_node()
/left/probe /left/probe/image
"""

import weakref
from collections.abc import Callable
from operator import attrgetter

from ..messages import message_class
from ._arguments import parse_arguments
from ._endpoints import NodeLink
from ._names import require_namespace, require_node_name
from ._node_entities import NodeEntities
from ._remapping import NAMESPACE, NODE_NAME, remap_node
from ._rosout import Rosout
from .clock import Clock, ROSClock
from .context import Context, LocalNode
from .exceptions import NotInitializedException
from .logging import get_logger
from .parameter import Parameter
from .parameter_service import ParameterService
from .qos import qos_profile_parameter_events
from .time_source import TimeSource
from .utilities import get_default_context


class Node(NodeEntities):
    """A participant in the ROS graph."""

    context = property(attrgetter("_context"))

    def __init__(
        self,
        node_name: str,
        *,
        context: Context | None = None,
        cli_args: list[str] | None = None,
        namespace: str | None = None,
        use_global_arguments: bool = True,
        enable_rosout: bool = True,
        start_parameter_services: bool = True,
        parameter_overrides: list[Parameter] | None = None,
        allow_undeclared_parameters: bool = False,
        automatically_declare_parameters_from_overrides: bool = False,
    ) -> None:
        self._context = get_default_context() if context is None else context
        if not self._context.ok():
            raise NotInitializedException("cannot create node")
        sources = [parse_arguments(cli_args or [])]
        if use_global_arguments:
            sources.append(self._context._arguments)
        self._rcl_remap_rules = [rule for source in sources for rule in source.remap_rules]
        self._rcl_name, self._rcl_namespace = self._rcl_remapped_names(node_name, namespace or "")

        path = self._rcl_namespace.strip("/").replace("/", ".")
        logger_name = f"{path}.{self._rcl_name}" if path else self._rcl_name
        self._rcl_link = NodeLink(self._context, logger_name, _waker_of(self))
        self._rcl_local_node = LocalNode(self._rcl_name, self._rcl_namespace)
        super().__init__()
        self._clock: ROSClock = ROSClock()

        overrides: dict[str, Parameter] = {}
        for source in reversed(sources):
            for name, value in source.overrides_for(self.get_fully_qualified_name()).items():
                overrides[name] = Parameter(name, value=value)
        overrides.update((parameter.name, parameter) for parameter in parameter_overrides or [])
        self._rcl_keep_parameters(overrides, allow_undeclared_parameters)

        with self._context._announced_once():
            self._context._add_node(self._rcl_local_node)
            if enable_rosout and "rosout" not in self._context._arguments.disabled_outputs:
                self._rcl_rosout = Rosout(self._rcl_link)
            self._logger = get_logger(logger_name)
            self._parameter_event_publisher = self.create_publisher(
                message_class("rcl_interfaces/msg/ParameterEvent"),
                "/parameter_events",
                qos_profile_parameter_events,
            )
            if automatically_declare_parameters_from_overrides:
                descriptor = message_class("rcl_interfaces/msg/ParameterDescriptor")
                self.declare_parameters(
                    "",
                    [(name, p.value, descriptor()) for name, p in overrides.items()],
                    ignore_override=True,
                )
            self._time_source = TimeSource(self, self._clock)
            if start_parameter_services:
                self._rcl_parameter_service = ParameterService(self)

    def _rcl_remapped_names(self, name: str, namespace: str) -> tuple[str, str]:
        """Name and absolute namespace after the arguments had their say."""
        if not namespace.startswith("/"):
            namespace = f"/{namespace}"
        require_node_name(name)
        require_namespace(namespace)
        name = remap_node(self._rcl_remap_rules, NODE_NAME, name) or name
        namespace = remap_node(self._rcl_remap_rules, NAMESPACE, name) or namespace
        require_node_name(name)
        require_namespace(namespace)
        return name, namespace

    def get_clock(self) -> Clock:
        """ROS time, as this node sees it."""
        return self._clock

    def get_logger(self):
        """The logger of this node."""
        return self._logger

    def destroy_node(self):
        """Leave the graph, with everything that belongs to this node."""
        self._parameter_event_publisher = None
        with self._context._announced_once():
            self._rcl_destroy_all()
            if self._rcl_rosout is not None:
                self._rcl_rosout.destroy()
                self._rcl_rosout = None
            self._context._remove_node(self._rcl_local_node)
        self._rcl_wake_executor()


def _waker_of(node: Node) -> Callable[[], None]:
    """Wakes the node's executor without keeping the node alive."""
    reference = weakref.ref(node)

    def wake() -> None:
        alive = reference()
        if alive is not None:
            alive._rcl_wake_executor()

    return wake
