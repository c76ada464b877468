"""Starting a node again: how often, and with which parameters it goes on where it was."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace

from us_sim.run.graph import RECORDER, VIEWER, NodeProcess
from us_sim.run.supervision_settings import SupervisionSettings

MINUTE_S = 60.0


class Restarts:
    """Counts the restarts of each node.

    Args:
        settings: how many there may be.
        clock: s, never set back.
    """

    def __init__(
        self, settings: SupervisionSettings, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._settings, self._clock = settings, clock
        self._times: dict[str, deque[float]] = {}
        self._counts: dict[str, int] = {}

    def refused(self, node: str) -> str:
        """Why the node is not started again, for a person; empty, and counted, when it is."""
        now, settings = self._clock(), self._settings
        times = self._times.setdefault(node, deque())
        while times and now - times[0] > MINUTE_S:
            times.popleft()
        if self._counts.get(node, 0) >= settings.restarts:
            return f"is not started again after {_times(settings.restarts)}"
        if len(times) >= settings.restarts_per_minute:
            return f"is not started again after {_times(len(times))} within a minute"
        times.append(now)
        self._counts[node] = self._counts.get(node, 0) + 1
        return ""


def _times(count: int) -> str:
    return f"{count} restart{'' if count == 1 else 's'}"


def going_on(process: NodeProcess, report: Mapping[str, str]) -> NodeProcess:
    """The process that goes on in place of one that has ended.

    A recorder goes on in a further file, and a viewer at the port where pages look for it. What
    plays a path or a video goes on where that would be by now, as a tracker's motion would: what it
    did not send meanwhile is missing.

    Args:
        process: as it was started at first.
        report: the last that it gave.
    """
    if process.node == RECORDER:
        more: dict[str, object] = {"if_exists": "further"}
    elif process.node == VIEWER:
        port = report.get("port", "")
        more = {"port": int(port)} if port.isdecimal() and len(port) < 6 else {}
    else:
        try:
            more = {"begun": float(report["begun"])}
        except (KeyError, ValueError):  # it does not play, or what it said is no number
            return process
    return replace(process, given=process.given | more)
