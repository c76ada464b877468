"""The parts of a node that executors run, and its publishers: made, listed and destroyed here."""

import inspect
import weakref
from collections.abc import Callable, Iterator
from itertools import chain
from operator import attrgetter
from typing import Any

from ._endpoints import NodeLink
from ._names import require_topic_name
from ._node_parameters import NodeParameters
from ._remapping import SERVICE, TOPIC
from ._rosout import Rosout
from .callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from .client import Client
from .clock import Clock
from .constants import S_TO_NS
from .context import LocalNode
from .exceptions import NoTypeSupportImportedException
from .guard_condition import GuardCondition
from .publisher import Publisher
from .qos import QoSProfile, qos_profile_services_default
from .qos_overriding_options import QoSOverridingOptions, overridden
from .service import Service
from .subscription import Subscription
from .timer import Timer


class NodeEntities(NodeParameters):
    """Publishers, subscriptions, clients, services, timers and guard conditions."""

    _rcl_link: NodeLink
    _rcl_local_node: LocalNode
    _rcl_rosout: Rosout | None = None
    _rcl_executor_weakref: weakref.ReferenceType[Any] | None = None

    def __init__(self) -> None:
        self._publishers: list[Publisher] = []
        self._subscriptions: list[Subscription] = []
        self._clients: list[Client] = []
        self._services: list[Service] = []
        self._timers: list[Timer] = []
        self._guards: list[GuardCondition] = []
        self._default_callback_group = MutuallyExclusiveCallbackGroup()

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
        """Use a service."""
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
        """Call back when somebody triggers."""
        _refuse_coroutine(callback)
        group = callback_group or self._default_callback_group
        guard = GuardCondition(callback, group, context=self._context)
        return self._rcl_keep(guard, self._guards, group)

    def destroy_publisher(self, publisher: Publisher) -> bool:
        """Stop publishing; False when it is none of this node's."""
        return self._rcl_destroy(publisher, self._publishers)

    def destroy_subscription(self, subscription: Subscription) -> bool:
        """Stop subscribing; False when it is none of this node's."""
        return self._rcl_destroy(subscription, self._subscriptions)

    def destroy_client(self, client: Client) -> bool:
        """Stop using a service; False when it is none of this node's."""
        return self._rcl_destroy(client, self._clients)

    def destroy_service(self, service: Service) -> bool:
        """Stop offering a service; False when it is none of this node's."""
        return self._rcl_destroy(service, self._services)

    def destroy_timer(self, timer: Timer) -> bool:
        """Stop a timer for good; False when it is none of this node's."""
        return self._rcl_destroy(timer, self._timers)

    def destroy_guard_condition(self, guard: GuardCondition) -> bool:
        """Stop listening to triggers; False when it is none of this node's."""
        return self._rcl_destroy(guard, self._guards)

    def _rcl_entities(self) -> Iterator[Any]:
        """What executors run, in the order in which rclpy looks at it."""
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
        owners: Iterator[Any] = chain(
            *(self._publishers, self._subscriptions, self._clients, self._services),
            [self._rcl_rosout.publisher] if self._rcl_rosout else [],
        )
        gids = [owner._gids for owner in owners]
        readers = [gid for ours, _ in gids for gid in ours]
        writers = [gid for _, ours in gids for gid in ours]
        if (readers, writers) != (self._rcl_local_node.readers, self._rcl_local_node.writers):
            self._rcl_local_node.readers, self._rcl_local_node.writers = readers, writers
            self._context._announce()
        self._rcl_wake_executor()

    def _rcl_wake_executor(self) -> None:
        executor = self.executor
        if executor is not None:
            executor.wake()

    def _rcl_full_or_refused(self, name: str, is_service: bool = False) -> str:
        """The absolute, remapped name, or the error that says what is wrong with the given one."""
        try:
            return self._rcl_resolve(name, SERVICE if is_service else TOPIC, only_expand=False)
        except RuntimeError:
            require_topic_name(name, is_service=is_service)
            self._rcl_full_name(name, is_service)
            raise


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
