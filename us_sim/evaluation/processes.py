"""Processes: their processor time and memory, and what a running graph sends.

>>> import os
>>> from us_sim.evaluation.processes import usage_of
>>> usage = usage_of(os.getpid())
>>> usage is None or usage.memory > 1e6
True
"""

from __future__ import annotations

import contextlib
import os
import re
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from us_sim.evaluation.latency.arrivals import Arrivals


@dataclass(frozen=True)
class Usage:
    """Resources that a process has used until now."""

    processor: float  # s, of all its threads
    memory: float  # bytes, resident; a page that n processes share counts 1/n in each of them


def usage_of(pid: int) -> Usage | None:
    """Usage of a process; None where it has ended, or the system does not tell."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        sizes = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="utf-8")
        ticks = int(fields[11]) + int(fields[12])
    except (OSError, IndexError):
        return None
    share = re.search(r"^Pss:\s+(\d+) kB", sizes, re.MULTILINE)  # proc(5): proportional set size
    if share is None:  # it has ended, and only its number is left
        return None
    return Usage(ticks / os.sysconf("SC_CLK_TCK"), 1024.0 * int(share[1]))


@dataclass
class UsageOverTime:
    """Usage of one process, or of several of one name, at several times."""

    times: list[float] = field(default_factory=list)  # s
    uses: list[Usage] = field(default_factory=list)

    def add(self, time: float, usage: Usage | None) -> None:
        """Append the usage at a time (s), if it is known."""
        if usage is not None:
            self.times.append(time)
            self.uses.append(usage)

    @property
    def processor(self) -> float:
        """Processor time over time: 1 is one core."""
        if len(self.times) < 2:
            return np.nan
        used = self.uses[-1].processor - self.uses[0].processor
        return used / (self.times[-1] - self.times[0])

    @property
    def memory(self) -> float:
        """Bytes in the end."""
        return self.uses[-1].memory if self.uses else np.nan

    @property
    def growth(self) -> float:
        """Bytes a minute after the first minute, by least squares; NaN in less than two minutes."""
        if not self.times or self.times[-1] - self.times[0] < 120.0:
            return np.nan
        time = np.array(self.times) - self.times[0]
        late = time >= 60.0
        memory = np.array([use.memory for use in self.uses])
        return 60.0 * float(np.polyfit(time[late], memory[late], 1)[0])


class UsageByName:
    """Usage of processes over time, those of one name added up."""

    def __init__(self) -> None:
        self.uses: dict[str, UsageOverTime] = {}
        self._began = time.monotonic()

    def update(self, processes: dict[int, str]) -> None:
        """Add the usage of processes, whose names are given by their numbers."""
        passed = time.monotonic() - self._began
        sums: dict[str, Usage] = {}
        for pid, name in processes.items():
            if (usage := usage_of(pid)) is not None:
                before = sums.get(name, Usage(0.0, 0.0))
                sums[name] = Usage(before.processor + usage.processor, before.memory + usage.memory)
        for name, usage in sums.items():
            self.uses.setdefault(name, UsageOverTime()).add(passed, usage)


def started_by(pid: int) -> dict[int, str]:
    """Names of all descendants of a process by their numbers: of a node, or of a program."""
    found: dict[int, str] = {}
    waiting = [pid]
    while waiting:
        with contextlib.suppress(OSError):
            for task in Path(f"/proc/{waiting.pop()}/task").iterdir():
                for word in (task / "children").read_text(encoding="utf-8").split():
                    found[int(word)] = _name(int(word))
                    waiting.append(int(word))
    return found


def _name(pid: int) -> str:
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
    except OSError:
        return "gone"
    return "browser" if "chrom" in words[0] else Path(words[0]).name


@contextlib.contextmanager
def listening(*, viewer: bool) -> Iterator[Arrivals]:
    """Note arrivals, in a thread of this process, until the context is left.

    Args:
        viewer: whether it also takes the annotated image and the structures.
    """
    import rclpy
    from rclpy.context import Context
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.signals import SignalHandlerOptions

    from us_sim.evaluation.latency.arrivals import Arrivals
    from us_sim.nodes.process import go_along, go_first

    context = Context()
    rclpy.init(args=[], context=context, signal_handler_options=SignalHandlerOptions.NO)
    node = Arrivals(viewer=viewer, context=context)

    def spin() -> None:
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        with contextlib.suppress(ExternalShutdownException):
            executor.spin()

    thread = threading.Thread(target=spin, daemon=True)
    thread.start()
    go_first(2)  # the graph's wait for a core is measured, not the listener's for the nodes
    try:
        yield node
    finally:
        go_along()
        context.try_shutdown()
        thread.join(timeout=5.0)
