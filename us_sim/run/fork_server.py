"""A process from which nodes are forked, so that common modules are imported once.

A node that is started as a program of its own imports rclpy, NumPy, Numba and SciPy again, which
takes longer than all that it does until it is ready. Run as a program, this module is the server:
it imports modules that nodes need and forks a node whenever a `ForkServer` asks for one. The node
becomes a child of the process that asked: the one between them ends at once, and the one that
asked adopts its orphans (PR_SET_CHILD_SUBREAPER).

A process with several threads cannot be forked safely. Where an import starts a thread, the server
ends, and nodes are started as programs. On other systems than Linux they always are.

The forkserver of `multiprocessing` was tried with the same modules preloaded: memory and the time
from node to node are the same. But it serves nobody before its last import, so that the page was
ready after 1.6 s in place of 0.6 s; its nodes get Ctrl-C from the terminal before the recorder may
end; and when the server is killed, it reports every node as ended (255) while all of them run on.
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import importlib
import json
import math
import os
import runpy
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

EVERY_NODE = ("us_sim.nodes", "us_sim.nodes.process", "us_sim.nodes.scene_node")
"""Modules that every node imports; the first provides rclpy."""
COMPUTING = ("us_sim.kernels", "scipy.sparse", "scipy.sparse.linalg", "scipy.sparse.csgraph")
"""Modules that the nodes with kernels import."""
SLOW = ("tissue_deformer", "slice_interpolator", "skin_deformer")
"""Those nodes. They take long to start, and hold no device that a second process could not have."""
_ANSWER_S = 60.0  # for a forked process to report: the modules may have to be imported first
_POLL_S = 0.05


def end_with_parent() -> None:
    """Have this new process get SIGTERM when its parent ends, before its program begins (Linux)."""
    set_death_signal = 1  # PR_SET_PDEATHSIG
    _THIS_PROGRAM.prctl(set_death_signal, signal.SIGTERM)


_THIS_PROGRAM = ctypes.CDLL(None)  # loaded before any fork


@dataclass(frozen=True)
class ProcessState:
    """A process at one moment, as the system sees it."""

    is_stopped: bool  # by SIGSTOP
    is_waiting: bool  # for a processor or a disk
    cpu: float  # s of processor time that it has used


def process_state(pid: int) -> ProcessState | None:
    """The state of a process; None where it has ended, or the system does not say (not Linux)."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
        fields = text.rpartition(")")[2].split()
        ticks = int(fields[11]) + int(fields[12])  # utime and stime, see proc_pid_stat(5)
    except (OSError, ValueError, IndexError):
        return None
    cpu = ticks / os.sysconf("SC_CLK_TCK")
    return ProcessState(fields[0] == "T", fields[0] in "RD", cpu)


class ForkedProcess:
    """A child that was forked, with the part of `subprocess.Popen` that a node needs.

    Args:
        pid: of the process, which is a child of this one.
        stdin: its input, if that is written here.
        stdout: its output.
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
            pause = min(2 * pause, left, _POLL_S)
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

    Where there is none, nodes are started as programs: not on Linux, or where the imports do not
    let them be forked.
    """

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        if sys.platform != "linux" or not _adopt_orphans(True):
            return
        self._control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        room = " " * 1000  # for the command lines of its nodes
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "us_sim.run.fork_server", room],
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

    def __exit__(self, *_: object) -> None:
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
            feed = None
            if is_fed:
                given, feed = _pipe(theirs, ours)
            else:
                given = os.open(os.devnull, os.O_RDONLY)
                theirs.callback(os.close, given)
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
        """The node's pid; nothing where the server has ended, is stopped, or takes too long."""
        assert self._process is not None
        until, stopped = time.monotonic() + _ANSWER_S, 0
        while time.monotonic() < until and stopped < 10:  # times that it was seen stopped
            if select.select([ready], [], [], _POLL_S)[0]:
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
            process.wait(1.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def package_on_path() -> str:
    """PYTHONPATH with which a program finds this very package."""
    package = str(Path(__file__).resolve().parents[2])
    return os.pathsep.join(filter(None, [package, os.environ.get("PYTHONPATH", "")]))


def _adopt_orphans(yes: bool) -> bool:
    """Become the parent of descendants whose own parent has ended, or not; whether it worked."""
    set_child_subreaper = 36  # PR_SET_CHILD_SUBREAPER
    return bool(_THIS_PROGRAM.prctl(set_child_subreaper, int(yes), 0, 0, 0) == 0)


def _pipe(reader: contextlib.ExitStack, writer: contextlib.ExitStack) -> tuple[int, int]:
    read, write = os.pipe()
    reader.callback(os.close, read)
    writer.callback(os.close, write)
    return read, write


@dataclass(frozen=True)
class _Asked:
    node: str
    command: list[str]  # the command line that it would be started with
    environment: dict[str, str]
    parent: int  # pid of the process that asks
    files: list[int]  # descriptors: its input, its output, and where it reports its pid


def main() -> int:
    """Fork nodes until the other side of the socket on stdin is closed; the exit status.

    In a node's process it runs that node.
    """
    asked = _serve(socket.socket(fileno=os.dup(0)))
    if asked is not None:
        module = asked.command[asked.command.index("-m") + 1]
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    return 0


def _serve(control: socket.socket) -> _Asked | None:
    """In this process None, once nobody asks any more; in a node's process the request for it."""
    waiting = [*EVERY_NODE, *COMPUTING]
    while True:
        nobody_asks = not select.select([control], [], [], 0.0)[0]
        if len(waiting) > len(COMPUTING) or (waiting and nobody_asks):
            _import_next(waiting)
            continue
        data, files, _, _ = socket.recv_fds(control, 1 << 18, 3)
        if not data or len(os.listdir("/proc/self/task")) > 1:
            return None
        asked = _Asked(**json.loads(data), files=files)
        if asked.node in SLOW:
            while waiting:
                _import_next(waiting)
        if _forked(asked):
            control.close()
            return asked
        for file in asked.files:
            os.close(file)


def _import_next(waiting: list[str]) -> None:
    """Import the next module; after the last, make all that is imported ready to be forked."""
    importlib.import_module(waiting.pop(0))
    if not waiting:
        from us_sim.kernels import warm_up

        warm_up()
        gc.collect()
        gc.freeze()  # a later collection would copy it for every node


def _forked(asked: _Asked) -> bool:
    """Fork the node; whether this is its process, and ready to be it."""
    between = os.fork()
    if between:
        os.waitpid(between, 0)
        return False
    own = os.getpid()
    if os.fork():
        os._exit(0)
    try:
        _become(asked, own)
    except BaseException:
        os._exit(1)
    return True


def _become(asked: _Asked, between: int) -> None:
    """Make of this process the same as a program of its own would be."""
    from us_sim.nodes import end_at_once_when_interrupted

    given, said, ready = asked.files
    until = time.monotonic() + 5.0
    while os.getppid() == between and time.monotonic() < until:
        time.sleep(0.0002)
    os.setsid()
    end_with_parent()
    if os.getppid() != asked.parent:
        raise ChildProcessError("the process that asked has ended, or does not adopt it")
    os.dup2(given, 0)
    os.dup2(said, 1)
    os.dup2(said, 2)
    os.environ.update(asked.environment)
    sys.orig_argv = asked.command
    end_at_once_when_interrupted()
    module = asked.command[asked.command.index("-m") + 1]
    program = Path(__file__).parents[2].joinpath(*module.split(".")).with_suffix(".py")
    sys.argv = [str(program), *asked.command[asked.command.index("--ros-args") :]]
    _show_command(asked.command)
    os.write(ready, str(os.getpid()).encode())
    for file in asked.files:
        os.close(file)


def _show_command(words: list[str]) -> None:
    """Let tools such as ps show the node's command line, as far as there is room for it."""
    fields = Path("/proc/self/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    start, end = int(fields[45]), int(fields[46])  # arg_start and arg_end, proc_pid_stat(5)
    line = "\0".join(words).encode(errors="surrogateescape")[: max(end - start - 1, 0)]
    ctypes.memmove(start, line.ljust(end - start, b"\0"), end - start)


if __name__ == "__main__":
    sys.exit(main())
