"""Subscriptions: made by `Node.create_subscription`."""

import inspect
from collections.abc import Callable
from enum import Enum
from functools import partial
from typing import Any

from ._endpoints import Inbox, NodeLink, Receiver, message_of, open_reader
from .callback_groups import CallbackGroup
from .qos import QoSProfile

__all__ = ["Subscription"]


class Subscription(Receiver):
    """Calls back with each message that is received on one topic."""

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
        self._reader = open_reader(link, msg_type, topic, full_name, qos_profile)
        self._inbox = Inbox(self._reader.take, link.wake)
        self._reader.on_data = self._inbox.notify
        self._full_name = full_name
        self._gids: tuple[list[bytes], list[bytes]] = [self._reader.gid], []
        self.msg_type = msg_type
        self.topic = topic
        self.callback_group = callback_group
        self.qos_profile = qos_profile
        self.raw = raw

    def get_publisher_count(self) -> int:
        """How many publishers are connected."""
        self._require_existence()
        return self._reader.matched_count()

    def destroy(self) -> None:
        """Leave the topic; use `Node.destroy_subscription`."""
        super().destroy()
        self._reader.close()

    @property
    def topic_name(self) -> str:
        self._require_existence()
        return self._full_name

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

    def _take(self) -> Callable[[], Any] | None:
        """The call to be made for the oldest message that is waiting."""
        self._require_existence()
        taken = self._inbox.take()
        if taken is None:
            return None
        data, sample = taken
        message = data if self.raw else message_of(data, self.msg_type)
        if self._callback_type is Subscription.CallbackType.MessageOnly:
            return partial(self.callback, message)
        info = {
            "source_timestamp": sample.source_timestamp,
            "received_timestamp": sample.received_timestamp,
            "publication_sequence_number": None,
            "reception_sequence_number": None,
        }
        return partial(self.callback, message, info)
