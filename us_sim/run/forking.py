"""Starting nodes by forking them from a process that has imported what they need.

A node that is started as a program of its own imports rclpy, NumPy, Numba and SciPy again, which
takes longer than all that it does until it is ready. `us_sim.run.fork_server` does it once.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import math
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import IO

from us_sim.run.end_with_parent import end_with_parent
from us_sim.run.process_state import process_state

_MODULE = "us_sim.run.fork_server"
_PR_SET_CHILD_SUBREAPER = 36
_ROOM = 1000
"""Characters that the server's command line has to spare, for those of its nodes."""
_PATIENCE_S = 60.0
"""For a process to be there: what it is forked from may have to be imported first."""
_END_S = 1.0
_LONGEST_LOOK_S = 0.05
_STOPPED_LOOKS = 10
"""How often in a row it is seen stopped before it is given up."""


class ForkedProcess:
    """A child that was forked: what of `subprocess.Popen` is needed for a node.

    Args:
        pid: of the process, which is a child of this one.
        stdin: what it reads, if that is written here.
        stdout: what it says.
    """

    def __init__(self, pid: int, stdin: IO[str] | None, stdout: IO[str]) -> None:
        self.pid, self.stdin, self.stdout = pid, stdin, stdout
        self.returncode: int | None = None
        self._lock = threading.Lock()

    def poll(self) -> int | None:
        """Its exit status, negative for a signal; None while it runs."""
        with self._lock:
            if self.returncode is None:
                try:
                    pid, status = os.waitpid(self.pid, os.WNOHANG)
                except ChildProcessError:  # somebody else has taken it
                    pid, status = self.pid, 0
                if pid:
                    self.returncode = os.waitstatus_to_exitcode(status)
            return self.returncode

    def wait(self, timeout: float = math.inf) -> int:
        """Its exit status.

        Raises:
            subprocess.TimeoutExpired: it has not ended after so many s.
        """
        until, pause = time.monotonic() + timeout, 0.0005
        while (status := self.poll()) is None:
            left = until - time.monotonic()
            if left <= 0:
                raise subprocess.TimeoutExpired(str(self.pid), timeout)
            pause = min(2 * pause, left, _LONGEST_LOOK_S)
            time.sleep(pause)
        return status

    def send_signal(self, number: int) -> None:
        """Send it a signal, unless it has ended."""
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def terminate(self) -> None:
        """SIGTERM."""
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """SIGKILL."""
        self.send_signal(signal.SIGKILL)


class ForkServer:
    """The process that nodes are forked from; it begins to import at once.

    Where there is none, nodes are started as programs: not on Linux, or what nodes import does not
    let them be forked.
    """

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        if sys.platform != "linux" or not _adopt_orphans(True):
            return
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", _MODULE, " " * _ROOM],
                stdin=theirs.fileno(),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                env=os.environ | {"PYTHONPATH": package_on_path()},
                start_new_session=True,
                preexec_fn=end_with_parent,
            )

    @property
    def pid(self) -> int | None:
        """Of its process; None where there is none."""
        return self._process.pid if self._process else None

    def __enter__(self) -> ForkServer:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def fork(
        self, node: str, command: Sequence[str], environment: Mapping[str, str], *, is_fed: bool
    ) -> ForkedProcess | None:
        """A node's process; None where it has to be started as a program.

        Args:
            node: its name.
            command: that would start it as a program.
            environment: that it gets.
            is_fed: its input is written here.
        """
        if self._process is None:
            return None
        asked = {"node": node, "command": list(command), "environment": dict(environment)}
        data = json.dumps(asked | {"parent": os.getpid()}).encode()
        with contextlib.ExitStack() as ours, contextlib.ExitStack() as theirs:
            given, feed = _pipe(theirs, ours) if is_fed else (_nothing(theirs), None)
            heard, said = _pipe(ours, theirs)
            ready, told = _pipe(ours, theirs)
            try:
                socket.send_fds(self._control, [data], [given, said, told])
            except OSError:  # it has ended, or that is too long for it
                return None
            theirs.close()
            pid = self._answer(ready)
            if not pid:
                self.close()
                return None
            ours.pop_all()
        os.close(ready)
        stdin = None if feed is None else os.fdopen(feed, "w", encoding="utf-8")
        return ForkedProcess(int(pid), stdin, os.fdopen(heard, encoding="utf-8", errors="replace"))

    def _answer(self, ready: int) -> bytes:
        """What it says there; nothing where it has ended, is stopped, or takes too long."""
        assert self._process is not None
        until, stopped = time.monotonic() + _PATIENCE_S, 0
        while time.monotonic() < until and stopped < _STOPPED_LOOKS:
            if select.select([ready], [], [], _LONGEST_LOOK_S)[0]:
                return os.read(ready, 32)
            state = process_state(self._process.pid)
            stopped = stopped + 1 if state is None or state.is_stopped else 0
        return b""

    def close(self) -> None:
        """End it; nodes go on."""
        process, self._process = self._process, None
        if process is None:
            return
        _adopt_orphans(False)
        self._control.close()
        process.terminate()
        process.send_signal(signal.SIGCONT)  # one that is stopped ends only then
        try:
            process.wait(_END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def package_on_path() -> str:
    """PYTHONPATH with which a program finds this very package."""
    package = str(Path(__file__).resolve().parents[2])
    return os.pathsep.join(filter(None, [package, os.environ.get("PYTHONPATH", "")]))


def _adopt_orphans(yes: bool) -> bool:
    """Become the parent of what descends from this process when its own has ended; whether so."""
    return bool(ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, int(yes), 0, 0, 0) == 0)


def _pipe(reader: contextlib.ExitStack, writer: contextlib.ExitStack) -> tuple[int, int]:
    """A pipe, whose ends are closed with those."""
    read, write = os.pipe()
    reader.callback(os.close, read)
    writer.callback(os.close, write)
    return read, write


def _nothing(stack: contextlib.ExitStack) -> int:
    """An input in which there is nothing."""
    file = os.open(os.devnull, os.O_RDONLY)
    stack.callback(os.close, file)
    return file
