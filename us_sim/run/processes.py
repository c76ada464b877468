"""A node as a process: started, read, and told to end.

On Linux nodes are forked from a process that has imported what they share, so that they start
soon: multiprocessing's fork server, which never imports rclpy, since its tracing starts threads.
Where it is killed, so are they, and a process that keeps what is imported forks another at once.
"""

from __future__ import annotations

import contextlib
import ctypes
import importlib
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.forkserver import ensure_running
from typing import TYPE_CHECKING, Any

from us_sim.nodes import INTERRUPTED, prepare_process, require_rclpy

if TYPE_CHECKING:
    from us_sim.run.plan import NodeProcess

COMPLAINT = "us_sim: "  # with which a node begins to say why it cannot work
STOP_S = 1.0  # how long a node may take to end before it is killed
_UNKNOWN = 255  # the exit status of what was forked by a server that has ended
_PR_SET_PDEATHSIG = 1

_spawning: Any = multiprocessing.get_context("spawn")
_can_fork = sys.platform == "linux"  # elsewhere forks are not safe
_forking: Any = multiprocessing.get_context("forkserver" if _can_fork else "spawn")
_forking.set_forkserver_preload([f"{__package__}.preloaded"])


@contextlib.contextmanager
def _without_interrupts() -> Iterator[None]:
    """Block Ctrl-C in processes started within, until each has a session of its own."""
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})


def begin_fork_server() -> None:
    """Have the server import what nodes share while this process does something else."""
    if _can_fork:
        resource_tracker.ensure_running()  # which lets Ctrl-C through when it has been started
        with _without_interrupts():
            ensure_running()


def prepare_ros(*, network: bool) -> None:
    """Require rclpy, and keep what is started from here on this host, unless ``network`` is true.

    Nobody on a hospital's network should meet a simulator by accident.

    Raises:
        UsSimError: rclpy is not installed.
    """
    require_rclpy()
    if not network:
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


def end_with_parent(number: signal.Signals) -> None:
    """Have this process get a signal when the one that started it ends."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)
        return

    def end() -> None:
        multiprocessing.connection.wait([multiprocessing.parent_process().sentinel])
        os.kill(os.getpid(), number)

    threading.Thread(target=end, daemon=True).start()


class RunningNode:
    """A node's process, which ends with this one, and the thread that reads its output.

    Args:
        node: what it runs.
        show: what is done with each line of a node.
        is_forked: whether it shares with others what they import.
    """

    def __init__(
        self, node: NodeProcess, show: Callable[[str, str], None], *, is_forked: bool = True
    ) -> None:
        self.node = node
        self.complaint = ""  # why it cannot work
        self.last_words = ""
        self.is_noted = False  # that it has ended
        self.reports, self.heard_at = -1, 0.0  # so far, and when the last came, for who watches it
        output, its_output = _forking.Pipe(duplex=False)
        its_own = (node.node, node.module, node.arguments(), os.environ | node.secrets, its_output)
        context = _forking if is_forked else _spawning
        self._process = context.Process(target=_run_node, args=its_own, daemon=True)
        with _without_interrupts():
            self._process.start()
        its_output.close()
        self.pid: int = self._process.pid
        self._reader = threading.Thread(target=self._read, args=(output, show), daemon=True)
        self._reader.start()

    def _read(self, output: Connection, show: Callable[[str, str], None]) -> None:
        with open(os.dup(output.fileno()), errors="replace") as lines:
            output.close()
            for line in lines:
                if line.strip():
                    self.last_words = line.strip().removeprefix(COMPLAINT).rpartition("]: ")[2]
                if line.startswith(COMPLAINT):
                    self.complaint = self.last_words
                show(self.node.node, line)

    @property
    def status(self) -> int | None:
        """Return the exit status; None while it runs, negative for a signal."""
        status: int | None = self._process.exitcode
        return INTERRUPTED if status == _UNKNOWN else status  # it is told to end then

    def wait(self, seconds: float) -> bool:
        """Wait for its end; return whether it has ended."""
        self._process.join(seconds)
        return self.status is not None

    def send_signal(self, number: signal.Signals) -> None:
        """Send a signal, unless it has ended."""
        if self.status is None:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def note_end(self) -> None:
        """Read the rest of its output; its end is known from now on."""
        self.is_noted = True
        self._reader.join(STOP_S)


def end_nodes(nodes: Collection[RunningNode], limit: float = STOP_S) -> list[str]:
    """End these nodes together; return the names of those that had to be killed.

    SIGTERM first, SIGKILL after ``limit`` seconds. Unlike SIGINT, SIGTERM ends a process without a
    word while it is still importing.
    """
    for each in nodes:
        each.send_signal(signal.SIGTERM)
        each.send_signal(signal.SIGCONT)  # it may be stopped
    deadline = time.monotonic() + limit
    killed = [each for each in nodes if not each.wait(max(deadline - time.monotonic(), 0.0))]
    for each in killed:
        each.send_signal(signal.SIGKILL)
        each.wait(STOP_S)
    for each in nodes:
        each.note_end()
    return [each.node.node for each in killed]


def describe_ending(status: int) -> str:
    """Return an exit status in words; negative ones are signals.

    >>> describe_ending(-9), describe_ending(3)
    ('was ended by SIGKILL', 'ended with status 3')
    """
    if status == INTERRUPTED:
        return "was told to end by a signal"
    if status >= 0:
        return f"ended with status {status}"
    name = signal.Signals(-status).name if -status in {*signal.Signals} else f"signal {-status}"
    return f"was ended by {name}"


def _run_node(
    name: str,
    module: str,
    arguments: list[str],
    environment: Mapping[str, str],
    output: Connection,
) -> None:
    """Become the node, in the process that was started."""
    end_with_parent(signal.SIGTERM)
    os.setsid()  # so that Ctrl-C is for the process that started it alone
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    for number in 1, 2:
        os.dup2(output.fileno(), number)
    output.close()
    for stream in sys.stdout, sys.stderr:
        stream.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    prepare_process(name)  # setproctitle finds its place beside the environment that was there
    os.environ.clear()
    os.environ.update(environment)
    sys.argv = [name, *arguments]
    sys.exit(importlib.import_module(module).main(arguments))
