"""A module that works in a process of its own, at low priority, and tells how far it is."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

from us_sim.run.end_with_parent import end_with_parent

_NICE = 10


class Background:
    """Runs a module, which says a JSON mapping a line.

    Args:
        module: its name.
        arguments: that it gets.
        nice: by how much its priority is lower than this process's.
    """

    def __init__(self, module: str, *arguments: str, nice: int = _NICE) -> None:
        package = str(Path(__file__).resolve().parents[2])
        search = os.pathsep.join(filter(None, [package, os.environ.get("PYTHONPATH", "")]))
        self._said: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", module, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            errors="replace",
            env=os.environ | {"PYTHONPATH": search},
            start_new_session=True,
            preexec_fn=end_with_parent if sys.platform == "linux" else None,
        )
        with contextlib.suppress(AttributeError, OSError):
            os.setpriority(os.PRIO_PROCESS, self._process.pid, os.getpriority(0, 0) + nice)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def said(self) -> list[dict[str, Any]]:
        """What it has said since this was asked last."""
        told = []
        with contextlib.suppress(queue.Empty):
            while True:
                told.append(self._said.get_nowait())
        return told

    @property
    def has_ended(self) -> bool:
        """Whether it is over, and all that it said has come."""
        return not self._reader.is_alive() and self._process.poll() is not None

    def end(self) -> None:
        """End it, whatever it does."""
        self._process.kill()
        self._process.wait()
        self._reader.join()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            with contextlib.suppress(ValueError):
                said = json.loads(line)
                if isinstance(said, dict):
                    self._said.put(said)
        self._process.wait()


def tell(**said: Any) -> None:
    """Say something to the process that started this one."""
    print(json.dumps(said), flush=True)
