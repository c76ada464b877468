"""Recording of a topic: serialized messages, with the quality that its publishers offer."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from rclpy.event_handler import QoSMessageLostInfo, SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rosbags.interfaces import Qos, QosDurability, QosReliability

from us_sim.errors import BagError
from us_sim.nodes.guarded_node import GuardedNode
from us_sim.recording.schemas import make_schema

QUEUE = 1000  # messages that may wait for the executor


class RecordedTopic:
    """Takes every message of a topic, from all present and later publishers.

    If a publisher comes that cannot serve the subscription, a weaker one takes its place; messages
    sent before that are missing.

    Args:
        node: that subscribes.
        name: of the topic, in full.
        type_name: of its messages.
        offered: quality of service of its publishers.
        take: called with the topic's name, a serialized message, and rclpy's facts about it.
        lost: called with the topic's name and a number of messages that did not come.
    """

    def __init__(
        self,
        node: GuardedNode,
        name: str,
        type_name: str,
        offered: list[Qos],
        take: Callable[[str, bytes, Mapping[str, Any]], None],
        lost: Callable[[str, int], None],
    ) -> None:
        self.name, self.type_name = name, type_name
        self._node, self._type = node, message_type(type_name)
        self._take, self._lost = take, lost
        self._offered = dict.fromkeys(offered)
        self._adopted = _choose_qos(self._offered)
        self._publishers = len(offered)
        self._sequence: int | None = None
        self._subscription = self._subscribe()

    @property
    def is_latched(self) -> bool:
        """True if its publishers keep messages for later subscribers."""
        return self._adopted.durability == DurabilityPolicy.TRANSIENT_LOCAL

    def adopt_offers(self, offered: list[Qos]) -> list[Qos]:
        """Follow the qualities that publishers offer now; return those that are new."""
        if len(offered) != self._publishers:
            self._publishers, self._sequence = len(offered), None
        new = [profile for profile in dict.fromkeys(offered) if profile not in self._offered]
        self._offered |= dict.fromkeys(new)
        adopted = _choose_qos(self._offered)
        if adopted != self._adopted:
            self.take_remaining()
            self._node.destroy_subscription(self._subscription)
            self._adopted, self._sequence = adopted, None
            self._subscription = self._subscribe()
        return new

    def take_remaining(self) -> None:
        """Take the messages that wait for the executor, also after ROS was shut down."""
        handle = self._subscription.handle
        with handle:
            while taken := handle.take_message(self._type, True):
                self._receive(*taken)

    def _subscribe(self) -> Subscription:
        events = SubscriptionEventCallbacks(message_lost=self._count_lost)
        return self._node.create_subscription(
            self._type,
            self.name,
            self._node.guard_callback(self.name, self._receive_all),
            self._adopted,
            raw=True,
            event_callbacks=events,
        )

    def _receive_all(self, data: bytes, info: Mapping[str, Any]) -> None:
        """Take this message and all that wait behind it, which costs less than a turn for each."""
        self._receive(data, info)
        self.take_remaining()

    def _receive(self, data: bytes, info: Mapping[str, Any]) -> None:
        self._count(info.get("publication_sequence_number"))
        self._take(self.name, data, info)

    def _count(self, sequence: int | None) -> None:
        """Count messages that are missing in the numbers of the only publisher.

        These show every loss, also in the queue of the subscription. But not every middleware gives
        numbers, and several publishers' mix: a number that is lower is of another publisher, which
        the graph will show later.
        """
        if sequence is None or self._publishers != 1:
            return
        if self._sequence is not None and sequence < self._sequence:
            self._publishers = 0
            return
        if self._sequence is not None and sequence > self._sequence + 1:
            self._lost(self.name, sequence - self._sequence - 1)
        self._sequence = sequence

    def _count_lost(self, status: QoSMessageLostInfo) -> None:
        """Count the losses that the middleware reports, if there are no numbers."""
        if self._publishers != 1 or self._sequence is None:
            self._lost(self.name, status.total_count_change)


def _choose_qos(offered: Iterable[Qos]) -> QoSProfile:
    """Choose the quality of service that every publisher can serve, as rosbag2 does."""
    offered = list(offered)
    reliable = all(q.reliability == QosReliability.RELIABLE for q in offered)
    latched = all(q.durability == QosDurability.TRANSIENT_LOCAL for q in offered)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=QUEUE,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


_MESSAGE_TYPE = re.compile(r"([a-z][a-z0-9_]*)/msg/([A-Z][A-Za-z0-9]*)")
"""Pattern of a message type's name in ROS 2."""


def message_type(name: str) -> Any:
    """Import the class of a message type; only names with a known definition are imported.

    Raises:
        BagError: it is no message type's name, has no definition here, or its package for Python
            is not installed.
    """
    match = _MESSAGE_TYPE.fullmatch(name)
    if match is None:
        shown = name if len(name) < 100 else f"{name[:100]}…"
        raise BagError(f"{shown!r} is no message type of ROS 2")
    make_schema(name)
    package, short = match.groups()
    try:
        return getattr(importlib.import_module(f"{package}.msg"), short)
    except (ImportError, AttributeError):
        raise BagError(
            f"message type {name} cannot be imported: install the ROS 2 package {package} and "
            f"source its setup file"
        ) from None
