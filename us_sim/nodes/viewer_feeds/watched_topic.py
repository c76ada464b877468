"""A topic that is subscribed to while a page watches what is made of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.qos import QoSProfile

from us_sim.nodes.guarded_node import GuardedNode, decoded
from us_sim.nodes.posted import Posted
from us_sim.nodes.qos import STREAM
from us_sim.viewer.feed import Feed
from us_sim.viewer.packet import Packet

Make = Callable[[Any, int], Packet]
MakeOrWait = Callable[[Any, int], Packet | None]


def made_of(
    node: GuardedNode, message_type: Any, topic: str, data: bytes, make: Callable[[Any], Any]
) -> Any:
    """What ``make`` makes of a message's bytes; None, and said by the node, where it refuses it."""
    made: list[Any] = []
    take = decoded(message_type, lambda message: made.append(make(message)))
    node.guarded(node.resolve_topic_name(topic), take)(data)
    return made[0] if made else None


class WatchedTopic:
    """Feeds a stream with the messages of a topic.

    What comes is kept as bytes; only what a page takes is decoded and made into a packet, in the
    page's thread. What cannot be used is said by the node.

    Args:
        node: that subscribes.
        post: has work done in the node's thread.
        message_type: of the topic.
        topic: its name.
        make: the packet of a message and a number, or None while there is none to be made; what
            it raises refuses the message.
        kind: the stream's name.
        rate: Hz, at most, for each page; None is all.
        qos: of the subscription.
    """

    def __init__(
        self,
        node: GuardedNode,
        post: Posted,
        message_type: Any,
        topic: str,
        make: MakeOrWait,
        kind: str,
        rate: float | None,
        qos: QoSProfile = STREAM,
    ) -> None:
        self.feed = Feed(kind, lambda _: post(self._subscribe), rate)
        self._node = node
        self._type, self._topic, self._qos = message_type, topic, qos
        self._make = make
        self._subscription: Any = None

    def _subscribe(self) -> None:
        """As it is now: it may have changed again since."""
        if self.feed.is_watched and self._subscription is None:
            self._subscription = self._node.create_subscription(
                self._type, self._topic, self._take, self._qos, raw=True
            )
        elif not self.feed.is_watched and self._subscription is not None:
            self._node.destroy_subscription(self._subscription)
            self._subscription = None

    def _take(self, data: bytes) -> None:
        def pack(sequence: int) -> Packet | None:
            packet: Packet | None = made_of(
                self._node,
                self._type,
                self._topic,
                data,
                lambda message: self._make(message, sequence),
            )
            return packet

        self.feed.offer(pack)
