"""The node processes of a scene: which run with which parameters, and how they end together."""

from __future__ import annotations

import contextlib
import ctypes
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import yaml
from tqdm import tqdm

from us_sim.errors import UsSimError
from us_sim.nodes.settings import checked_parameters
from us_sim.run.deferred_signals import deferred_signals
from us_sim.run.parameter_texts import require_texts
from us_sim.scene.scene import Scene

__all__ = [
    "NodeProcess",
    "Parameters",
    "ProcessGroup",
    "ending",
    "keep_on_this_host",
    "parameters_file",
    "player_settings",
    "scene_settings",
    "simulation_nodes",
    "video_settings",
]

Parameters = dict[str, dict[str, str]]
"""Parameters given by a person: YAML texts by node and name."""

_PR_SET_PDEATHSIG = 1
_THIS_PROGRAM = ctypes.CDLL(None)
_COMPLAINT = "us_sim: "
# Of `us_sim.nodes.process` and `us_sim.nodes.standby`, which need rclpy.
INTERRUPTED = 130
STANDBY, STANDING_BY = "US_SIM_STANDBY", "standing by"
RECORDER = "session_recorder"
STOP_S = 0.8
"""How long nodes may take to end before the recorder is told to."""
RECORDER_STOP_S = 10.0
"""How long the recorder may take to write what it still holds."""
HUNG_STOP_S = 2.0
"""How long a node that hangs may take to end by itself, before it is killed."""


@dataclass(frozen=True)
class NodeProcess:
    """One node and its parameters."""

    node: str
    parameters: dict[str, object] = field(default_factory=dict)  # JSON-like values by name
    given: dict[str, object] = field(default_factory=dict)  # more, which a person gave

    def __post_init__(self) -> None:
        require_texts(self.all_parameters)

    def command(self) -> list[str]:
        """The command line that runs it, in ROS 2 and without."""
        command = [sys.executable, "-P", "-m", f"us_sim.nodes.{self.node}", "--ros-args"]
        for name, value in self.all_parameters.items():
            command += ["-p", f"{name}:={json.dumps(value)}"]
        return command

    @property
    def all_parameters(self) -> dict[str, object]:
        """Those that a person gave go before the others."""
        return self.parameters | self.given


def simulation_nodes(
    scene: Scene, parameters: Parameters | None = None, *, played: bool = False
) -> list[NodeProcess]:
    """The nodes that ``scene`` needs.

    Args:
        scene: what they work on.
        parameters: extra ones by node, as YAML texts.
        played: a path is played on ``tracker/pose``, whatever the scene's tracker is.

    Raises:
        UsSimError: a parameter is for a node that this scene does not run.
    """
    given = dict(parameters or {})
    common = scene_settings(scene)
    nodes = [
        NodeProcess(
            part.node,
            common | ({"source": "pose"} if played and part.node == "probe_tracker" else {}),
            checked_parameters(part.node, scene, given.pop(part.node, {})),
        )
        for part in scene.parts()
        if part.needed
    ]
    if given:
        raise UsSimError(
            f"--param {next(iter(given))}: this scene does not run such a node; it runs "
            f"{', '.join(process.node for process in nodes)}"
        )
    return nodes


def scene_settings(scene: Scene) -> dict[str, object]:
    """The parameters that tell a node the scene, as every node takes them."""
    settings: dict[str, object] = {"scene": scene.origin}
    if scene.volume.file:
        settings["volume"] = scene.volume.file
    return settings


def parameters_file(processes: Sequence[NodeProcess]) -> str:
    """The parameters of nodes as ROS reads them with ``--params-file``."""
    document = {process.node: {"ros__parameters": process.all_parameters} for process in processes}
    text: str = yaml.safe_dump(document, sort_keys=False)
    return text


def player_settings(scene: Scene, path: Path, *, recorded: bool) -> dict[str, object]:
    """Parameters of a ``path_player`` that begins when all of the scene's nodes are ready."""
    return {
        "path": str(path.expanduser().resolve()),
        "topic": (scene.tracker.body or "") if scene.tracker.source.name == "path" else "",
        "await_topics": ["tracker/pose", *scene.ready_topics],
        "await_subscriber": "session_recorder" if recorded else "",
    }


def video_settings(scene: Scene, video: Path, info: Path, *, recorded: bool) -> dict[str, object]:
    """Parameters of a ``camera_driver`` that begins when all of the scene's nodes are ready."""
    return {
        "source": str(video),
        "camera_info": str(info),
        "await_topics": ["camera/camera_info", *scene.ready_topics],
        "await_subscriber": "session_recorder" if recorded else "",
    }


def keep_on_this_host(*, network: bool) -> None:
    """Let what this process starts talk on this host only, unless the environment says otherwise.

    Nobody on a hospital's network should meet a simulator by accident.
    """
    if not network:
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")


class ProcessGroup:
    """Processes started together, watched, and ended together: the recorder last.

    Args:
        log: where their output goes; None shows it on this terminal, above any progress.
    """

    def __init__(self, log: Path | None = None) -> None:
        self._running: dict[str, _Running] = {}
        self._standbys: dict[str, _Running] = {}
        self._log_path = log
        self._log: IO[str] | None = log.open("w", encoding="utf-8") if log else None

    def start(self, processes: Iterable[NodeProcess]) -> None:
        """Start each from this very package; they end with this process, whatever happens to it.

        A node of the same name that has ended is replaced, by one that stands by if there is one.
        """
        for process in processes:
            with deferred_signals():
                standby = self._standbys.pop(process.node, None)
                if standby is None or not standby.go_on(process, self._show):
                    standby = _Running(process, self._show)
                self._running[process.node] = standby

    def stand_by(self, process: NodeProcess) -> bool:
        """Have a second process of a node; whether it is ready."""
        standby = self._standbys.get(process.node)
        if standby is None or standby.process.poll() is not None:
            with deferred_signals():
                standby = self._standbys[process.node] = _Running(process, None)
        return standby.said == STANDING_BY

    def _show(self, line: str) -> None:
        """Put a node's line where it belongs."""
        if self._log is not None:
            with contextlib.suppress(OSError):  # a full disk; the recorder says so itself
                self._log.write(line)
                self._log.flush()
        elif not line.startswith(_COMPLAINT):  # which is said when the node has ended
            tqdm.write(line.rstrip(), file=sys.stderr)

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
        """The last line of a node's output, without what its logger puts before it."""
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
        return UsSimError(complaint or f"{node} {ending(status)}{see}")

    def end(self, node: str) -> None:
        """End one that hangs: it may do so by itself for a moment, also if it was stopped."""
        running = self._running[node]
        running.wait_after_sigterm(HUNG_STOP_S)
        running.kill()
        running.told = True

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
            self._running[RECORDER].wait_after_sigterm(RECORDER_STOP_S)
        killed = [node for node, running in self._running.items() if running.kill()]
        for running in self._standbys.values():
            running.kill()
        for running in (*self._running.values(), *self._standbys.values()):
            running.reader.join(STOP_S)
        if self._log is not None:
            with contextlib.suppress(OSError):
                self._log.close()
        return killed


class _Running:
    """A node's process, and the thread that reads what it says.

    Args:
        node: what it runs.
        show: what is done with its lines; None for one that stands by.
    """

    def __init__(self, node: NodeProcess, show: Callable[[str], None] | None) -> None:
        package = str(Path(__file__).resolve().parents[2])
        search = [package, os.environ.get("PYTHONPATH", "")]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, search))}
        self._node = node
        self.process = subprocess.Popen(
            node.command(),
            stdin=subprocess.DEVNULL if show else subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env=environment if show else environment | {STANDBY: "1"},
            start_new_session=True,
            preexec_fn=_end_with_parent if sys.platform == "linux" else None,
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
            raise UsSimError(f"{node.node} cannot be followed: {error}") from None

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.strip():
                self.said = line.strip().removeprefix(_COMPLAINT).rpartition("]: ")[2]
            if line.startswith(_COMPLAINT):
                self.complaint = self.said
            if self._show is not None:
                self._show(line)

    def go_on(self, node: NodeProcess, show: Callable[[str], None]) -> bool:
        """Run the node in earnest after standing by; whether it can."""
        assert self.process.stdin is not None
        if self.said != STANDING_BY or node != self._node:
            self.kill()
            return False
        self._show = show
        try:
            self.process.stdin.write("\n")
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


def ending(status: int) -> str:
    """What an exit status says, for a person: negative ones are signals."""
    if status == INTERRUPTED:
        return "was told to end by a signal"
    if status >= 0:
        return f"ended with status {status}"
    try:
        return f"was ended by {signal.Signals(-status).name}"
    except ValueError:
        return f"was ended by signal {-status}"


def _end_with_parent() -> None:
    _THIS_PROGRAM.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
