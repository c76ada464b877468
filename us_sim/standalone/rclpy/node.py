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
from typing import TYPE_CHECKING, Any

from ..messages import message_class
from ._arguments import parse_arguments
from ._endpoints import NodeLink
from ._local_node import LocalNode
from ._names import error_in_full_topic_name, expand
from ._node_graph import NodeGraph
from ._node_services import NodeServices
from ._node_timers import NodeTimers
from ._node_topics import NodeTopics
from ._rclpy_pybind11 import NodeNameNonExistentError, RCLError
from ._remapping import NAMESPACE, NODE_NAME, SERVICE, TOPIC, remap, remap_node
from ._rosout import Rosout
from .clock import Clock, ROSClock
from .context import Context
from .exceptions import NotInitializedException
from .logging import get_logger
from .logging_service import LoggingService
from .parameter import Parameter
from .parameter_service import ParameterService
from .qos import qos_profile_parameter_events
from .time_source import TimeSource
from .utilities import get_default_context
from .validate_namespace import validate_namespace
from .validate_node_name import validate_node_name

if TYPE_CHECKING:
    from .executors import Executor

__all__ = ["HIDDEN_NODE_PREFIX", "Node", "NodeNameNonExistentError"]

HIDDEN_NODE_PREFIX = "_"


class Node(NodeTopics, NodeServices, NodeTimers, NodeGraph):
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
        enable_logger_service: bool = False,
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
            enable_logger_service: whether others can get and set log levels.

        Raises:
            NotInitializedException: the context is not up.
            InvalidNodeNameException, InvalidNamespaceException: a name is not allowed.
        """
        self._context = get_default_context() if context is None else context
        handle = self._context.handle
        if handle is None or not handle.ok():
            raise NotInitializedException("cannot create node")
        self._context_handle = handle
        sources = [parse_arguments(cli_args or [])]
        if use_global_arguments:
            sources.append(handle.arguments)
        self._remap_rules = [rule for source in sources for rule in source.remap_rules]
        self._name, self._namespace = self._remapped_names(node_name, namespace or "")
        self._executor_weakref: weakref.ReferenceType[Executor] | None = None

        path = self._namespace.strip("/").replace("/", ".")
        logger_name = f"{path}.{self._name}" if path else self._name
        self._link = NodeLink(handle, logger_name, _waker_of(self))
        self._local_node = LocalNode(self._name, self._namespace)
        super().__init__()
        self._clock: ROSClock = ROSClock()

        overrides: dict[str, Parameter] = {}
        for source in reversed(sources):
            for name, value in source.overrides_for(self.get_fully_qualified_name()).items():
                overrides[name] = Parameter(name, value=value)
        overrides.update((parameter.name, parameter) for parameter in parameter_overrides or [])
        self._keep_parameters(overrides, allow_undeclared_parameters)

        with handle.announced_once():
            handle.add_node(self._local_node)
            self._rosout: Rosout | None = None
            if enable_rosout and "rosout" not in handle.arguments.disabled_outputs:
                self._rosout = Rosout(self._link)
                self._local_node.writers.append(self._rosout.publisher.gid)
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
                self._parameter_service = ParameterService(self)
            if enable_logger_service:
                self._logger_service = LoggingService(self)

    def _remapped_names(self, name: str, namespace: str) -> tuple[str, str]:
        """Name and absolute namespace after the arguments had their say."""
        if not namespace.startswith("/"):
            namespace = f"/{namespace}"
        validate_node_name(name)
        validate_namespace(namespace)
        name = remap_node(self._remap_rules, NODE_NAME, name) or name
        namespace = remap_node(self._remap_rules, NAMESPACE, name) or namespace
        validate_node_name(name)
        validate_namespace(namespace)
        return name, namespace

    @property
    def executor(self) -> "Executor | None":
        return None if self._executor_weakref is None else self._executor_weakref()

    @executor.setter
    def executor(self, new_executor: "Executor | None") -> None:
        current = self.executor
        if current is new_executor:
            return
        if current is not None:
            current.remove_node(self)
        if new_executor is None:
            self._executor_weakref = None
        else:
            new_executor.add_node(self)
            self._executor_weakref = weakref.ref(new_executor)

    def _wake_executor(self) -> None:
        executor = self.executor
        if executor is not None:
            executor.wake()

    @property
    def context(self) -> Context:
        return self._context

    def get_name(self) -> str:
        """This node's name, without namespace."""
        return self._name

    def get_namespace(self) -> str:
        """This node's namespace, which begins with a slash."""
        return self._namespace

    def get_fully_qualified_name(self) -> str:
        """This node's absolute name."""
        return f"{self._namespace.rstrip('/')}/{self._name}"

    def get_clock(self) -> Clock:
        """ROS time, as this node sees it."""
        return self._clock

    def get_logger(self):
        """The logger of this node."""
        return self._logger

    def resolve_topic_name(self, topic: str, *, only_expand: bool = False) -> str:
        """The absolute name that a topic has for this node, remapped unless `only_expand`."""
        return self._resolve(topic, TOPIC, only_expand)

    def resolve_service_name(self, service: str, *, only_expand: bool = False) -> str:
        """The absolute name that a service has for this node, remapped unless `only_expand`."""
        return self._resolve(service, SERVICE, only_expand)

    def _resolve(self, name: str, kind: int, only_expand: bool) -> str:
        try:
            full = expand(name, self._name, self._namespace)
            if not only_expand:
                full = remap(self._remap_rules, kind, full, self._name, self._namespace)
        except ValueError as error:
            raise RCLError(f"failed to resolve name: {error}") from None
        if fault := error_in_full_topic_name(full):
            raise RCLError(f"failed to resolve name: {fault[0]}")
        return full

    def _remapped_topic(self, name: str) -> str:
        return remap(self._remap_rules, TOPIC, name, self._name, self._namespace)

    def _destroy_parts(self) -> None:
        parts: tuple[tuple[list[Any], Callable[[Any], bool]], ...] = (
            (self._publishers, self.destroy_publisher),
            (self._subscriptions, self.destroy_subscription),
            (self._clients, self.destroy_client),
            (self._services, self.destroy_service),
            (self._timers, self.destroy_timer),
            (self._guards, self.destroy_guard_condition),
        )
        for entities, destroy in parts:
            for entity in list(entities):
                destroy(entity)

    def destroy_node(self):
        """Leave the graph, with everything that belongs to this node."""
        self._parameter_event_publisher = None
        with self._context_handle.announced_once():
            self._destroy_parts()
            if self._rosout is not None:
                self._rosout.destroy()
                self._rosout = None
            self._context_handle.remove_node(self._local_node)
        self._wake_executor()


def _waker_of(node: Node) -> Callable[[], None]:
    """Wakes the node's executor without keeping the node alive."""
    reference = weakref.ref(node)

    def wake() -> None:
        alive = reference()
        if alive is not None:
            alive._wake_executor()

    return wake
