"""A module of this package run as a program, for what a process is measured by."""

from __future__ import annotations

import os
import subprocess
import sys


def start_module(name: str, *arguments: str) -> subprocess.Popen[str]:
    """Start ``python -m name arguments`` with this process's modules, on this host only."""
    path = os.pathsep.join(part for part in sys.path if part)
    environment = {**os.environ, "PYTHONPATH": path}
    environment.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    return subprocess.Popen(
        [sys.executable, "-m", name, *arguments],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
