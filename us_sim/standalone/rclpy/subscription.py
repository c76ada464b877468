"""Subscriptions: made by `Node.create_subscription`."""

import inspect
from collections.abc import Callable
from enum import Enum
from functools import partial
from typing import Any

from ._endpoints import NodeLink, Receiver, message_of, open_endpoint
from .callback_groups import CallbackGroup
from .qos import QoSProfile


class Subscription(Receiver):
    """Calls back with each message that is received on one topic."""

    topic_name = Receiver._existing_name

    class CallbackType(Enum):
        """Whether a callback takes the message only, or also where it came from."""

        MessageOnly = 0
        WithMessageInfo = 1

    def __init__(
        self,
        link: NodeLink,
        msg_type: Any,
        topic: str,
        full_name: str,
        callback: Callable[..., Any],
        callback_group: CallbackGroup,
        qos_profile: QoSProfile,
        raw: bool,
    ) -> None:
        self.callback = callback
        reader = open_endpoint("subscription", link, msg_type, topic, full_name, qos_profile)
        super().__init__(link, full_name, reader, qos_profile, callback_group)
        self.msg_type = msg_type
        self.topic = topic
        self.raw = raw

    def get_publisher_count(self) -> int:
        """How many publishers are connected."""
        self._require_existence()
        return self._endpoint.matched_count()

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

    def _call_for(self, data: bytes, info: Any) -> Callable[[], Any]:
        message = data if self.raw else message_of(data, self.msg_type)
        if self._callback_type is Subscription.CallbackType.MessageOnly:
            return partial(self.callback, message)
        origin = {
            "source_timestamp": info.source_timestamp,
            "received_timestamp": info.received_timestamp,
            "publication_sequence_number": None,
            "reception_sequence_number": None,
        }
        return partial(self.callback, message, origin)
