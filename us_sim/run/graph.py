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
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import yaml
from tqdm import tqdm

from us_sim.errors import UsSimError
from us_sim.nodes.settings import checked_parameters
from us_sim.scene.scene import Scene

__all__ = [
    "NodeProcess",
    "Parameters",
    "ProcessGroup",
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
STOP_S = 0.8
"""How long nodes may take to end before the recorder is told to; then as long again at most."""


@dataclass(frozen=True)
class NodeProcess:
    """One node and its parameters."""

    node: str
    parameters: dict[str, object] = field(default_factory=dict)  # JSON-like values by name
    given: dict[str, object] = field(default_factory=dict)  # more, which a person gave

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
        self._processes: dict[str, subprocess.Popen[str]] = {}
        self._readers: list[threading.Thread] = []
        self._complaints: dict[str, str] = {}
        self._log_path = log
        self._log: IO[str] | None = log.open("w", encoding="utf-8") if log else None

    def start(self, processes: Sequence[NodeProcess]) -> None:
        """Start each from this very package; they end with this process, whatever happens to it."""
        package = str(Path(__file__).resolve().parents[2])
        search = [package, os.environ.get("PYTHONPATH", "")]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, search))}
        for process in processes:
            started = subprocess.Popen(
                process.command(),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
                env=environment,
                start_new_session=True,
                preexec_fn=_end_with_parent if sys.platform == "linux" else None,
            )
            self._processes[process.node] = started
            reader = threading.Thread(target=self._pass_on, args=(process.node, started))
            self._readers.append(reader)
        for reader in self._readers:
            reader.start()

    def _pass_on(self, node: str, process: subprocess.Popen[str]) -> None:
        """Put a node's lines where they belong; keep the one that says why it cannot work."""
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith("us_sim: "):
                self._complaints[node] = line.removeprefix("us_sim: ").strip()
            if self._log is not None:
                with contextlib.suppress(OSError):  # a full disk; the recorder says so itself
                    self._log.write(line)
                    self._log.flush()
            elif node not in self._complaints:
                tqdm.write(line.rstrip(), file=sys.stderr)

    @property
    def pids(self) -> dict[str, int]:
        """The processes' numbers by node."""
        return {node: process.pid for node, process in self._processes.items()}

    def is_running(self, node: str) -> bool:
        """Whether that node was started and has not ended."""
        process = self._processes.get(node)
        return process is not None and process.poll() is None

    def check(self) -> None:
        """Raise UsSimError, in the node's own words, when one has ended with an error."""
        for (node, process), reader in zip(self._processes.items(), self._readers, strict=True):
            status = process.poll()
            if status:
                reader.join(STOP_S)
                see = f"; see {self._log_path}" if self._log_path else ""
                complaint = f"{node} ended with status {status}{see}"
                raise UsSimError(self._complaints.get(node, complaint))

    def stop(self) -> None:
        """End every process: SIGTERM first, the recorder after the others, SIGKILL at the last.

        Unlike SIGINT, SIGTERM ends a process without a word while it is still importing.
        """
        recorder = "session_recorder"
        self._terminate([node for node in self._processes if node != recorder])
        self._terminate([recorder] if recorder in self._processes else [])
        for process in self._processes.values():
            if process.poll() is None:
                process.kill()
                process.wait()
        for reader in self._readers:
            if reader.is_alive():
                reader.join(STOP_S)
        if self._log is not None:
            with contextlib.suppress(OSError):
                self._log.close()

    def _terminate(self, nodes: list[str]) -> None:
        waiting = [self._processes[node] for node in nodes]
        for process in waiting:
            if process.poll() is None:
                process.terminate()
        deadline = time.monotonic() + STOP_S
        for process in waiting:
            try:
                process.wait(max(deadline - time.monotonic(), 0.0))
            except subprocess.TimeoutExpired:
                process.kill()


def _end_with_parent() -> None:
    _THIS_PROGRAM.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
