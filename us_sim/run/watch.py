"""Supervision of node processes: which hang, and how often one is started again.

>>> from us_sim.run.watch import Watch
>>> times = iter(range(100))
>>> watch = Watch(10.0, clock=lambda: 0.5 * next(times), state=lambda pid: None)
>>> watch.hung({"slice_interpolator": 7}, {("slice_interpolator", 7): 1})
{}
>>> [told for _ in range(21) if (told := watch.hung({"slice_interpolator": 7}, {}))]
[{'slice_interpolator': 'has not reported for 10 s'}]
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting
from us_sim.settings.spelling import counted


@dataclass(frozen=True)
class SupervisionSettings(Settings):
    """Settings of restarts of nodes that have ended or hang."""

    restarts: int = setting(
        Quantity("number", 0, 1_000_000),
        "start a node that ended or hangs again, at most so often",
        default=10,
    )
    restarts_per_minute: int = setting(
        Quantity("number", 1, 1_000_000), "and at most so often in a minute", default=3
    )
    silence: float = setting(
        Quantity("time", 2.0, 3600.0),
        "seconds without a report after which a node hangs; six times as long while it works",
        default=10.0,
    )


@dataclass(frozen=True)
class ProcessState:
    """A process at one moment, as the system sees it."""

    is_stopped: bool  # by SIGSTOP
    is_waiting: bool  # for a processor or a disk
    cpu: float  # s of processor time that it has used


def process_state(pid: int) -> ProcessState | None:
    """The state of a process; None where it has ended, or the system does not say (not Linux)."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
        fields = text.rpartition(")")[2].split()
        ticks = int(fields[11]) + int(fields[12])  # utime and stime, see proc_pid_stat(5)
    except (OSError, ValueError, IndexError):
        return None
    cpu = ticks / os.sysconf("SC_CLK_TCK")
    return ProcessState(fields[0] == "T", fields[0] in "RD", cpu)


STEP_S = 0.5
"""A longer time between two checks counts as this much: the machine slept, or had no time for us,
and so perhaps none for the nodes."""
STOPPED_S = 0.5  # for which a process may be stopped
BUSY_SHARE = 0.5
"""Of the silence, in which a node that is busy has worked or waited for a processor."""
BUSY_FACTOR = 6.0  # how many times as long a busy node may be silent: it may be compiling
START_LIMIT_S = 300.0  # for the first report


@dataclass
class _Silence:
    reports: int = 0
    silent: float = 0.0
    busy: float = 0.0  # of it
    stopped: float = 0.0  # at the end of it
    cpu: float = 0.0


class Watch:
    """Looks at processes again and again, and says which of them hang.

    Args:
        silence: s without a report after which a node hangs that does not even work.
        clock: s, never set back.
        state: what the system says of a process.
    """

    def __init__(
        self,
        silence: float,
        clock: Callable[[], float] = time.monotonic,
        state: Callable[[int], ProcessState | None] = process_state,
    ) -> None:
        self._limit = silence
        self._clock, self._state = clock, state
        self._last: float | None = None
        self._silences: dict[tuple[str, int], _Silence] = {}

    def hung(
        self,
        pids: Mapping[str, int],
        reports: Mapping[tuple[str, int], int],
        parts: Mapping[str, Collection[str]] = MappingProxyType({}),
    ) -> dict[str, str]:
        """The nodes that hang, and how that shows, for a person; each is told once.

        Args:
            pids: the processes that run, by node.
            reports: how many have come, by node and process.
            parts: other nodes in the process of a node; it hangs when one of them does.
        """
        now = self._clock()
        step = 0.0 if self._last is None else min(now - self._last, STEP_S)
        self._last = now
        hung: dict[str, str] = {}
        for node, pid in pids.items():
            for part in (node, *parts.get(node, ())):
                silence = self._silences.setdefault((part, pid), _Silence())
                self._add(silence, pid, step, reports.get((part, pid), 0))
                told = self._told(silence)
                if told:
                    silence.silent = silence.busy = silence.stopped = 0.0
                    hung.setdefault(
                        node, told if part == node else f"was ended, since {part} in it {told}"
                    )
        return hung

    def _add(self, silence: _Silence, pid: int, step: float, reports: int) -> None:
        state = self._state(pid)
        worked = 0.0
        if state is not None:
            worked = step if state.is_waiting else min(state.cpu - silence.cpu, step)
            silence.cpu = state.cpu
        silence.stopped = silence.stopped + step if state is not None and state.is_stopped else 0.0
        if reports > silence.reports:
            silence.reports, silence.silent, silence.busy = reports, 0.0, 0.0
            return
        silence.silent += step
        silence.busy += max(worked, 0.0)

    def _told(self, silence: _Silence) -> str:
        if silence.stopped >= STOPPED_S:
            return "was stopped (SIGSTOP)"
        limit = self._limit if silence.reports else max(self._limit, START_LIMIT_S)
        if silence.busy > BUSY_SHARE * silence.silent:
            limit *= BUSY_FACTOR
        if silence.silent < limit:
            return ""
        return f"has not reported for {silence.silent:.0f} s"


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
        self._times: dict[str, list[float]] = {}  # of all restarts, by node

    def refused(self, node: str) -> str:
        """Why the node is not started again, for a person; empty, and counted, when it is."""
        now, settings = self._clock(), self._settings
        times = self._times.setdefault(node, [])
        recent = sum(now - each <= MINUTE_S for each in times)
        if len(times) >= settings.restarts:
            return f"is not started again after {counted(len(times), 'restart')}"
        if recent >= settings.restarts_per_minute:
            return f"is not started again after {counted(recent, 'restart')} within a minute"
        times.append(now)
        return ""
