"""What the system says of a process: whether it is stopped, waits its turn, or has worked."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

_UTIME, _STIME = 11, 12  # in /proc/PID/stat, counted from the state; see proc_pid_stat(5)


@dataclass(frozen=True)
class ProcessState:
    """A process at one moment."""

    is_stopped: bool  # by SIGSTOP
    is_waiting: bool  # for a processor or a disk
    cpu: float  # s of processor time that it has used


def process_state(pid: int) -> ProcessState | None:
    """The state of a process; None where it has ended, or the system does not say (not Linux)."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
        fields = text.rpartition(")")[2].split()
        ticks = int(fields[_UTIME]) + int(fields[_STIME])
    except (OSError, ValueError, IndexError):
        return None
    cpu = ticks / os.sysconf("SC_CLK_TCK")
    return ProcessState(fields[0] == "T", fields[0] in "RD", cpu)
