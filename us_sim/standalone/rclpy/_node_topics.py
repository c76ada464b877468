"""The publishers and subscriptions of a node."""

from collections.abc import Callable, Iterator
from typing import Any

from . import qos_overriding_options as overriding
from ._endpoints import PublisherHandle, SubscriptionHandle
from ._node_declarations import NodeDeclarations
from ._node_parts import NodeParts
from ._type_support import require_message_class
from .callback_groups import CallbackGroup
from .event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from .publisher import Publisher
from .qos import QoSProfile
from .qos_overriding_options import QoSOverridingOptions
from .subscription import Subscription

__all__ = ["NodeTopics", "profile_of"]


class NodeTopics(NodeParts, NodeDeclarations):
    """Makes, lists and destroys publishers and subscriptions."""

    def __init__(self) -> None:
        super().__init__()
        self._publishers: list[Publisher] = []
        self._subscriptions: list[Subscription] = []

    @property
    def publishers(self) -> Iterator[Publisher]:
        yield from self._publishers

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        yield from self._subscriptions

    def create_publisher(
        self,
        msg_type: Any,
        topic: str,
        qos_profile: QoSProfile | int,
        *,
        callback_group: CallbackGroup | None = None,
        event_callbacks: PublisherEventCallbacks | None = None,
        qos_overriding_options: QoSOverridingOptions | None = None,
        publisher_class: type[Publisher] = Publisher,
    ) -> Publisher:
        """Publish a topic.

        Args:
            msg_type: class of the messages.
            topic: relative, private (~/…) or absolute name.
            qos_profile: quality of service, or the depth of a reliable history.
            callback_group: of the event callbacks; the node's default when None.
            event_callbacks: what to call when subscriptions match, and the like.
            qos_overriding_options: which policies parameters may override.
            publisher_class: to be instantiated.

        Raises:
            InvalidTopicNameException: the name is not allowed.
            NoTypeSupportImportedException: the class is none of messages.
        """
        qos = profile_of(qos_profile)
        full_name = self._resolved(topic)
        require_message_class(msg_type)
        qos = overriding._overridden("publisher", self, full_name, qos, qos_overriding_options)
        handle = PublisherHandle(self._link, msg_type, full_name, qos)
        try:
            publisher = publisher_class(
                handle,
                msg_type,
                topic,
                qos,
                event_callbacks=event_callbacks or PublisherEventCallbacks(),
                callback_group=callback_group or self._default_callback_group,
            )
        except Exception:
            handle.destroy()
            raise
        self._publishers.append(publisher)
        self._waitables.extend(publisher.event_handlers)
        handle.listen()
        self._local_node.writers.append(handle.gid)
        self._joined()
        return publisher

    def create_subscription(
        self,
        msg_type: Any,
        topic: str,
        callback: Callable[..., Any],
        qos_profile: QoSProfile | int,
        *,
        callback_group: CallbackGroup | None = None,
        event_callbacks: SubscriptionEventCallbacks | None = None,
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
            event_callbacks: what to call when publishers match, and the like.
            qos_overriding_options: which policies parameters may override.
            raw: whether the callback takes serialized messages.

        Raises:
            InvalidTopicNameException: the name is not allowed.
            NoTypeSupportImportedException: the class is none of messages.
        """
        qos = profile_of(qos_profile)
        full_name = self._resolved(topic)
        require_message_class(msg_type)
        qos = overriding._overridden("subscription", self, full_name, qos, qos_overriding_options)
        group = callback_group or self._default_callback_group
        handle = SubscriptionHandle(self._link, msg_type, full_name, qos)
        try:
            subscription = Subscription(
                handle,
                msg_type,
                topic,
                callback,
                group,
                qos,
                raw,
                event_callbacks=event_callbacks or SubscriptionEventCallbacks(),
            )
        except Exception:
            handle.destroy()
            raise
        group.add_entity(subscription)
        self._subscriptions.append(subscription)
        self._waitables.extend(subscription.event_handlers)
        handle.listen()
        self._local_node.readers.append(handle.gid)
        self._joined()
        return subscription

    def destroy_publisher(self, publisher: Publisher) -> bool:
        """Stop publishing; False when it is none of this node's."""
        if not self._destroy(publisher, self._publishers):
            return False
        self._forget_events(publisher.event_handlers)
        self._local_node.writers.remove(publisher.handle.gid)
        self._joined()
        return True

    def destroy_subscription(self, subscription: Subscription) -> bool:
        """Stop subscribing; False when it is none of this node's."""
        if not self._destroy(subscription, self._subscriptions):
            return False
        self._forget_events(subscription.event_handlers)
        self._local_node.readers.remove(subscription.handle.gid)
        self._joined()
        return True

    def _forget_events(self, handlers: list[Any]) -> None:
        self._waitables = [waitable for waitable in self._waitables if waitable not in handlers]


def profile_of(qos_or_depth: Any) -> QoSProfile:
    if isinstance(qos_or_depth, QoSProfile):
        return qos_or_depth
    if not isinstance(qos_or_depth, int):
        raise TypeError(f"Expected QoSProfile or int, but received {type(qos_or_depth)!r}")
    if qos_or_depth < 0:
        raise ValueError("history depth must be greater than or equal to zero")
    return QoSProfile(depth=qos_or_depth)
