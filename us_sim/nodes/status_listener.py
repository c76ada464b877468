"""Hears what nodes say of themselves, and the force on the probe, while pages show it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import WrenchStamped

from us_sim.nodes.guarded_node import GuardedNode, shown
from us_sim.nodes.qos import STREAM
from us_sim.viewer.status import Level, NodeStatus, StatusBoard

LEVELS = {
    DiagnosticStatus.OK: Level.WELL,
    DiagnosticStatus.WARN: Level.WARNING,
    DiagnosticStatus.ERROR: Level.ERROR,
    DiagnosticStatus.STALE: Level.WARNING,
}


class StatusListener:
    """Fills a board from ``diagnostics``, and from ``probe/wrench`` while the force is plotted.

    Args:
        node: that listens.
        post: has work done in the thread that spins ``node``.
    """

    def __init__(self, node: GuardedNode, post: Callable[[Callable[[], Any]], Any]) -> None:
        self._node = node
        self._space = f"{node.get_namespace().rstrip('/')}/"
        self._subscriptions: dict[str, Any] = {}
        self.board = StatusBoard(lambda: post(self._subscribe))

    def _subscribe(self) -> None:
        """As pages look now."""
        board = self.board
        self._keep("diagnostics", board.is_watched, DiagnosticArray, self._hear)
        self._keep("probe/wrench", board.is_force_watched, WrenchStamped, self._feel)

    def _keep(self, topic: str, wanted: bool, message_type: Any, callback: Any) -> None:
        if wanted and topic not in self._subscriptions:
            self._subscriptions[topic] = self._node.create_subscription(
                message_type, topic, callback, STREAM
            )
        elif not wanted and topic in self._subscriptions:
            self._node.destroy_subscription(self._subscriptions.pop(topic))

    def _hear(self, message: DiagnosticArray) -> None:
        now = time.monotonic()
        for status in message.status:
            level = LEVELS.get(status.level, Level.ERROR)
            values = {each.key: shown(each.value) for each in status.values}
            name = shown(status.name).removeprefix(self._space)
            self.board.tell(NodeStatus(name, level, shown(status.message), values), now)

    def _feel(self, message: WrenchStamped) -> None:
        force = message.wrench.force
        self.board.feel((force.x**2 + force.y**2 + force.z**2) ** 0.5, time.monotonic())
