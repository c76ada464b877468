"""Processor time and memory of processes, as Linux counts them.

>>> import os
>>> from us_sim.evaluation.latency.usage import usage_of
>>> usage = usage_of(os.getpid())
>>> usage is None or usage.memory > 1e6
True
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

__all__ = ["Usage", "UsageOverTime", "usage_of"]

_WARMING = 60.0  # s, of a run, in which memory may still grow
_LONG = 120.0  # s, of a run that tells whether it does


@dataclass(frozen=True)
class Usage:
    """Of one process until now."""

    processor: float  # s, of all its threads
    memory: float  # bytes, resident


def usage_of(pid: int) -> Usage | None:
    """What a process has used; None where it has gone, or the system does not tell."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="utf-8").split()[1])
    except (OSError, IndexError):
        return None
    ticks = int(fields[11]) + int(fields[12])
    return Usage(ticks / os.sysconf("SC_CLK_TCK"), float(pages * os.sysconf("SC_PAGE_SIZE")))


@dataclass
class UsageOverTime:
    """Of one process, at several times."""

    times: list[float] = field(default_factory=list)  # s
    uses: list[Usage] = field(default_factory=list)

    def add(self, time: float, usage: Usage | None) -> None:
        """What it has used at a time (s), if that is known."""
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
        """bytes, in the end."""
        return self.uses[-1].memory if self.uses else np.nan

    @property
    def growth(self) -> float:
        """bytes a minute after the first minute, by least squares; NaN in a short run."""
        if not self.times or self.times[-1] - self.times[0] < _LONG:
            return np.nan
        time = np.array(self.times) - self.times[0]
        memory = np.array([use.memory for use in self.uses])
        late = time >= _WARMING
        return 60.0 * float(np.polyfit(time[late], memory[late], 1)[0])
