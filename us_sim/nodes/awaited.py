"""What must be there before a recording is played."""

from __future__ import annotations

from rclpy.node import Node

from us_sim.nodes.parameters import declared
from us_sim.nodes.session_settings import AwaitedSettings

__all__ = ["Awaited"]


class Awaited:
    """The node's parameters of `AwaitedSettings`, and whether they are met.

    Each of the topics must have a publisher and, where a node is named, that node among its
    subscribers.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        settings = declared(node, AwaitedSettings())
        self._topics, self._subscriber = settings.await_topics, settings.await_subscriber

    def are_there(self) -> bool:
        """Whether playing can begin, as far as this goes."""
        return all(map(self._is_there, self._topics))

    def _is_there(self, topic: str) -> bool:
        node = self._node
        if not node.count_publishers(topic):
            return False
        listeners = node.get_subscriptions_info_by_topic(node.resolve_topic_name(topic))
        return not self._subscriber or self._subscriber in {info.node_name for info in listeners}
