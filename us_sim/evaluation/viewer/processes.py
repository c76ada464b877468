"""The processes that a command has started, by what they are, and what they use."""

from __future__ import annotations

import time
from pathlib import Path

from us_sim.evaluation.latency.usage import Usage, UsageOverTime, usage_of

_MODULE = "us_sim.nodes."


def started_by(pid: int) -> dict[int, str]:
    """The names of a process's children and theirs, by their numbers: nodes, or programs."""
    found: dict[int, str] = {}
    waiting = [pid]
    while waiting:
        for child in _children(waiting.pop()):
            found[child] = _name(child)
            waiting.append(child)
    return found


class UsageByName:
    """Processor time and memory of processes over time, those of one name taken together."""

    def __init__(self) -> None:
        self.uses: dict[str, UsageOverTime] = {}
        self._began = time.monotonic()

    def look(self, processes: dict[int, str]) -> None:
        """Note what they have used until now."""
        passed = time.monotonic() - self._began
        sums: dict[str, Usage] = {}
        for pid, name in processes.items():
            usage = usage_of(pid)
            if usage is not None:
                before = sums.get(name, Usage(0.0, 0.0))
                sums[name] = Usage(before.processor + usage.processor, before.memory + usage.memory)
        for name, usage in sums.items():
            self.uses.setdefault(name, UsageOverTime()).add(passed, usage)


def _children(pid: int) -> list[int]:
    found: list[int] = []
    try:
        for task in Path(f"/proc/{pid}/task").iterdir():
            found += map(int, (task / "children").read_text(encoding="utf-8").split())
    except OSError:
        pass
    return found


def _name(pid: int) -> str:
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
    except OSError:
        return "gone"
    for word in words:
        if word.startswith(_MODULE):
            return word.removeprefix(_MODULE)
    return "browser" if "chrom" in words[0] else Path(words[0]).name
