"""Monitoring of a session's nodes by their reports on `diagnostics`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray

from us_sim.nodes.guarded_node import GuardedNode, Health
from us_sim.nodes.qos import EVERY
from us_sim.nodes.settings import RECORDER

TOLD = 50  # losses that a report lists, the newest


class SessionMonitor(GuardedNode):
    """Keeps the reports of each of ``nodes``, by its name without namespace."""

    def __init__(self, nodes: Collection[str] = (), **kwargs: Any) -> None:
        super().__init__("session_monitor", **kwargs)
        self._nodes = frozenset(nodes)
        self.reports: dict[str, dict[str, str]] = {}  # values of each node's last report
        self.messages: dict[str, str] = {}  # messages of these reports
        self.heard: Counter[tuple[str, int]] = Counter()  # reports by node and process
        self.recordings: dict[str, int] = {}  # processes by the files that they record
        self._published: dict[tuple[str, int], dict[str, int]] = {}
        self.health = Health(self, "")
        self.health.state = "following"
        self.subscribe(DiagnosticArray, "diagnostics", self._on_diagnostics, EVERY)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            name = status.name.rsplit("/", 1)[-1]
            if name not in self._nodes:
                continue
            report = {item.key: item.value for item in status.values}
            self.reports[name] = report
            self.messages[name] = status.message
            process = name, _number(report.get("pid", ""))
            self.heard[process] += 1
            if name == RECORDER and "file" in report:
                self.recordings.setdefault(report["file"], process[1])
            self._published[process] = {
                key.removeprefix("published "): _number(value)
                for key, value in report.items()
                if key.startswith("published ") or key == "dropped"
            }

    def follow_nodes(self, nodes: Collection[str]) -> None:
        """Follow these nodes from now on."""
        self._nodes = frozenset(nodes)
        for name in self.reports.keys() - self._nodes:
            del self.reports[name], self.messages[name]

    def report_losses(self, losses: Sequence[str]) -> None:
        """Report all losses so far, each a sentence, at once and from now on."""
        first = max(len(losses) - TOLD, 0)
        listed = {f"lost {i}": text for i, text in enumerate(losses[first:], first + 1)}
        self.health.values = {"lost": str(len(losses)), **listed}
        self.health.warning = losses[-1]
        self.health.publish_report()

    def count_messages(self, node: str, topic: str) -> int:
        """Count what a node published on ``topic``, or "dropped", also by earlier processes."""
        return sum(
            counts.get(topic, 0) for (name, _), counts in self._published.items() if name == node
        )


def _number(text: str) -> int:
    """Return the number in a stranger's report, or 0."""
    return int(text) if text.isdecimal() and len(text) < 20 else 0
