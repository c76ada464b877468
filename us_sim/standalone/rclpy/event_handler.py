"""Callbacks for what happens to an endpoint: somebody matches, a deadline passes, and the like.

Types that differ are not reported; asking for that event raises UnsupportedEventTypeError, as
rclpy does where the middleware does not have it.
"""

import inspect
import threading
from collections.abc import Callable
from typing import Any

from ._endpoint_events import (
    REPORTS,
    QoSLivelinessChangedInfo,
    QoSLivelinessLostInfo,
    QoSMessageLostInfo,
    QoSOfferedDeadlineMissedInfo,
    QoSOfferedIncompatibleQoSInfo,
    QoSPublisherEventType,
    QoSPublisherMatchedInfo,
    QoSRequestedDeadlineMissedInfo,
    QoSRequestedIncompatibleQoSInfo,
    QoSSubscriptionEventType,
    QoSSubscriptionMatchedInfo,
)
from ._rclpy_pybind11 import UnsupportedEventTypeError
from .callback_groups import CallbackGroup
from .logging import get_logger
from .qos import qos_policy_name_from_kind
from .waitable import Waitable

__all__ = [
    "EventHandler",
    "PublisherEventCallbacks",
    "QoSLivelinessChangedInfo",
    "QoSLivelinessLostInfo",
    "QoSMessageLostInfo",
    "QoSOfferedDeadlineMissedInfo",
    "QoSOfferedIncompatibleQoSInfo",
    "QoSPublisherEventType",
    "QoSPublisherMatchedInfo",
    "QoSRequestedDeadlineMissedInfo",
    "QoSRequestedIncompatibleQoSInfo",
    "QoSSubscriptionEventType",
    "QoSSubscriptionMatchedInfo",
    "SubscriptionEventCallbacks",
    "UnsupportedEventTypeError",
]


class EventHandler(Waitable):
    """Calls back in an executor what the transport reports about one endpoint."""

    def __init__(
        self,
        *,
        callback_group: CallbackGroup,
        callback: Callable[..., Any],
        event_type: Any,
        parent_impl: Any,
    ):
        if event_type not in REPORTS:
            raise UnsupportedEventTypeError(
                f"failed to create event: {event_type.name} is not reported by this middleware"
            )
        super().__init__(callback_group)
        self.callback = callback
        self.event_type = event_type
        self._lock = threading.Lock()
        self._data: Any = None
        self._parent = parent_impl
        self._kind, self._report = REPORTS[event_type]
        parent_impl.add_event_listener(self._kind, self._happened)

    def _happened(self, event: Any) -> None:
        data = self._report(event)
        with self._lock:
            self._data = data if self._data is None else _accumulated(self._data, data)

    def is_ready(self, wait_set):  # noqa: ARG002
        return self._data is not None

    def take_data(self):
        with self._lock:
            data, self._data = self._data, None
        return data

    async def execute(self, taken_data):
        if taken_data is not None:
            result = self.callback(taken_data)
            if inspect.isawaitable(result):
                await result

    def destroy(self):
        """Be told of nothing more."""
        self._parent.remove_event_listener(self._kind)


def _accumulated(earlier: Any, later: Any) -> Any:
    """One report for two that came before anybody looked: the changes add up."""
    changes = {
        name: getattr(earlier, name) + value
        for name, value in vars(later).items()
        if name.endswith("_change")
    }
    return type(later)(**{**vars(later), **changes})


class SubscriptionEventCallbacks:
    """What to call when something happens to a subscription."""

    def __init__(
        self,
        *,
        deadline: Callable[..., None] | None = None,
        incompatible_qos: Callable[..., None] | None = None,
        liveliness: Callable[..., None] | None = None,
        message_lost: Callable[..., None] | None = None,
        incompatible_type: Callable[..., None] | None = None,
        matched: Callable[..., None] | None = None,
        use_default_callbacks: bool = True,
    ) -> None:
        self.deadline = deadline
        self.incompatible_qos = incompatible_qos
        self.liveliness = liveliness
        self.message_lost = message_lost
        self.incompatible_type = incompatible_type
        self.matched = matched
        self.use_default_callbacks = use_default_callbacks

    def create_event_handlers(
        self, callback_group: CallbackGroup, subscription: Any, topic_name: str
    ) -> list[EventHandler]:
        """Handlers for the callbacks that were given, and a warning for qualities that differ."""
        kind = QoSSubscriptionEventType
        wanted: dict[Any, Callable[..., None] | None] = {
            kind.RCL_SUBSCRIPTION_REQUESTED_DEADLINE_MISSED: self.deadline,
            kind.RCL_SUBSCRIPTION_REQUESTED_INCOMPATIBLE_QOS: self.incompatible_qos
            or self._warning(
                subscription.logger_name,
                f"New publisher discovered on topic '{topic_name}', offering incompatible QoS. "
                "No messages will be received from it. Last incompatible policy: ",
            ),
            kind.RCL_SUBSCRIPTION_LIVELINESS_CHANGED: self.liveliness,
            kind.RCL_SUBSCRIPTION_MESSAGE_LOST: self.message_lost,
            kind.RCL_SUBSCRIPTION_INCOMPATIBLE_TYPE: self.incompatible_type,
            kind.RCL_SUBSCRIPTION_MATCHED: self.matched,
        }
        return _handlers(wanted, callback_group, subscription)

    def _warning(self, logger_name: str, text: str) -> Callable[..., None] | None:
        return _warn_about(logger_name, text) if self.use_default_callbacks else None


class PublisherEventCallbacks:
    """What to call when something happens to a publisher."""

    def __init__(
        self,
        *,
        deadline: Callable[..., None] | None = None,
        liveliness: Callable[..., None] | None = None,
        incompatible_qos: Callable[..., None] | None = None,
        incompatible_type: Callable[..., None] | None = None,
        matched: Callable[..., None] | None = None,
        use_default_callbacks: bool = True,
    ) -> None:
        self.deadline = deadline
        self.liveliness = liveliness
        self.incompatible_qos = incompatible_qos
        self.incompatible_type = incompatible_type
        self.matched = matched
        self.use_default_callbacks = use_default_callbacks

    def create_event_handlers(
        self, callback_group: CallbackGroup, publisher: Any, topic_name: str
    ) -> list[EventHandler]:
        """Handlers for the callbacks that were given, and a warning for qualities that differ."""
        kind = QoSPublisherEventType
        wanted: dict[Any, Callable[..., None] | None] = {
            kind.RCL_PUBLISHER_OFFERED_DEADLINE_MISSED: self.deadline,
            kind.RCL_PUBLISHER_LIVELINESS_LOST: self.liveliness,
            kind.RCL_PUBLISHER_OFFERED_INCOMPATIBLE_QOS: self.incompatible_qos
            or self._warning(
                publisher.logger_name,
                f"New subscription discovered on topic '{topic_name}', requesting incompatible "
                "QoS. No messages will be sent to it. Last incompatible policy: ",
            ),
            kind.RCL_PUBLISHER_INCOMPATIBLE_TYPE: self.incompatible_type,
            kind.RCL_PUBLISHER_MATCHED: self.matched,
        }
        return _handlers(wanted, callback_group, publisher)

    def _warning(self, logger_name: str, text: str) -> Callable[..., None] | None:
        return _warn_about(logger_name, text) if self.use_default_callbacks else None


def _handlers(
    wanted: dict[Any, Callable[..., None] | None], group: CallbackGroup, parent: Any
) -> list[EventHandler]:
    return [
        EventHandler(
            callback_group=group, callback=callback, event_type=event_type, parent_impl=parent
        )
        for event_type, callback in wanted.items()
        if callback is not None
    ]


def _warn_about(logger_name: str, text: str) -> Callable[..., None]:
    logger = get_logger(logger_name)

    def warn(event: QoSRequestedIncompatibleQoSInfo) -> None:
        logger.warning(text + qos_policy_name_from_kind(event.last_policy_kind))

    return warn
