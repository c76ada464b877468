"""The node processes of a scene: which run with which parameters, and how they end together."""

from __future__ import annotations

import contextlib
import functools
import os
import secrets
import signal
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import IO, Any

import yaml
from tqdm import tqdm

from us_sim.errors import UsSimError, memory_limit, printable
from us_sim.nodes.session_settings import SessionRecorderSettings
from us_sim.nodes.settings import checked_parameters
from us_sim.run.deferred_signals import deferred_signals
from us_sim.run.forking import ForkServer
from us_sim.run.running_node import COMPLAINT, STANDING_BY, STOP_S, NodeProcess, RunningNode
from us_sim.scene.scene import Scene
from us_sim.settings.setting import rules_of
from us_sim.settings.viewer import TOKEN, ViewerSettings
from us_sim.share import full_path

__all__ = [
    "NodeProcess",
    "Parameters",
    "ProcessGroup",
    "ending",
    "keep_on_this_host",
    "parameters_file",
    "player_settings",
    "recorder_of",
    "scene_settings",
    "simulation_nodes",
    "video_settings",
    "viewer_process",
]

Parameters = dict[str, dict[str, str]]
"""Parameters given by a person: YAML texts by node and name."""

# Of `us_sim.nodes.process`, which needs rclpy.
INTERRUPTED = 130
RECORDER, VIEWER = "session_recorder", "viewer"
RECORDER_STOP_S = 10.0
"""How long the recorder may take to write what it still holds."""
HUNG_STOP_S = 2.0
"""How long a node that hangs may take to end by itself, before it is killed."""


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


def viewer_process(view: ViewerSettings, given: dict[str, object] | None = None) -> NodeProcess:
    """The process that shows the simulation in browsers, at an address that it says itself."""
    settings: dict[str, object] = {"host": view.host, "port": view.port}
    if view.recordings:
        settings["recordings"] = view.recordings
    return NodeProcess(VIEWER, settings, given or {}, secrets={TOKEN: _viewer_token()})


@functools.cache
def _viewer_token() -> str:
    """One for as long as this program runs: pages find a viewer that was started again by it.

    A person who has set one in the environment keeps it from one run to the next.
    """
    return os.environ.get(TOKEN) or secrets.token_urlsafe(16)


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


def player_settings(
    scene: Scene, path: Path, recorder: SessionRecorderSettings | None, topic: str = ""
) -> dict[str, object]:
    """Parameters of a ``path_player`` that begins when all of the scene's nodes are ready."""
    return {
        "path": str(full_path(path)),
        "topic": topic,
        **_awaited(["tracker/pose", *scene.ready_topics], recorder),
    }


def video_settings(
    scene: Scene, video: Path, info: Path, recorder: SessionRecorderSettings | None
) -> dict[str, object]:
    """Parameters of a ``camera_driver`` that begins when all of the scene's nodes are ready."""
    return {
        "source": str(video),
        "camera_info": str(info),
        **_awaited(["camera/camera_info", *scene.ready_topics], recorder),
    }


def _awaited(topics: Sequence[str], recorder: SessionRecorderSettings | None) -> dict[str, object]:
    """Parameters that have a player wait for these topics, and for a recorder to record them."""
    recorded = [topic for topic in topics if recorder and recorder.records(f"/{topic}")]
    return {"await_topics": topics, "await_recorded": recorded or [""]}  # [] has no type


def recorder_of(processes: Iterable[NodeProcess]) -> SessionRecorderSettings | None:
    """The settings of the recorder among them."""
    for process in processes:
        if process.node == RECORDER:
            known = rules_of(SessionRecorderSettings).keys() & process.all_parameters
            values: Any = {name: process.all_parameters[name] for name in known}
            return SessionRecorderSettings(**values)
    return None


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
        forks: that they are forked from; None starts each as a program.
    """

    def __init__(self, log: Path | None = None, forks: ForkServer | None = None) -> None:
        self._forks = forks
        self._running: dict[str, RunningNode] = {}
        self._standbys: dict[str, RunningNode] = {}
        self._leaving: list[tuple[str, RunningNode, float]] = []  # and until when they may take
        self._log_path = log
        self._log: IO[str] | None = log.open("w", encoding="utf-8") if log else None

    def start(self, processes: Iterable[NodeProcess]) -> None:
        """Start each from this very package; they end with this process, whatever happens to it.

        A node of the same name that has ended is replaced, by one that stands by if there is one;
        one that runs as it shall goes on.
        """
        for process in processes:
            if self.is_running(process.node) and self._running[process.node].node == process:
                continue
            with deferred_signals():
                standby = self._standbys.pop(process.node, None)
                show = self._tell if process.node == VIEWER else self._show
                if standby is None or not standby.go_on(process, show):
                    standby = RunningNode(process, show, self._forks)
                self._running[process.node] = standby

    def stand_by(self, process: NodeProcess) -> bool:
        """Have a second process of a node; whether it is ready."""
        standby = self._standbys.get(process.node)
        if standby is None or standby.process.poll() is not None:
            with deferred_signals():
                standby = RunningNode(process, None, self._forks)
                self._standbys[process.node] = standby
        return standby.said == STANDING_BY

    def _tell(self, line: str) -> None:
        """Show a line to the person, too, whom it tells where the page is."""
        self._show(line)
        if self._log is not None and not line.startswith(COMPLAINT):
            tqdm.write(printable(line.rstrip()), file=sys.stderr)

    def _show(self, line: str) -> None:
        """Put a node's line where it belongs."""
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
        limit = f"; {hint}" if (hint := memory_limit()) else ""
        return UsSimError(complaint or f"{node} {ending(status)}{see}{limit}")

    def end(self, node: str) -> None:
        """End one that hangs: it may do so by itself for a moment, also if it was stopped."""
        running = self._running[node]
        running.wait_after_sigterm(HUNG_STOP_S)
        running.kill()
        running.told = True

    def dismiss(self, node: str) -> None:
        """Tell one to end, without waiting for that: `leaving` says when it has."""
        standby = self._standbys.pop(node, None)
        if standby is not None:
            standby.kill()
        running = self._running.pop(node, None)
        if running is not None:
            patience = RECORDER_STOP_S if node == RECORDER else STOP_S
            running.tell_to_end()
            self._leaving.append((node, running, time.monotonic() + patience))

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
            self._running[RECORDER].wait_after_sigterm(RECORDER_STOP_S)
        for _, running, until in self._leaving:
            running.wait(until - time.monotonic())
        every = [*self._running.items(), *((node, running) for node, running, _ in self._leaving)]
        killed = [node for node, running in every if running.kill()]
        for running in self._standbys.values():
            running.kill()
        for running in (*(running for _, running in every), *self._standbys.values()):
            running.reader.join(STOP_S)
        if self._log is not None:
            with contextlib.suppress(OSError):
                self._log.close()
        return killed


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
