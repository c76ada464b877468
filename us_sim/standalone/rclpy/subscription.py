"""Subscriptions: made by `Node.create_subscription`."""

import inspect
from collections.abc import Callable
from enum import Enum
from typing import Any

from .callback_groups import CallbackGroup
from .event_handler import SubscriptionEventCallbacks
from .qos import QoSProfile

__all__ = ["Subscription"]


class Subscription:
    """Calls back with each message that is received on one topic."""

    class CallbackType(Enum):
        """Whether a callback takes the message only, or also where it came from."""

        MessageOnly = 0
        WithMessageInfo = 1

    def __init__(
        self,
        subscription_impl: Any,
        msg_type: Any,
        topic: str,
        callback: Callable[..., Any],
        callback_group: CallbackGroup,
        qos_profile: QoSProfile,
        raw: bool,
        event_callbacks: SubscriptionEventCallbacks,
    ) -> None:
        self._subscription = subscription_impl
        self.msg_type = msg_type
        self.topic = topic
        self.callback = callback
        self.callback_group = callback_group
        self._executor_event = False
        self.qos_profile = qos_profile
        self.raw = raw
        self.event_handlers = event_callbacks.create_event_handlers(
            callback_group, subscription_impl, topic
        )

    def get_publisher_count(self) -> int:
        """How many publishers are connected."""
        return self._subscription.get_publisher_count()

    @property
    def handle(self) -> Any:
        return self._subscription

    def destroy(self) -> None:
        """Leave the topic; use `Node.destroy_subscription`."""
        for handler in self.event_handlers:
            handler.destroy()
        self._subscription.destroy()

    @property
    def topic_name(self) -> str:
        return self._subscription.get_topic_name()

    @property
    def callback(self) -> Callable[..., Any]:
        return self._callback

    @callback.setter
    def callback(self, value: Callable[..., Any]) -> None:
        for kind, arguments in (
            (Subscription.CallbackType.MessageOnly, (None,)),
            (Subscription.CallbackType.WithMessageInfo, (None, None)),
        ):
            try:
                inspect.signature(value).bind(*arguments)
            except TypeError:
                continue
            self._callback = value
            self._callback_type = kind
            return
        raise RuntimeError(
            "Subscription.__init__(): callback should be either be callable with one argument"
            "(to get only the message) or two (to get message and message info)"
        )
