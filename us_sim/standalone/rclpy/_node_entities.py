"""The parts of a node that executors run, and its publishers: made, listed and destroyed here."""

import inspect
from collections.abc import Callable, Iterator
from itertools import chain
from typing import Any

from ._context_handle import ContextHandle, LocalNode
from ._endpoints import NodeLink
from ._names import expand, require_full_name, require_topic_name
from ._node_declarations import NodeDeclarations
from ._rosout import Rosout
from .callback_groups import CallbackGroup, MutuallyExclusiveCallbackGroup
from .client import Client
from .clock import Clock
from .constants import S_TO_NS
from .context import Context
from .exceptions import NoTypeSupportImportedException
from .guard_condition import GuardCondition
from .publisher import Publisher
from .qos import QoSProfile, qos_profile_services_default
from .qos_overriding_options import QoSOverridingOptions, overridden
from .service import Service
from .subscription import Subscription
from .timer import Timer

__all__ = ["NodeEntities"]


class NodeEntities(NodeDeclarations):
    """Publishers, subscriptions, clients, services, timers and guard conditions."""

    _context: Context
    _rcl_context_handle: ContextHandle
    _rcl_link: NodeLink
    _rcl_local_node: LocalNode
    _rcl_name: str
    _rcl_namespace: str
    _rcl_rosout: Rosout | None = None

    def __init__(self) -> None:
        self._publishers: list[Publisher] = []
        self._subscriptions: list[Subscription] = []
        self._clients: list[Client] = []
        self._services: list[Service] = []
        self._timers: list[Timer] = []
        self._guards: list[GuardCondition] = []
        self._default_callback_group = MutuallyExclusiveCallbackGroup()

    @property
    def publishers(self) -> Iterator[Publisher]:
        yield from self._publishers

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        yield from self._subscriptions

    @property
    def clients(self) -> Iterator[Client]:
        yield from self._clients

    @property
    def services(self) -> Iterator[Service]:
        yield from self._services

    @property
    def timers(self) -> Iterator[Timer]:
        yield from self._timers

    @property
    def guards(self) -> Iterator[GuardCondition]:
        yield from self._guards

    @property
    def default_callback_group(self) -> CallbackGroup:
        return self._default_callback_group

    def create_publisher(
        self,
        msg_type: Any,
        topic: str,
        qos_profile: QoSProfile | int,
        *,
        callback_group: CallbackGroup | None = None,  # noqa: ARG002 (for events, which we lack)
        qos_overriding_options: QoSOverridingOptions | None = None,
    ) -> Publisher:
        """Publish a topic.

        Args:
            msg_type: class of the messages.
            topic: relative, private (~/…) or absolute name.
            qos_profile: quality of service, or the depth of a reliable history.
            callback_group: without effect, since there are no event callbacks.
            qos_overriding_options: which policies parameters may override.

        Raises:
            InvalidTopicNameException: the name is not allowed.
            NoTypeSupportImportedException: the class is none of messages.
        """
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
        """Subscribe to a topic.

        Args:
            msg_type: class of the messages.
            topic: relative, private (~/…) or absolute name.
            callback: takes a message, or a message and a dict about where it came from.
            qos_profile: quality of service, or the depth of a reliable history.
            callback_group: the node's default when None.
            qos_overriding_options: which policies parameters may override.
            raw: whether the callback takes serialized messages.

        Raises:
            InvalidTopicNameException: the name is not allowed.
            NoTypeSupportImportedException: the class is none of messages.
        """
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
        """Use a service; raises InvalidServiceNameException when the name is not allowed."""
        _require_service_class(srv_type)
        full_name = self._rcl_full_or_refused(srv_name, is_service=True)
        group = callback_group or self._default_callback_group
        client = Client(
            self._context, self._rcl_link, srv_type, srv_name, full_name, qos_profile, group
        )
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
        """Offer a service; raises InvalidServiceNameException when the name is not allowed.

        The callback takes a request and an empty response, and returns the response.
        """
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

    def resolve_topic_name(self, topic: str, *, only_expand: bool = False) -> str:
        """The absolute name that a topic has for this node, remapped unless `only_expand`."""
        raise NotImplementedError

    def resolve_service_name(self, service: str, *, only_expand: bool = False) -> str:
        """The absolute name that a service has for this node, remapped unless `only_expand`."""
        raise NotImplementedError

    def _rcl_entities(self) -> Iterator[Any]:
        """What executors run, in the order in which rclpy looks at it."""
        return chain(
            list(self._timers),
            list(self._subscriptions),
            list(self._guards),
            list(self._clients),
            list(self._services),
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
        kinds: tuple[list[Any], ...] = (
            self._publishers,
            self._subscriptions,
            self._clients,
            self._services,
            self._timers,
            self._guards,
        )
        for entities in kinds:
            for entity in list(entities):
                self._rcl_destroy(entity, entities)

    def _rcl_changed(self) -> None:
        """Tell others which endpoints this node has now, and the executor to look anew."""
        owners: Iterator[Any] = chain(
            self._publishers,
            self._subscriptions,
            self._clients,
            self._services,
            [self._rcl_rosout.publisher] if self._rcl_rosout else [],
        )
        gids = [owner._gids for owner in owners]
        readers = [gid for ours, _ in gids for gid in ours]
        writers = [gid for _, ours in gids for gid in ours]
        if (readers, writers) != (self._rcl_local_node.readers, self._rcl_local_node.writers):
            self._rcl_local_node.readers, self._rcl_local_node.writers = readers, writers
            self._rcl_context_handle.announce()
        self._rcl_wake_executor()

    def _rcl_wake_executor(self) -> None:
        raise NotImplementedError

    def _rcl_full_or_refused(self, name: str, is_service: bool = False) -> str:
        """The absolute, remapped name, or the error that says what is wrong with the given one."""
        try:
            if is_service:
                return self.resolve_service_name(name)
            return self.resolve_topic_name(name)
        except RuntimeError:
            require_topic_name(name, is_service=is_service)
            full_name = expand(name, self._rcl_name, self._rcl_namespace)
            require_full_name(full_name, is_service=is_service)
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
