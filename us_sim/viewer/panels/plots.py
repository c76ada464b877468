"""Rates, latencies, the force and the residual over the last minute."""

from __future__ import annotations

import time
from collections.abc import Callable

from nicegui.element import Element

from us_sim.viewer.panels.while_shown import WhileShown
from us_sim.viewer.simulator import Simulator
from us_sim.viewer.status import HISTORY_S, Point, StatusBoard

EVERY_S = 0.5
HELD_BACK_S = 0.15
"""The newest force is left for the next turn: until then a larger one may take its place."""

Series = dict[str, list[Point]]


class Plot(Element, component="plot.js"):
    """One quantity over time.

    Args:
        title: of the quantity.
        unit: of its values.
        history: its values after a time, by nodes.
        is_logarithmic: drawn by decades.
    """

    def __init__(
        self, title: str, unit: str, history: Callable[[float], Series], is_logarithmic: bool
    ) -> None:
        super().__init__()
        self.props.update({"title": title, "unit": unit, "logarithmic": is_logarithmic})
        self._history = history
        self._told: dict[str, float] = {}

    def begin(self) -> None:
        """It begins to be shown, with nothing drawn."""
        self._told = {}

    def refresh(self, now: float) -> None:
        """Send what is new; ``now`` is s of the monotonic clock."""
        is_first = not self._told
        oldest = now - HISTORY_S
        history = self._history(min(self._told.values(), default=oldest) if self._told else oldest)
        new = []
        for name, points in history.items():
            fresh = [
                (round(t, 3), value) for t, value in points if t > self._told.get(name, oldest)
            ]
            if fresh:
                self._told[name] = points[-1][0]
                new.append((name, fresh))
        self.run_method("add", round(now, 3), new, is_first)


def build(simulator: Simulator) -> None:
    """Make the panel."""
    board = simulator.status
    plots: list[Plot] = []

    def begin() -> None:
        board.watch(pages=1, plots=1)
        for plot in plots:
            plot.begin()

    def refresh() -> None:
        now = time.monotonic()
        for plot in plots:
            plot.refresh(now)

    with WhileShown(begin, lambda: board.watch(pages=-1, plots=-1), EVERY_S, refresh):
        plots += [
            Plot("rate", "Hz", _of(board, "rate_hz"), False),
            Plot("latency, median", "ms", _of(board, "latency_p50_ms"), False),
            Plot("contact force", "N", _force(board), False),
            Plot("residual", "of the force", _of(board, "residual"), True),
        ]


def _of(board: StatusBoard, key: str) -> Callable[[float], Series]:
    return lambda since: board.history(key, since)


def _force(board: StatusBoard) -> Callable[[float], Series]:
    def history(since: float) -> Series:
        settled = time.monotonic() - HELD_BACK_S
        points = [point for point in board.forces(since) if point[0] < settled]
        return {"probe": points} if points else {}

    return history
