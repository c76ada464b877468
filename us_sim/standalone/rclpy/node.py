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
from typing import Any

from ..messages import message_class
from ._arguments import parse_arguments
from ._context_handle import LocalNode
from ._endpoints import NodeLink
from ._names import error_in_full_topic_name, expand, require_namespace, require_node_name
from ._node_entities import NodeEntities
from ._node_graph import NodeGraph
from ._rclpy_pybind11 import RCLError
from ._remapping import NAMESPACE, NODE_NAME, SERVICE, TOPIC, remap, remap_node
from ._rosout import Rosout
from .clock import Clock, ROSClock
from .context import Context
from .exceptions import NotInitializedException
from .logging import get_logger
from .parameter import Parameter
from .parameter_service import ParameterService
from .qos import qos_profile_parameter_events
from .time_source import TimeSource
from .utilities import get_default_context

__all__ = ["Node"]


class Node(NodeEntities, NodeGraph):
    """A participant in the ROS graph."""

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
        """Join the graph.

        Args:
            node_name: without namespace; arguments may replace it.
            context: the default context when None.
            cli_args: arguments for this node only, before those of the process.
            namespace: the root when None; arguments may replace it.
            use_global_arguments: whether the arguments of the process count for this node.
            enable_rosout: whether log messages are also published on /rosout.
            start_parameter_services: whether others can get and set the parameters.
            parameter_overrides: values for parameters, after those from arguments.
            allow_undeclared_parameters: whether parameters can be set without declaring them.
            automatically_declare_parameters_from_overrides: whether every parameter that was
                given a value outside is declared.

        Raises:
            NotInitializedException: the context is not up.
            InvalidNodeNameException, InvalidNamespaceException: a name is not allowed.
        """
        self._context = get_default_context() if context is None else context
        handle = self._context.handle
        if handle is None or not handle.ok():
            raise NotInitializedException("cannot create node")
        self._rcl_context_handle = handle
        sources = [parse_arguments(cli_args or [])]
        if use_global_arguments:
            sources.append(handle.arguments)
        self._rcl_remap_rules = [rule for source in sources for rule in source.remap_rules]
        self._rcl_name, self._rcl_namespace = self._rcl_remapped_names(node_name, namespace or "")
        self._rcl_executor_weakref: weakref.ReferenceType[Any] | None = None

        path = self._rcl_namespace.strip("/").replace("/", ".")
        logger_name = f"{path}.{self._rcl_name}" if path else self._rcl_name
        self._rcl_link = NodeLink(handle, logger_name, _waker_of(self))
        self._rcl_local_node = LocalNode(self._rcl_name, self._rcl_namespace)
        super().__init__()
        self._clock: ROSClock = ROSClock()

        overrides: dict[str, Parameter] = {}
        for source in reversed(sources):
            for name, value in source.overrides_for(self.get_fully_qualified_name()).items():
                overrides[name] = Parameter(name, value=value)
        overrides.update((parameter.name, parameter) for parameter in parameter_overrides or [])
        self._rcl_keep_parameters(overrides, allow_undeclared_parameters)

        with handle.announced_once():
            handle.add_node(self._rcl_local_node)
            if enable_rosout and "rosout" not in handle.arguments.disabled_outputs:
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
            self._time_source = TimeSource(node=self)
            self._time_source.attach_clock(self._clock)
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

    @property
    def executor(self) -> Any:
        """The executor that runs this node's callbacks, None when there is none."""
        return None if self._rcl_executor_weakref is None else self._rcl_executor_weakref()

    @executor.setter
    def executor(self, new_executor: Any) -> None:
        current = self.executor
        if current is new_executor:
            return
        if current is not None:
            current.remove_node(self)
        if new_executor is None:
            self._rcl_executor_weakref = None
        else:
            new_executor.add_node(self)
            self._rcl_executor_weakref = weakref.ref(new_executor)

    def _rcl_wake_executor(self) -> None:
        executor = self.executor
        if executor is not None:
            executor.wake()

    @property
    def context(self) -> Context:
        return self._context

    def get_name(self) -> str:
        """This node's name, without namespace."""
        return self._rcl_name

    def get_namespace(self) -> str:
        """This node's namespace, which begins with a slash."""
        return self._rcl_namespace

    def get_fully_qualified_name(self) -> str:
        """This node's absolute name."""
        return f"{self._rcl_namespace.rstrip('/')}/{self._rcl_name}"

    def get_clock(self) -> Clock:
        """ROS time, as this node sees it."""
        return self._clock

    def get_logger(self):
        """The logger of this node."""
        return self._logger

    def resolve_topic_name(self, topic: str, *, only_expand: bool = False) -> str:
        """The absolute name that a topic has for this node, remapped unless `only_expand`."""
        return self._rcl_resolve(topic, TOPIC, only_expand)

    def resolve_service_name(self, service: str, *, only_expand: bool = False) -> str:
        """The absolute name that a service has for this node, remapped unless `only_expand`."""
        return self._rcl_resolve(service, SERVICE, only_expand)

    def _rcl_resolve(self, name: str, kind: int, only_expand: bool) -> str:
        try:
            full = expand(name, self._rcl_name, self._rcl_namespace)
            if not only_expand:
                full = remap(self._rcl_remap_rules, kind, full, self._rcl_name, self._rcl_namespace)
        except ValueError as error:
            raise RCLError(f"failed to resolve name: {error}") from None
        if fault := error_in_full_topic_name(full):
            raise RCLError(f"failed to resolve name: {fault[0]}")
        return full

    def _rcl_remapped_topic(self, name: str) -> str:
        return remap(self._rcl_remap_rules, TOPIC, name, self._rcl_name, self._rcl_namespace)

    def destroy_node(self):
        """Leave the graph, with everything that belongs to this node."""
        self._parameter_event_publisher = None
        with self._rcl_context_handle.announced_once():
            self._rcl_destroy_all()
            if self._rcl_rosout is not None:
                self._rcl_rosout.destroy()
                self._rcl_rosout = None
            self._rcl_context_handle.remove_node(self._rcl_local_node)
        self._rcl_wake_executor()


def _waker_of(node: Node) -> Callable[[], None]:
    """Wakes the node's executor without keeping the node alive."""
    reference = weakref.ref(node)

    def wake() -> None:
        alive = reference()
        if alive is not None:
            alive._rcl_wake_executor()

    return wake
