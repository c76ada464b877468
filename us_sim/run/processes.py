"""Node processes: started, read, told to end, and ended together, the recorder last."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import IO

from tqdm import tqdm

from us_sim.errors import UsSimError, memory_limit, printable
from us_sim.nodes import ENDS_WITH_INPUT, INTERRUPTED, require_rclpy
from us_sim.nodes.settings import RECORDER, VIEWER
from us_sim.run.plan import NodeProcess
from us_sim.run.shared_memory import remove_abandoned_segments, remove_unused_ports

LIFELINE, _OTHER_END = os.pipe()
"""Standard input of what is started from here: it ends with this process, whatever ends that."""


def child_environment() -> dict[str, str]:
    """Environment of a program that finds this very package, and ends with its standard input."""
    package = str(Path(__file__).resolve().parents[2])
    path = os.pathsep.join(filter(None, [package, os.environ.get("PYTHONPATH", "")]))
    return os.environ | {"PYTHONPATH": path, ENDS_WITH_INPUT: "1"}


COMPLAINT = "us_sim: "  # with which a node begins to say why it cannot work
STOP_S = 0.8  # how long nodes may take to end before the recorder is told to


class RunningNode:
    """A node's process, and the thread that reads its output.

    Args:
        node: what it runs.
        show: what is done with its lines.
    """

    def __init__(self, node: NodeProcess, show: Callable[[str], None]) -> None:
        self.node = node
        self.process = subprocess.Popen(
            node.command(),
            stdin=LIFELINE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env=child_environment() | node.secrets,
            start_new_session=True,
        )
        self.complaint = ""  # why it cannot work
        self.said = ""
        self.told = False  # that it has ended
        self._show = show
        self.reader = threading.Thread(target=self._read, daemon=True)
        try:
            self.reader.start()
        except RuntimeError as error:
            self.process.kill()
            self.process.wait()
            told = [f"{node.node} cannot be followed: {error}", memory_limit()]
            raise UsSimError("; ".join(filter(None, told))) from None

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.strip():
                self.said = line.strip().removeprefix(COMPLAINT).rpartition("]: ")[2]
            if line.startswith(COMPLAINT):
                self.complaint = self.said
            self._show(line)

    def tell_to_end(self) -> None:
        """SIGTERM, which one that was stopped gets, too."""
        if self.process.poll() is None:
            self.process.terminate()
            self.process.send_signal(signal.SIGCONT)

    def wait(self, seconds: float) -> None:
        """Wait for its end, at most so long."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(max(seconds, 0.0))

    def kill(self) -> bool:
        """End it for certain; whether it had not ended by itself."""
        if self.process.poll() is not None:
            return False
        self.process.kill()
        self.wait(STOP_S)  # one that waits for a disk ends when that answers
        return True


RECORDER_STOP_S = 10.0  # how long the recorder may take to write what it still holds
HUNG_STOP_S = 2.0  # how long a node that hangs may take to end by itself, before it is killed


def prepare_ros(*, network: bool) -> None:
    """Require rclpy, and keep what is started from here on this host.

    Nobody on a hospital's network should meet a simulator by accident.

    Args:
        network: talk beyond this host, as the environment says.

    Raises:
        UsSimError: rclpy is not installed.
    """
    require_rclpy()
    if not network:
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


class ProcessGroup:
    """Processes started together, watched, and ended together: the recorder last.

    Args:
        log: where their output goes; None shows it on this terminal, above any progress.
    """

    def __init__(self, log: Path | None = None) -> None:
        self._running: dict[str, RunningNode] = {}
        self._leaving: list[tuple[str, RunningNode, float]] = []  # and until when they may take
        self._log_path = log
        self._log: IO[str] | None = log.open("w", encoding="utf-8") if log else None

    def start(self, processes: Iterable[NodeProcess]) -> None:
        """Start each from this very package; they end with this process, whatever happens to it.

        A node of the same name that has ended is replaced; one that runs as it shall goes on.
        """
        remove_abandoned_segments()  # of one that is replaced
        for process in processes:
            if self.is_running(process.node) and self._running[process.node].node == process:
                continue
            show = self._tell if process.node == VIEWER else self._show
            self._running[process.node] = RunningNode(process, show)

    def _tell(self, line: str) -> None:
        """Show a line to the person, too, whom it tells where the page is."""
        self._show(line)
        if self._log is not None and not line.startswith(COMPLAINT):
            tqdm.write(printable(line.rstrip()), file=sys.stderr)

    def _show(self, line: str) -> None:
        if self._log is not None:
            with contextlib.suppress(OSError):  # a full disk; the recorder says so itself
                self._log.write(line)
                self._log.flush()
        elif not line.startswith(COMPLAINT):  # which is said when the node has ended
            tqdm.write(printable(line.rstrip()), file=sys.stderr)

    @property
    def pids(self) -> dict[str, int]:
        """The processes' numbers by node, also of those that have ended."""
        return {node: running.process.pid for node, running in self._running.items()}

    def is_running(self, node: str) -> bool:
        """Whether that node was started and has not ended."""
        running = self._running.get(node)
        return running is not None and running.process.poll() is None

    def take_ended(self) -> dict[str, int]:
        """The exit status of each node that has ended; it is told once."""
        ended = {}
        for node, running in self._running.items():
            status = running.process.poll()
            if status is not None and not running.told:
                running.told = True
                running.reader.join(STOP_S)
                ended[node] = status
        return ended

    def last_words(self, node: str) -> str:
        """The last line of a node's output, without its logger's prefix."""
        return self._running[node].said

    def check(self) -> None:
        """Raise UsSimError, in the node's own words, when one has ended with an error."""
        for node, status in self.take_ended().items():
            if status:
                raise self.failure(node, status)

    def failure(self, node: str, status: int) -> UsSimError:
        """Why a node cannot work, in its own words where it has said so."""
        see = f"; see {self._log_path}" if self._log_path else ""
        complaint = self._running[node].complaint
        limit = f"; {hint}" if (hint := memory_limit()) else ""
        return UsSimError(complaint or f"{node} {ending(status)}{see}{limit}")

    def end(self, node: str) -> None:
        """End one that hangs: it may do so by itself for a moment, also if it was stopped."""
        running = self._running[node]
        running.tell_to_end()
        running.wait(HUNG_STOP_S)
        running.kill()
        running.told = True

    def dismiss(self, node: str) -> None:
        """Tell one to end, without waiting for that: `leaving` says when it has."""
        running = self._running.pop(node, None)
        if running is not None:
            limit = RECORDER_STOP_S if node == RECORDER else STOP_S
            running.tell_to_end()
            self._leaving.append((node, running, time.monotonic() + limit))

    def leaving(self) -> dict[str, bool]:
        """Nodes that were dismissed and are not gone, or were killed since this was asked last.

        The value says the latter: such a node has taken longer than it may.
        """
        now, there, still = time.monotonic(), {}, []
        for node, running, until in self._leaving:
            if running.process.poll() is not None:
                continue
            there[node] = now > until and running.kill()
            if not there[node]:
                still.append((node, running, until))
        self._leaving = still
        return there

    def stop(self) -> list[str]:
        """End every process; the names of those that had to be killed.

        SIGTERM first, the recorder after the others, SIGKILL at the last. Unlike SIGINT, SIGTERM
        ends a process without a word while it is still importing.
        """
        others = [running for node, running in self._running.items() if node != RECORDER]
        deadline = time.monotonic() + STOP_S
        for running in others:
            running.tell_to_end()
        for running in others:
            running.wait(deadline - time.monotonic())
        if RECORDER in self._running:
            self._running[RECORDER].tell_to_end()
            self._running[RECORDER].wait(RECORDER_STOP_S)
        for _, running, until in self._leaving:
            running.wait(until - time.monotonic())
        every = [*self._running.items(), *((node, running) for node, running, _ in self._leaving)]
        killed = [node for node, running in every if running.kill()]
        for _, running in every:
            running.reader.join(STOP_S)
        remove_abandoned_segments()
        remove_unused_ports()
        if self._log is not None:
            with contextlib.suppress(OSError):
                self._log.close()
        return killed


def ending(status: int) -> str:
    """An exit status in words; negative ones are signals."""
    if status == INTERRUPTED:
        return "was told to end by a signal"
    if status >= 0:
        return f"ended with status {status}"
    try:
        return f"was ended by {signal.Signals(-status).name}"
    except ValueError:
        return f"was ended by signal {-status}"
