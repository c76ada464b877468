"""What every node last said of itself, and how some of its numbers went over the last minute.

>>> from us_sim.viewer.status import Level, NodeStatus, StatusBoard
>>> board = StatusBoard()
>>> board.tell(NodeStatus("tissue_deformer", Level.WELL, "fem", {"rate_hz": "59.9"}), now=10.0)
>>> board.nodes(now=11.0)[0].rate, board.nodes(now=15.0)[0].level
(59.9, <Level.GONE: 'gone'>)

Hears what nodes say of themselves, and the force on the probe, while pages show it.
"""

from __future__ import annotations

import dataclasses
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import WrenchStamped

from us_sim.nodes.guarded_node import GuardedNode, shown
from us_sim.nodes.qos import STREAM

GONE_S = 3.0
"""Without a word, after which a node counts as gone: each says something every second."""
FORGOTTEN_S = 60.0
"""After which one that is gone is not shown any more."""
HISTORY_S = 60.0
FORCES_A_SECOND = 10
"""Points of the force that are kept: of all that come within one, the largest."""

Point = tuple[float, float]
"""s of the monotonic clock, and the value then."""


class Level(Enum):
    """How a node is."""

    WELL = "well"
    WARNING = "warning"
    ERROR = "error"
    GONE = "gone"


@dataclass(frozen=True)
class NodeStatus:
    """What a node said of itself."""

    name: str
    level: Level
    message: str  # its state, or what is wrong
    values: Mapping[str, str] = field(default_factory=dict)  # as in its diagnostics
    heard: float = 0.0  # s, monotonic
    problem: str = ""  # the last sentence that something was wrong
    problem_kind: str = ""  # its code in the diagnostics, if it has one
    problem_heard: float = 0.0  # s, monotonic

    @property
    def state(self) -> str:
        """What it is doing."""
        return self.values.get("state", self.message)

    @property
    def rate(self) -> float | None:
        """Hz, of what it publishes."""
        return self.number("rate_hz")

    @property
    def received(self) -> int | None:
        """Messages that came."""
        return self._count("received")

    @property
    def dropped(self) -> int | None:
        """Messages that it skipped for newer ones."""
        return self._count("dropped")

    @property
    def problems(self) -> int:
        """How much that came it could not use, and how often it failed."""
        counts = (
            self._count(key) or 0 for key in self.values if key.startswith(("rejected ", "failed "))
        )
        return sum(counts)

    def number(self, key: str) -> float | None:
        """A number that it says, if it says one."""
        try:
            number = float(self.values[key])
        except (KeyError, ValueError):
            return None
        return number if math.isfinite(number) else None

    def _count(self, key: str) -> int | None:
        number = self.number(key)
        return None if number is None else int(number)


class StatusBoard:
    """The newest of each node, and the histories of what is plotted; for any thread.

    Args:
        on_watch: called when pages begin to look, or no longer do.
    """

    PLOTTED = ("rate_hz", "latency_p50_ms", "latency_p99_ms", "residual", "difference_max_mm")
    """Values of diagnostics whose histories are kept."""

    def __init__(self, on_watch: Callable[[], None] = lambda: None) -> None:
        self._on_watch = on_watch
        self._lock = threading.Lock()
        self._nodes: dict[str, NodeStatus] = {}
        self._histories: dict[tuple[str, str], deque[Point]] = {}
        self._forces: deque[Point] = deque(maxlen=int(HISTORY_S * FORCES_A_SECOND))
        self._pages = self._plots = 0
        self._since = 0.0  # s, monotonic, from when on pages look; nothing is heard before

    @property
    def is_watched(self) -> bool:
        """Whether a page shows how nodes are."""
        return self._pages > 0

    @property
    def is_force_watched(self) -> bool:
        """Whether a page plots the force."""
        return self._plots > 0

    def watch(self, pages: int = 0, plots: int = 0) -> None:
        """So many pages, or plots of the force, more look; fewer where negative.

        Nobody is silent for not having been listened to while no page looked.
        """
        with self._lock:
            before = self.is_watched, self.is_force_watched
            self._pages += pages
            if self.is_watched and not before[0]:
                self._since = time.monotonic()
            self._plots += plots
            changed = before != (self.is_watched, self.is_force_watched)
        if changed:
            self._on_watch()

    def tell(self, status: NodeStatus, now: float) -> None:
        """A node says how it is, at a time of the monotonic clock in s."""
        with self._lock:
            before = self._nodes.get(status.name)
            if status.level is not Level.WELL:
                kind = status.values.get("problem", "")
                status = dataclasses.replace(
                    status, problem=status.message, problem_kind=kind, problem_heard=now
                )
            elif before:
                status = dataclasses.replace(
                    status,
                    problem=before.problem,
                    problem_kind=before.problem_kind,
                    problem_heard=before.problem_heard,
                )
            self._nodes[status.name] = dataclasses.replace(status, heard=now)
            for key in self.PLOTTED:
                number = status.number(key)
                if number is not None:
                    history = self._histories.setdefault((status.name, key), deque(maxlen=100))
                    history.append((now, number))

    def feel(self, force: float, now: float) -> None:
        """The probe is pushed with a force in N, at a time of the monotonic clock in s."""
        with self._lock:
            if self._forces and now - self._forces[-1][0] < 1.0 / FORCES_A_SECOND:
                begun, largest = self._forces[-1]
                self._forces[-1] = begun, max(force, largest)
            else:
                self._forces.append((now, force))

    def nodes(self, now: float) -> list[NodeStatus]:
        """How each node is, by name; one that has long been gone is left out."""
        with self._lock:
            known = sorted(self._nodes.values(), key=lambda status: status.name)
        return [
            dataclasses.replace(status, level=Level.GONE, message="silent", values={})
            if now - max(status.heard, self._since) > GONE_S
            else status
            for status in known
            if now - status.heard < FORGOTTEN_S
        ]

    def node(self, name: str, now: float) -> NodeStatus | None:
        """How one node is, if it ever said."""
        return next((each for each in self.nodes(now) if each.name == name), None)

    def history(self, key: str, since: float) -> dict[str, list[Point]]:
        """The values of one key after a time, for each node that says them."""
        with self._lock:
            return {
                name: [point for point in points if point[0] > since]
                for (name, told), points in sorted(self._histories.items())
                if told == key and points[-1][0] > since
            }

    def forces(self, since: float) -> list[Point]:
        """The force on the probe after a time, N."""
        with self._lock:
            return [point for point in self._forces if point[0] > since]


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
