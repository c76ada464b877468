"""The machine that a report's times were measured on.

>>> from us_sim.evaluation.machine import machine
>>> machine("numpy", "no-such-library")
'..., ... cores, ..., Python 3..., numpy ...'
"""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version
from os import cpu_count
from pathlib import Path


def machine(*libraries: str) -> str:
    """Processor, cores, system, and the versions of Python and of those libraries it has."""
    processor = platform.processor() or platform.machine()
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                processor = line.partition(":")[2].strip()
                break
    except OSError:
        pass
    parts = [processor, f"{cpu_count()} cores", platform.system()]
    parts.append(f"Python {platform.python_version()}")
    for name in libraries:
        try:
            parts.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return ", ".join(parts)
