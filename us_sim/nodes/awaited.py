"""What must be there before a recording is played."""

from __future__ import annotations

import time

from rclpy.publisher import Publisher

from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.parameters import declared
from us_sim.nodes.session_settings import AwaitedSettings

CHECK_S, CHECKS = 0.05, 6
"""How often it is looked, and how often in a row everything must be there.

A best-effort subscriber may find a publisher a little later than it is found itself.
"""
PATIENCE_S = 5.0
"""After so long it is said what is waited for."""
RECORDER = "session_recorder"


class Awaited:
    """Waits for what the node's parameters of `AwaitedSettings` name, and for a subscriber.

    After a while what is missing is said, and told in diagnostics as ``awaited``.

    Args:
        node: that plays.
        publisher: to which somebody must have subscribed.
    """

    def __init__(self, node: GuardedNode, publisher: Publisher) -> None:
        self._node, self._publisher = node, publisher
        self._settings = declared(node, AwaitedSettings())
        self._checks = 0
        self._since = 0.0  # s, monotonic; when it was first looked
        self._told = ""

    def has_come(self) -> bool:
        """Whether playing can begin; asked every `CHECK_S`."""
        missing = self._missing()
        self._checks = 0 if missing else self._checks + 1
        if self._checks >= CHECKS:
            self._node.health.values.pop("awaited", None)
            return True
        now = time.monotonic()
        self._since = self._since or now
        if missing and missing != self._told and now - self._since > PATIENCE_S:
            self._told = self._node.health.values["awaited"] = missing
            self._node.get_logger().warning(f"nothing is played yet: waiting for {missing}")
        return False

    def _missing(self) -> str:
        """The first that is not there; nothing when all are."""
        node = self._node
        if not self._publisher.get_subscription_count():
            return f"somebody to subscribe to {self._publisher.topic_name}"
        for topic in self._settings.await_topics:
            if not node.count_publishers(topic):
                return f"{node.resolve_topic_name(topic)} to be published"
        for topic in map(node.resolve_topic_name, self._settings.await_recorded):
            listeners = node.get_subscriptions_info_by_topic(topic)
            if RECORDER not in {info.node_name for info in listeners}:
                return f"{RECORDER} to subscribe to {topic}"
        return ""
