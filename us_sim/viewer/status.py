"""The status that every node last reported.

>>> from us_sim.viewer.status import NodeLevel, NodeStatus, StatusBoard
>>> board = StatusBoard()
>>> status = NodeStatus("tissue_deformer", NodeLevel.WELL, "fem", {"rate_hz": "59.9"})
>>> board.add_report(status, now=10.0)
>>> board.list_nodes(now=11.0)[0].read_number("rate_hz"), board.list_nodes(now=15.0)[0].level
(59.9, <NodeLevel.GONE: 'gone'>)
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus

from us_sim.nodes.guarded_node import GuardedNode, Subscriptions, loggable_text
from us_sim.nodes.qos import STREAM

GONE_S = 3.0  # without a report, after which a node counts as gone: each reports every second
FORGOTTEN_S = 60.0  # without a report, after which a node is no longer listed


class NodeLevel(Enum):
    """Health of a node."""

    WELL = "well"
    WARNING = "warning"
    ERROR = "error"
    GONE = "gone"


_LEVELS = {DiagnosticStatus.OK: NodeLevel.WELL, DiagnosticStatus.WARN: NodeLevel.WARNING}
_LEVELS |= {DiagnosticStatus.ERROR: NodeLevel.ERROR, DiagnosticStatus.STALE: NodeLevel.WARNING}


@dataclass(frozen=True)
class NodeStatus:
    """A node's report of itself."""

    name: str
    level: NodeLevel
    message: str  # its state, or its problem
    values: Mapping[str, str] = field(default_factory=dict)  # as in its diagnostics
    heard: float = 0.0  # s, monotonic
    problem: str = ""  # the last problem, in a sentence
    problem_kind: str = ""  # its code in the diagnostics, if it has one
    problem_heard: float = 0.0  # s, monotonic

    @property
    def state(self) -> str:
        """The node's activity, in words."""
        return self.values.get("state", self.message)

    @property
    def problems(self) -> int:
        """Count of messages that the node could not use, and of exceptions."""
        counts = (
            self.read_number(key) for key in self.values if key.startswith(("rejected", "failed"))
        )
        return sum(int(count or 0) for count in counts)

    def read_number(self, key: str) -> float | None:
        """Return a number of the report; None if it is missing or not finite."""
        try:
            number = float(self.values[key])
        except (KeyError, ValueError):
            return None
        return number if math.isfinite(number) else None


class PageCounter:
    """Counts the pages that show something; for any thread.

    Args:
        on_watch: called when the first page shows it, and when the last has gone.
    """

    def __init__(self, on_watch: Callable[[], None] = lambda: None) -> None:
        self._on_watch = on_watch
        self._lock = threading.Lock()
        self._pages = 0

    @property
    def is_watched(self) -> bool:
        """True while a page shows it."""
        return self._pages > 0

    def add_page(self) -> None:
        """Count a page more."""
        self._count(1)

    def remove_page(self) -> None:
        """Count a page less."""
        self._count(-1)

    def _count(self, pages: int) -> None:
        with self._lock:
            before = self.is_watched
            self._pages += pages
            changed = before != self.is_watched
        if changed:
            self._on_watch()


class StatusBoard(PageCounter):
    """The newest report of each node; for any thread.

    Args:
        on_watch: called when the first page shows it, and when the last has gone.
    """

    def __init__(self, on_watch: Callable[[], None] = lambda: None) -> None:
        super().__init__(on_watch)
        self._nodes: dict[str, NodeStatus] = {}
        self._since = 0.0  # s, monotonic, when the first page came; nothing is heard before

    def add_page(self) -> None:
        """Count a page more; nodes do not count as gone for the time without pages."""
        if not self.is_watched:
            self._since = time.monotonic()
        super().add_page()

    def add_report(self, status: NodeStatus, now: float) -> None:
        """Keep a report and the node's last problem; ``now`` is s of the monotonic clock."""
        with self._lock:
            before = self._nodes.get(status.name)
            if status.level is not NodeLevel.WELL:
                problem, kind, heard = status.message, status.values.get("problem", ""), now
            elif before:
                problem, kind, heard = before.problem, before.problem_kind, before.problem_heard
            else:
                problem, kind, heard = "", "", 0.0
            self._nodes[status.name] = replace(
                status, heard=now, problem=problem, problem_kind=kind, problem_heard=heard
            )

    def list_nodes(self, now: float) -> list[NodeStatus]:
        """List the nodes by name, without those that are long gone."""
        with self._lock:
            known = sorted(self._nodes.values(), key=lambda status: status.name)
        return [
            replace(status, level=NodeLevel.GONE, message="silent", values={})
            if now - max(status.heard, self._since) > GONE_S
            else status
            for status in known
            if now - status.heard < FORGOTTEN_S
        ]

    def find_node(self, name: str, now: float) -> NodeStatus | None:
        """Return a node; None if it never reported or is long gone."""
        return next((each for each in self.list_nodes(now) if each.name == name), None)


class StatusListener(StatusBoard):
    """A board that subscribes to ``diagnostics`` while a page shows it, in the node's thread."""

    def __init__(self, node: GuardedNode, post: Callable[[Callable[[], Any]], Any]) -> None:
        super().__init__(lambda: post(self._subscribe))
        self._space = f"{node.get_namespace().rstrip('/')}/"
        self._reports = Subscriptions(
            node, (DiagnosticArray, "diagnostics", self._on_diagnostics, STREAM, False)
        )

    def _subscribe(self) -> None:
        self._reports.set_active(self.is_watched)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        now = time.monotonic()
        for status in message.status:
            level = _LEVELS.get(status.level, NodeLevel.ERROR)
            values = {each.key: loggable_text(each.value) for each in status.values}
            name = loggable_text(status.name).removeprefix(self._space)
            self.add_report(NodeStatus(name, level, loggable_text(status.message), values), now)
