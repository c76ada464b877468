"""Node processes: started, read, told to end, and ended together, the recorder last."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Collection, Iterable
from pathlib import Path
from typing import IO

from tqdm import tqdm

from us_sim.errors import UsSimError, memory_limit, printable
from us_sim.nodes import ENDS_WITH_INPUT, INTERRUPTED, require_rclpy
from us_sim.nodes.settings import RECORDER, VIEWER
from us_sim.run.forked import ForkedNode
from us_sim.run.plan import NodeProcess, module_of
from us_sim.run.shared_memory import remove_abandoned_segments

LIFELINE, _OTHER_END = os.pipe()
"""Standard input of what is started from here: it ends with this process, whatever ends that."""
COMPLAINT = "us_sim: "  # with which a node begins to say why it cannot work
STOP_S = 1.0  # how long a node may take to end before it is killed
RECORDER_STOP_S = 10.0  # likewise the recorder, which writes what it still holds


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


def child_environment() -> dict[str, str]:
    """Return the environment of a program that finds this package, and ends with its input."""
    package = str(Path(__file__).resolve().parents[2])
    path = os.pathsep.join(filter(None, [package, os.environ.get("PYTHONPATH", "")]))
    return os.environ | {"PYTHONPATH": path, ENDS_WITH_INPUT: "1"}


class RunningNode:
    """A node's process, and the thread that reads its output.

    Args:
        node: what it runs.
        show: what is done with each line of a node.
    """

    def __init__(self, node: NodeProcess, show: Callable[[str, str], None]) -> None:
        self.node = node
        environment = child_environment() | node.secrets
        self.process: subprocess.Popen[str] | ForkedNode
        # The viewer shares little, and shall be there first; elsewhere forks are not safe.
        if node.node == VIEWER or sys.platform != "linux":
            self.process = subprocess.Popen(
                node.command(),
                stdin=LIFELINE,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
                env=environment,
                start_new_session=True,  # so that Ctrl-C is for this process alone
            )
        else:
            self.process = ForkedNode(
                node.node, module_of(node.node), node.arguments(), environment
            )
        self.complaint = ""  # why it cannot work
        self.last_words = ""
        self.is_noted = False  # that it has ended
        self._show = show
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.strip():
                self.last_words = line.strip().removeprefix(COMPLAINT).rpartition("]: ")[2]
            if line.startswith(COMPLAINT):
                self.complaint = self.last_words
            self._show(self.node.node, line)


class ProcessGroup:
    """Processes started together, watched, and ended together: the recorder last.

    Args:
        log: where their output goes; None shows it on this terminal, above any progress.
    """

    def __init__(self, log: Path | None = None) -> None:
        self._running: dict[str, RunningNode] = {}
        self._log_path = log
        self._log: IO[str] | None = log.open("w", encoding="utf-8") if log else None

    def start(self, processes: Iterable[NodeProcess]) -> None:
        """Start each from this very package; they end with this process, whatever happens to it.

        A node of the same name that has ended is replaced; one that runs as it shall goes on.
        """
        remove_abandoned_segments()  # of one that is replaced
        for process in processes:
            if not (self.is_running(process.node) and self._running[process.node].node == process):
                self._running[process.node] = RunningNode(process, self._show)

    def _show(self, node: str, line: str) -> None:
        if self._log is not None:
            with contextlib.suppress(OSError):  # a full disk; the recorder says so itself
                self._log.write(line)
                self._log.flush()
        is_for_person = self._log is None or node == VIEWER  # which says where its page is
        if is_for_person and not line.startswith(COMPLAINT):  # which is said when it has ended
            tqdm.write(printable(line.rstrip()), file=sys.stderr)

    @property
    def pids(self) -> dict[str, int]:
        """The processes' numbers by node, also of those that have ended."""
        return {node: running.process.pid for node, running in self._running.items()}

    def is_running(self, node: str) -> bool:
        """Return whether that node was started and has not ended."""
        running = self._running.get(node)
        return running is not None and running.process.poll() is None

    def take_ended(self) -> dict[str, int]:
        """Return the exit status of each node that has ended; it is told once."""
        ended = {}
        for node, running in self._running.items():
            status = running.process.poll()
            if status is not None and not running.is_noted:
                running.is_noted = True
                running.reader.join(STOP_S)
                ended[node] = status
        return ended

    def last_words(self, node: str) -> str:
        """Return the last line of a node's output, without its logger's prefix."""
        return self._running[node].last_words

    def check(self) -> None:
        """Raise UsSimError, in the node's own words, when one has ended with an error."""
        for node, status in self.take_ended().items():
            if status:
                raise self.failure(node, status)

    def failure(self, node: str, status: int) -> UsSimError:
        """Return why a node cannot work, in its own words where it has said so."""
        see = f"; see {self._log_path}" if self._log_path else ""
        limit = f"; {hint}" if (hint := memory_limit()) else ""
        complaint = self._running[node].complaint
        return UsSimError(complaint or f"{node} {ending(status)}{see}{limit}")

    def end(self, nodes: Collection[str]) -> list[str]:
        """End these nodes; the names of those that had to be killed.

        SIGTERM first, the recorder after the others, SIGKILL at the last. Unlike SIGINT, SIGTERM
        ends a process without a word while it is still importing.
        """
        killed = []
        recorder = {RECORDER} & {*nodes}
        for names, limit in ({*nodes} - recorder, STOP_S), (recorder, RECORDER_STOP_S):
            ending_now = {n: self._running[n].process for n in names if self.is_running(n)}
            for process in ending_now.values():
                process.terminate()
                process.send_signal(signal.SIGCONT)  # it may be stopped
            deadline = time.monotonic() + limit
            for node, process in ending_now.items():
                try:
                    process.wait(max(deadline - time.monotonic(), 0.0))
                except subprocess.TimeoutExpired:
                    process.kill()
                    with contextlib.suppress(subprocess.TimeoutExpired):
                        process.wait(STOP_S)
                    killed.append(node)
        for node in nodes:
            self._running[node].is_noted = True
            self._running[node].reader.join(STOP_S)
        return killed

    def stop(self) -> list[str]:
        """End every process, and remove what they leave; the names of those that were killed."""
        killed = self.end(list(self._running))
        remove_abandoned_segments()
        if self._log is not None:
            with contextlib.suppress(OSError):
                self._log.close()
        return killed


def ending(status: int) -> str:
    """Return an exit status in words; negative ones are signals.

    >>> ending(-9), ending(3)
    ('was ended by SIGKILL', 'ended with status 3')
    """
    if status == INTERRUPTED:
        return "was told to end by a signal"
    if status >= 0:
        return f"ended with status {status}"
    name = signal.Signals(-status).name if -status in {*signal.Signals} else f"signal {-status}"
    return f"was ended by {name}"
