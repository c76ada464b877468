"""Processor time and memory of processes, as Linux counts them.

>>> import os
>>> from us_sim.evaluation.latency.usage import usage_of
>>> usage = usage_of(os.getpid())
>>> usage is None or usage.memory > 1e6
True
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

_SHARE = re.compile(r"^Pss:\s+(\d+) kB", re.MULTILINE)  # proc(5): proportional set size
_WARMING = 60.0  # s, of a run, in which memory may still grow
_LONG = 120.0  # s, of a run that tells whether it does


@dataclass(frozen=True)
class Usage:
    """Of one process until now."""

    processor: float  # s, of all its threads
    memory: float  # bytes, resident; a page that n processes share counts 1/n in each of them


def usage_of(pid: int) -> Usage | None:
    """What a process has used; None where it has gone, or the system does not tell."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
        sizes = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="utf-8")
        ticks = int(fields[11]) + int(fields[12])
    except (OSError, IndexError):
        return None
    share = _SHARE.search(sizes)
    if share is None:  # it has ended, and only its number is left
        return None
    return Usage(ticks / os.sysconf("SC_CLK_TCK"), 1024.0 * int(share[1]))


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
