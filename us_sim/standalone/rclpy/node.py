"""Nodes: the owners of publishers, subscriptions, timers, services and parameters.

>>> from us_sim.standalone.rclpy.context import Context
>>> with Context() as context:  # a script would call rclpy.init() instead
...     node = Node("probe", namespace="left", context=context)
...     print(node.get_fully_qualified_name(), node.resolve_topic_name("~/image"))
...     node.destroy_node()
/left/probe /left/probe/image
"""

import inspect
import weakref
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from enum import IntEnum
from itertools import chain
from operator import attrgetter
from typing import Any

from ..messages import message_class
from ..middleware import GraphEndpoint, GraphNode, Middleware, Owner, numbers
from ._arguments import parse_arguments
from ._names import (
    NAMESPACE,
    NODE_NAME,
    SERVICE,
    TOPIC,
    error_in_full_topic_name,
    expand,
    remap,
    remap_node,
    require_namespace,
    require_node_name,
    require_topic_name,
)
from ._node_parameters import NodeParameters
from .context import Context, get_default_context
from .endpoints import (
    CallbackGroup,
    Client,
    GuardCondition,
    MutuallyExclusiveCallbackGroup,
    NodeLink,
    Publisher,
    Service,
    Subscription,
    Timer,
)
from .exceptions import (
    InvalidHandle,
    NotInitializedException,
    NoTypeSupportImportedException,
    RCLError,
)
from .logging import Record, get_logger, rosout
from .parameter import Parameter, ParameterService
from .qos import (
    DurabilityPolicy,
    QoSOverridingOptions,
    QoSProfile,
    ReliabilityPolicy,
    overridden,
    qos_profile_parameter_events,
    qos_profile_services_default,
)
from .time import S_TO_NS, Clock, Duration, Infinite, ROSClock, Time


class TopicEndpointTypeEnum(IntEnum):
    INVALID = 0
    PUBLISHER = 1
    SUBSCRIPTION = 2


@dataclass
class TopicEndpointInfo:
    """One endpoint of a topic: whose it is, its type, its identity and its quality of service."""

    node_name: str
    node_namespace: str
    topic_type: str
    endpoint_type: TopicEndpointTypeEnum
    endpoint_gid: list[int]
    qos_profile: QoSProfile


_PARAMETER = "use_sim_time"


class TimeSource:
    """Sets a node's clock from the topic /clock; declares the parameter if need be."""

    def __init__(self, node: Any, clock: ROSClock) -> None:
        self._node: weakref.ReferenceType[Any] = weakref.ref(node)
        self._clock = clock
        self._subscription: Any = None
        if not node.has_parameter(_PARAMETER):
            node.declare_parameter(_PARAMETER, False)
        parameter = node.get_parameter(_PARAMETER)
        if parameter.type_ is Parameter.Type.BOOL:
            self._follow(parameter.value)
        else:
            node.get_logger().error(
                f"Invalid type for parameter '{_PARAMETER}' {parameter.type_!r} should be bool"
            )
        node.add_on_set_parameters_callback(self._on_set_parameters)

    def _follow(self, enabled: bool) -> None:
        if self._clock.ros_time_is_active == enabled:
            return
        self._clock._set_ros_time_is_active(enabled)
        node = self._node()
        if node is None:
            return
        if enabled:
            self._subscription = node.create_subscription(
                message_class("rosgraph_msgs/msg/Clock"),
                "/clock",
                lambda message: self._clock.set_ros_time_override(Time.from_msg(message.clock)),
                QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT),
            )
        else:
            node.destroy_subscription(self._subscription)

    def _on_set_parameters(self, parameters: list[Parameter]) -> Any:
        result: Any = message_class("rcl_interfaces/msg/SetParametersResult")(successful=True)
        for parameter in parameters:
            if parameter.name == _PARAMETER:
                if parameter.type_ is Parameter.Type.BOOL:
                    self._follow(parameter.value)
                else:
                    result.successful = False
                    result.reason = f"{_PARAMETER} parameter set to something besides a bool"
        return result


Log: Any = message_class("rcl_interfaces/msg/Log")
_QOS = QoSProfile(
    depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL, lifespan=Duration(seconds=10)
)


class Rosout:
    """One node's publisher on /rosout, which late listeners hear too."""

    def __init__(self, link: NodeLink) -> None:
        self._name = link.logger_name
        self.publisher = Publisher(link, Log, "/rosout", "/rosout", _QOS)
        rosout[self._name] = self._publish

    def _publish(self, record: Record) -> None:
        message = Log(
            stamp=Time(nanoseconds=record.stamp).to_msg(),
            level=int(record.severity),
            name=record.name,
            msg=record.message,
            file=record.file,
            function=record.function,
            line=record.line,
        )
        with suppress(InvalidHandle, RCLError):  # a node may say something while it ends
            self.publisher.publish(message)

    def destroy(self) -> None:
        rosout.pop(self._name, None)
        self.publisher.destroy()


class Node(NodeParameters):
    """A participant in the ROS graph."""

    context = property(attrgetter("_context"))
    _rcl_rosout: Rosout | None = None
    _rcl_executor_weakref: weakref.ReferenceType[Any] | None = None

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
        owner = Owner(next(numbers), self._rcl_namespace, self._rcl_name)
        self._rcl_link = NodeLink(self._context, owner, logger_name, _waker_of(self))
        self._publishers: list[Publisher] = []
        self._subscriptions: list[Subscription] = []
        self._clients: list[Client] = []
        self._services: list[Service] = []
        self._timers: list[Timer] = []
        self._guards: list[GuardCondition] = []
        self._default_callback_group = MutuallyExclusiveCallbackGroup()
        self._clock: ROSClock = ROSClock()

        overrides: dict[str, Parameter] = {}
        for source in reversed(sources):
            for name, value in source.overrides_for(self.get_fully_qualified_name()).items():
                overrides[name] = Parameter(name, value=value)
        overrides.update((parameter.name, parameter) for parameter in parameter_overrides or [])
        self._rcl_keep_parameters(overrides, allow_undeclared_parameters)

        with self._context._announced_once():
            self._rcl_exists = True
            self._rcl_changed()
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

    def get_clock(self) -> Clock:
        return self._clock

    def get_logger(self):
        return self._logger

    def destroy_node(self):
        """Leave the graph, with everything that belongs to this node."""
        self._parameter_event_publisher = None
        with self._context._announced_once():
            self._rcl_destroy_all()
            if self._rcl_rosout is not None:
                self._rcl_rosout.destroy()
                self._rcl_rosout = None
            self._rcl_exists = False
            self._context._set_node(self._rcl_link, None)
        self._rcl_wake_executor()

    def get_name(self) -> str:
        return self._rcl_name

    def get_namespace(self) -> str:
        return self._rcl_namespace

    def resolve_topic_name(self, topic: str, *, only_expand: bool = False) -> str:
        """The absolute name that a topic has for this node, remapped unless `only_expand`."""
        return self._rcl_resolve(topic, TOPIC, only_expand)

    def resolve_service_name(self, service: str, *, only_expand: bool = False) -> str:
        return self._rcl_resolve(service, SERVICE, only_expand)

    def get_node_names(self) -> list[str]:
        return [node.name for node in self._rcl_graph.nodes()]

    def get_fully_qualified_node_names(self) -> list[str]:
        return [f"{node.namespace.rstrip('/')}/{node.name}" for node in self._rcl_graph.nodes()]

    def get_node_names_and_namespaces(self) -> list[tuple[str, str]]:
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
        return len(self._rcl_endpoints_on(f"rt{self._rcl_full_name(topic_name)}", is_writer=True))

    def count_subscribers(self, topic_name: str) -> int:
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

    publishers = property(lambda self: iter(self._publishers))
    subscriptions = property(lambda self: iter(self._subscriptions))
    clients = property(lambda self: iter(self._clients))
    services = property(lambda self: iter(self._services))
    timers = property(lambda self: iter(self._timers))
    guards = property(lambda self: iter(self._guards))
    default_callback_group = property(attrgetter("_default_callback_group"))

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

    def create_publisher(
        self,
        msg_type: Any,
        topic: str,
        qos_profile: QoSProfile | int,
        *,
        callback_group: CallbackGroup | None = None,  # noqa: ARG002 (for events, which we lack)
        qos_overriding_options: QoSOverridingOptions | None = None,
    ) -> Publisher:
        """Publish a topic; there are no event callbacks, so the group has no effect."""
        full_name = self._rcl_full_or_refused(topic)
        qos = overridden(
            "publisher", self, full_name, _profile_of(qos_profile), qos_overriding_options
        )
        publisher = Publisher(self._rcl_link, msg_type, topic, full_name, qos)
        self._publishers.append(publisher)
        self._rcl_changed()
        return publisher

    def create_subscription(
        self,
        msg_type: Any,
        topic: str,
        callback: Callable[..., Any],
        qos_profile: QoSProfile | int,
        *,
        callback_group: CallbackGroup | None = None,
        qos_overriding_options: QoSOverridingOptions | None = None,
        raw: bool = False,
    ) -> Subscription:
        """Subscribe to a topic; a callback may take a second argument, where a message is from."""
        full_name = self._rcl_full_or_refused(topic)
        _refuse_coroutine(callback)
        qos = overridden(
            "subscription", self, full_name, _profile_of(qos_profile), qos_overriding_options
        )
        group = callback_group or self._default_callback_group
        subscription = Subscription(
            self._rcl_link, msg_type, topic, full_name, callback, group, qos, raw
        )
        return self._rcl_keep(subscription, self._subscriptions, group)

    def create_client(
        self,
        srv_type: Any,
        srv_name: str,
        *,
        qos_profile: QoSProfile = qos_profile_services_default,
        callback_group: CallbackGroup | None = None,
    ) -> Client:
        _require_service_class(srv_type)
        full_name = self._rcl_full_or_refused(srv_name, is_service=True)
        group = callback_group or self._default_callback_group
        client = Client(self._rcl_link, srv_type, srv_name, full_name, qos_profile, group)
        return self._rcl_keep(client, self._clients, group)

    def create_service(
        self,
        srv_type: Any,
        srv_name: str,
        callback: Callable[..., Any],
        *,
        qos_profile: QoSProfile = qos_profile_services_default,
        callback_group: CallbackGroup | None = None,
    ) -> Service:
        """Offer a service; the callback takes a request and a response, which it returns."""
        _require_service_class(srv_type)
        _refuse_coroutine(callback)
        full_name = self._rcl_full_or_refused(srv_name, is_service=True)
        group = callback_group or self._default_callback_group
        service = Service(
            self._rcl_link, srv_type, srv_name, full_name, callback, group, qos_profile
        )
        return self._rcl_keep(service, self._services, group)

    def create_timer(
        self,
        timer_period_sec: float,
        callback: Callable[..., Any],
        callback_group: CallbackGroup | None = None,
        clock: Clock | None = None,
        autostart: bool = True,
    ) -> Timer:
        """Call back each period, by the node's clock unless another one is given."""
        _refuse_coroutine(callback)
        group = callback_group or self._default_callback_group
        timer = Timer(
            callback,
            group,
            int(float(timer_period_sec) * S_TO_NS),
            clock or self._clock,
            context=self._context,
            autostart=autostart,
        )
        return self._rcl_keep(timer, self._timers, group)

    def create_guard_condition(
        self, callback: Callable[..., Any], callback_group: CallbackGroup | None = None
    ) -> GuardCondition:
        _refuse_coroutine(callback)
        group = callback_group or self._default_callback_group
        guard = GuardCondition(callback, group, context=self._context)
        return self._rcl_keep(guard, self._guards, group)

    def destroy_publisher(self, publisher: Publisher) -> bool:
        return self._rcl_destroy(publisher, self._publishers)

    def destroy_subscription(self, subscription: Subscription) -> bool:
        return self._rcl_destroy(subscription, self._subscriptions)

    def destroy_client(self, client: Client) -> bool:
        return self._rcl_destroy(client, self._clients)

    def destroy_service(self, service: Service) -> bool:
        return self._rcl_destroy(service, self._services)

    def destroy_timer(self, timer: Timer) -> bool:
        return self._rcl_destroy(timer, self._timers)

    def destroy_guard_condition(self, guard: GuardCondition) -> bool:
        return self._rcl_destroy(guard, self._guards)

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
    def _rcl_graph(self) -> Middleware:
        return self._context._middleware

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

    def _rcl_entities(self) -> Iterator[Any]:
        """The entities that executors run, in rclpy's order."""
        return iter(
            [*self._timers, *self._subscriptions, *self._guards, *self._clients, *self._services]
        )

    def _rcl_keep(self, entity: Any, entities: list[Any], group: CallbackGroup) -> Any:
        group.add_entity(entity)
        entities.append(entity)
        self._rcl_changed()
        return entity

    def _rcl_destroy(self, entity: Any, entities: list[Any]) -> bool:
        if entity not in entities:
            return False
        entities.remove(entity)
        entity.destroy()
        self._rcl_changed()
        return True

    def _rcl_destroy_all(self) -> None:
        kinds = (self._publishers, self._subscriptions, self._clients, self._services)
        for entities in (*kinds, self._timers, self._guards):
            for entity in list(entities):
                self._rcl_destroy(entity, entities)

    def _rcl_changed(self) -> None:
        """Tell others which endpoints this node has now, and the executor to look anew."""
        if self._rcl_exists:
            owners: Iterator[Any] = chain(
                *(self._publishers, self._subscriptions, self._clients, self._services),
                [self._rcl_rosout.publisher] if self._rcl_rosout else [],
            )
            gids = [owner._gids for owner in owners]
            readers = tuple(gid for ours, _ in gids for gid in ours)
            writers = tuple(gid for _, ours in gids for gid in ours)
            number, namespace, name = self._rcl_link.owner
            known = GraphNode(namespace, name, readers, writers, number=number)
            self._context._set_node(self._rcl_link, known)
        self._rcl_wake_executor()

    def _rcl_wake_executor(self) -> None:
        executor = self.executor
        if executor is not None:
            executor.wake()

    def _rcl_full_or_refused(self, name: str, is_service: bool = False) -> str:
        """The absolute, remapped name; raises the error that explains an invalid one."""
        try:
            return self._rcl_resolve(name, SERVICE if is_service else TOPIC, only_expand=False)
        except RuntimeError:
            require_topic_name(name, is_service=is_service)
            self._rcl_full_name(name, is_service)
            raise


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


def _profile_of(qos_or_depth: Any) -> QoSProfile:
    if isinstance(qos_or_depth, QoSProfile):
        return qos_or_depth
    if not isinstance(qos_or_depth, int):
        raise TypeError(f"Expected QoSProfile or int, but received {type(qos_or_depth)!r}")
    if qos_or_depth < 0:
        raise ValueError("history depth must be greater than or equal to zero")
    return QoSProfile(depth=qos_or_depth)


def _require_service_class(cls: Any) -> None:
    if not isinstance(cls, type) or not hasattr(cls, "Request") or not hasattr(cls, "Response"):
        raise NoTypeSupportImportedException()


def _refuse_coroutine(callback: Any) -> None:
    if inspect.iscoroutinefunction(callback):
        raise TypeError(
            f"{callback.__qualname__} is a coroutine, which this subset of rclpy does not run; "
            "make it a function, or install ROS 2"
        )


def _waker_of(node: Node) -> Callable[[], None]:
    """Wakes the node's executor without keeping the node alive."""
    reference = weakref.ref(node)

    def wake() -> None:
        alive = reference()
        if alive is not None:
            alive._rcl_wake_executor()

    return wake
