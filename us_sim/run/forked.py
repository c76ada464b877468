"""Node processes forked from one that has imported what they share, so that they start soon.

That one is multiprocessing's fork server, which never imports rclpy: its tracing starts threads.
Where it ends, so do they, and the supervisor starts them again from another.
"""

from __future__ import annotations

import ctypes
import importlib
import multiprocessing
import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from multiprocessing.connection import Connection
from multiprocessing.forkserver import ensure_running
from typing import TextIO

from us_sim.nodes import INTERRUPTED, prepare_process

_UNKNOWN = 255  # the exit status of what was forked by a server that has ended
_PR_SET_PDEATHSIG = 1

_context = multiprocessing.get_context("forkserver")
_context.set_forkserver_preload([f"{__package__}.preloaded"])


def begin_fork_server() -> None:
    """Have the server import what nodes share while this process does something else."""
    if sys.platform == "linux":
        ensure_running()


def end_with_parent(number: signal.Signals) -> None:
    """Have the kernel send this process a signal when the one that started it ends."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)


class ForkedNode:
    """A node's process, with what `RunningNode` uses of `subprocess.Popen`.

    It ends when this process or the fork server ends.

    Args:
        name: the node's, which its process bears.
        module: whose `main` it runs.
        arguments: of the command line.
        environment: of the process.
    """

    def __init__(
        self, name: str, module: str, arguments: list[str], environment: Mapping[str, str]
    ) -> None:
        output, its_output = _context.Pipe(duplex=False)
        its_own = (name, module, arguments, dict(environment), its_output)
        self._process = _context.Process(target=_run_node, args=its_own, name=name, daemon=True)
        self._process.start()
        its_output.close()
        assert self._process.pid is not None
        self.pid = self._process.pid
        self.stdout: TextIO = open(os.dup(output.fileno()), errors="replace")  # noqa: SIM115
        output.close()

    def poll(self) -> int | None:
        """Return the exit status; None while it runs, negative for a signal."""
        status = self._process.exitcode
        return INTERRUPTED if status == _UNKNOWN else status  # it is told to end then

    def wait(self, timeout: float) -> None:
        """Wait for its end; `subprocess.TimeoutExpired` after so many seconds."""
        self._process.join(timeout)
        if self.poll() is None:
            raise subprocess.TimeoutExpired(self._process.name, timeout)

    def send_signal(self, number: int) -> None:
        """Send a signal, unless it has ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def terminate(self) -> None:
        """Tell it to end."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """End it at once."""
        self.send_signal(signal.SIGKILL)


def _run_node(
    name: str,
    module: str,
    arguments: list[str],
    environment: Mapping[str, str],
    output: Connection,
) -> None:
    """Become the node, in the forked process."""
    end_with_parent(signal.SIGTERM)
    os.setsid()  # so that Ctrl-C is for the process that started it alone
    for number in 1, 2:
        os.dup2(output.fileno(), number)
    output.close()
    for stream in sys.stdout, sys.stderr:
        stream.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    os.environ.clear()
    os.environ.update(environment)
    sys.argv = [name, *arguments]
    prepare_process(name)
    sys.exit(importlib.import_module(module).main(arguments))
