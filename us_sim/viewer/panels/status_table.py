"""A table of all nodes, and how each is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nicegui.element import Element

from us_sim.viewer.status import Level, NodeStatus

PROBLEM_S = 60.0
"""How long the last problem of a node that is well again is shown."""


class StatusTable(Element, component="status_table.js"):
    """The table.

    Args:
        choose: called with the name of a node that a person has chosen.
    """

    def __init__(self, choose: Callable[[str], None]) -> None:
        super().__init__()
        self.on("choose", lambda event: choose(str(event.args)))

    def show(self, nodes: list[NodeStatus], now: float) -> None:
        """Show these nodes; ``now`` is s of the monotonic clock."""
        rows = [row_of(status, now) for status in nodes]
        if rows != self.props.get("rows"):
            self.props["rows"] = rows


def row_of(status: NodeStatus, now: float) -> dict[str, Any]:
    """What the table shows of a node, as texts."""
    latency = [status.number(f"latency_{which}_ms") for which in ("p50", "p99")]
    return {
        "name": status.name,
        "level": status.level.value,
        "state": "silent" if status.level is Level.GONE else status.state,
        "rate": "" if status.rate is None else f"{status.rate:.1f}",
        "latency": " · ".join(_milliseconds(each) for each in latency if each is not None),
        "received": "" if status.received is None else str(status.received),
        "dropped": "" if status.dropped is None else str(status.dropped),
        "problem": _problem(status, now),
        "isPast": status.level not in (Level.WARNING, Level.ERROR),
    }


def _milliseconds(number: float) -> str:
    return f"{number:.1f}" if abs(number) < 99.95 else f"{number:.0f}"


def _problem(status: NodeStatus, now: float) -> str:
    """The last sentence that something was wrong, how long ago, and of how many."""
    age = now - status.problem_heard
    if not status.problem or age > PROBLEM_S:
        return ""
    many = f" ({status.problems} so far)" if status.problems > 1 else ""
    ago = "" if status.level in (Level.WARNING, Level.ERROR) else f"{age // 5 * 5:.0f} s ago: "
    return f"{ago}{status.problem}{many}"
