"""A node as a process of its own: how it is started, what it says, how it is ended."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass, field

from us_sim.errors import UsSimError, memory_limit
from us_sim.run.end_with_parent import end_with_parent
from us_sim.run.forking import ForkedProcess, ForkServer, package_on_path
from us_sim.run.parameter_texts import require_texts

COMPLAINT = "us_sim: "
"""With which a node begins to say why it cannot work."""
STOP_S = 0.8
"""How long nodes may take to end before the recorder is told to."""
# Of `us_sim.nodes.standby`, which needs rclpy.
STANDBY, STANDING_BY = "US_SIM_STANDBY", "standing by"


def module_of(node: str) -> str:
    """The module that runs a node."""
    return "us_sim.viewer.viewer" if node == "viewer" else f"us_sim.nodes.{node}"


@dataclass(frozen=True)
class NodeProcess:
    """One node and its parameters."""

    node: str
    parameters: dict[str, object] = field(default_factory=dict)  # JSON-like values by name
    given: dict[str, object] = field(default_factory=dict)  # more, which a person gave
    secrets: dict[str, str] = field(default_factory=dict, repr=False)  # in its environment alone
    kept: dict[str, object] = field(default_factory=dict)  # and more, which were set as it ran

    def __post_init__(self) -> None:
        require_texts(self.all_parameters)

    def command(self) -> list[str]:
        """The command line that runs it, in ROS 2 and without."""
        return [sys.executable, "-P", "-m", module_of(self.node), *self.arguments()]

    def arguments(self) -> list[str]:
        """Those of the command line, by which it gets its parameters."""
        arguments = ["--ros-args"]
        for name, value in self.all_parameters.items():
            arguments += ["-p", f"{name}:={json.dumps(value)}"]
        return arguments

    @property
    def all_parameters(self) -> dict[str, object]:
        """Those that were set last go before the others."""
        return self.parameters | self.given | self.kept


class RunningNode:
    """A node's process, and the thread that reads what it says.

    Args:
        node: what it runs.
        show: what is done with its lines; None for one that stands by.
        forks: that it is forked from, where that can be.
    """

    def __init__(
        self,
        node: NodeProcess,
        show: Callable[[str], None] | None,
        forks: ForkServer | None = None,
    ) -> None:
        command = node.command()
        environment = os.environ | {"PYTHONPATH": package_on_path()}
        environment |= node.secrets
        environment |= {} if show else {STANDBY: "1"}
        self.node = node
        is_fed = show is None
        forked = forks.fork(node.node, command, environment, is_fed=is_fed) if forks else None
        self.process: subprocess.Popen[str] | ForkedProcess = forked or subprocess.Popen(
            command,
            stdin=subprocess.PIPE if is_fed else subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env=environment,
            start_new_session=True,
            preexec_fn=end_with_parent if sys.platform == "linux" else None,
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
            if self._show is not None:
                self._show(line)

    def go_on(self, node: NodeProcess, show: Callable[[str], None]) -> bool:
        """Run the node in earnest, as it is wanted now, after standing by; whether it can."""
        assert self.process.stdin is not None
        if self.said != STANDING_BY:
            self.kill()
            return False
        self.node, self._show = node, show
        try:
            self.process.stdin.write(json.dumps(node.arguments()) + "\n")
            self.process.stdin.close()
        except OSError:
            return False
        return True

    def tell_to_end(self) -> None:
        """SIGTERM, which one that was stopped gets, too."""
        if self.process.poll() is None:
            self.process.terminate()
            self.process.send_signal(signal.SIGCONT)

    def wait(self, seconds: float) -> None:
        """Wait for its end, at most so long."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(max(seconds, 0.0))

    def wait_after_sigterm(self, seconds: float) -> None:
        """Tell it to end, and wait at most so long."""
        self.tell_to_end()
        self.wait(seconds)

    def kill(self) -> bool:
        """End it for certain; whether it had not ended by itself."""
        if self.process.poll() is not None:
            return False
        self.process.kill()
        self.wait(STOP_S)  # one that waits for a disk ends when that answers
        return True
