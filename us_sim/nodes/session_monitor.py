"""Follows what the nodes of a session report on `diagnostics`."""

from __future__ import annotations

from typing import Any

from diagnostic_msgs.msg import DiagnosticArray

from us_sim.nodes.guarded_node import GuardedNode
from us_sim.nodes.qos import EVERY

__all__ = ["SessionMonitor"]


class SessionMonitor(GuardedNode):
    """Keeps the last report of each node, by its name without namespace."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("session_monitor", **kwargs)
        self.reports: dict[str, dict[str, str]] = {}
        self.messages: dict[str, str] = {}
        self.create_subscription(DiagnosticArray, "diagnostics", self._take, EVERY)

    def _take(self, message: DiagnosticArray) -> None:
        for status in message.status:
            name = status.name.rsplit("/", 1)[-1]
            self.reports[name] = {item.key: item.value for item in status.values}
            self.messages[name] = status.message

    def count(self, node: str, topic: str) -> int:
        """How many messages ``node`` says it has published (or recorded) on ``topic``."""
        return int(self.reports.get(node, {}).get(f"published {topic}", 0))
