"""Supervision of node processes: when one hangs, and how often it is started again.

>>> from us_sim.run.watch import Watch
>>> times = iter(range(100))
>>> watch = Watch(10.0, clock=lambda: 0.5 * next(times))
>>> reports = {("slice_interpolator", 7): 1}
>>> [told for _ in range(30) if (told := watch.hung({"slice_interpolator": 7}, reports))]
[{'slice_interpolator': 'has not reported for 10 s'}]
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting


@dataclass(frozen=True)
class SupervisionSettings(Settings):
    """Settings of restarts of nodes that have ended or hang."""

    restarts: int = setting(
        Quantity("number", 0, 1_000_000),
        "start a node that ended or hangs again, at most so often",
        default=10,
    )
    silence: float = setting(
        Quantity("time", 2.0, 3600.0),
        "seconds without a report after which a node hangs",
        default=30.0,
    )


STEP_S = 0.5
"""A longer time between two looks counts as this much: this process was stopped or had no time."""
START_S = 900.0  # s for the first report: a first run compiles for minutes


class Watch:
    """Says which nodes have been silent for too long.

    Args:
        silence: s without a report after which a node hangs.
        clock: s, never set back.
    """

    def __init__(self, silence: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._silence, self._clock = silence, clock
        self._looked, self._time = clock(), 0.0
        self._heard: dict[tuple[str, int], tuple[int, float]] = {}  # reports, time of the last

    def hung(
        self, pids: Mapping[str, int], reports: Mapping[tuple[str, int], int]
    ) -> dict[str, str]:
        """Return the nodes that hang, and how that shows, for a person; each is told once.

        Args:
            pids: the processes that run, by node.
            reports: how many have come, by node and process.
        """
        now = self._clock()
        self._time += min(now - self._looked, STEP_S)
        self._looked = now
        hung: dict[str, str] = {}
        for process in pids.items():
            count = reports.get(process, 0)
            before, since = self._heard.get(process, (-1, 0.0))
            silent = self._time - since
            if count == before and silent < (self._silence if count else START_S):
                continue
            self._heard[process] = count, self._time
            if count == before:
                hung[process[0]] = f"has not reported for {silent:.0f} s"
        return hung
