"""The processes of a run: the nodes of a scene with their parameters, a recorder, a player, a page.

A `Request` says what a person wants; `plan_of` makes a `Plan` of processes from it.
"""

from __future__ import annotations

import functools
import json
import os
import posixpath
import secrets
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml

from us_sim.errors import SceneError, SettingsError, UsSimError
from us_sim.nodes.settings import RECORDER, VIEWER, SessionRecorderSettings, checked_parameters
from us_sim.run.domain import enclave_of, namespace, ros_arguments
from us_sim.scene.building import path_of
from us_sim.scene.scene import Scene
from us_sim.settings.setting import rules_of
from us_sim.settings.viewer import TOKEN, ViewerSettings
from us_sim.share import full_path
from us_sim.viewer.server import require_free

Parameters = dict[str, dict[str, str]]  # parameters given by a person: YAML texts by node and name


@dataclass(frozen=True)
class NodeProcess:
    """One node and its parameters."""

    node: str
    parameters: dict[str, object] = field(default_factory=dict)  # JSON-like values by name
    secrets: dict[str, str] = field(default_factory=dict, repr=False)  # in its environment alone

    @property
    def module(self) -> str:
        """The module that runs it."""
        return "us_sim.viewer.viewer" if self.node == VIEWER else f"us_sim.nodes.{self.node}"

    def arguments(self) -> list[str]:
        """ROS arguments: its enclave, those that all nodes get, and its parameters."""
        arguments = ["--ros-args", "--enclave", enclave_of(self.node), *ros_arguments()]
        for name, value in self.parameters.items():
            arguments += ["-p", f"{name}:={json.dumps(value)}"]
        return arguments


@dataclass(frozen=True)
class Request:
    """A scene to run, with its recording, its path and its page."""

    scene: Scene
    parameters: Parameters = field(default_factory=dict)  # given by a person, by node
    record: Path | None = None  # MCAP file to record to
    path: Path | None = None  # bag to play to the tracker
    topic: str | None = None  # of the body in it whose poses are played
    everything: bool = False  # the bag's topics are published in place of the scene's nodes
    playing: Mapping[str, object] = field(default_factory=dict)  # parameters of the player
    view: ViewerSettings | None = None  # address of the page that shows it; None is no page
    by_hand: bool = False  # poses come on `tracker/pose`, whatever the scene's tracker is
    duration: float | None = None  # s, after which all ends
    is_changed: bool = False  # while it ran: parameters may be of nodes that do not run now

    def with_path(self) -> Request:
        """Return the same with the scene's own path, where no other is to be played.

        Raises:
            SceneError: it has none.
        """
        if self.path is not None:
            return self
        if self.scene.path is None:
            raise SceneError(f"{self.scene.origin}: path: is missing; name a bag with --path")
        return replace(self, path=Path(self.scene.path))

    def with_scene(self, scene: Scene) -> Request:
        """Another scene, in which nothing is recorded or played yet.

        Parameters of the scene's nodes were given for the scene before.
        """
        of_any_scene = (VIEWER, RECORDER, "path_player")
        kept = {node: given for node, given in self.parameters.items() if node in of_any_scene}
        return replace(self.without_replay(), scene=scene, parameters=kept, record=None)

    def without_replay(self) -> Request:
        """The same with nothing played."""
        return replace(self, path=None, topic=None, everything=False, playing={}, is_changed=True)


@dataclass(frozen=True)
class Plan:
    """The processes of a live run, and how long it lasts."""

    processes: list[NodeProcess]
    poses: int | None = None  # or images, in the path that is played to its end
    duration: float | None = None  # s
    player: str = "path_player"  # node that plays them
    loops: bool = False  # it begins again at its end
    topic: str | None = None  # of the body in the path that is played

    @property
    def nodes(self) -> list[str]:
        return [process.node for process in self.processes]

    def with_free_port(self) -> Plan:
        """The same plan, checked before anything is made for it.

        Raises:
            UsSimError: the page's address or port cannot be listened at.
        """
        for process in self.processes:
            if process.node == VIEWER:
                parameters = process.parameters
                require_free(str(parameters["host"]), int(str(parameters["port"])))
        return self


def require_new(recording: Path) -> None:
    """Raise SettingsError where this recording cannot be begun."""
    if recording.suffix != ".mcap":
        raise SettingsError(f"record: {recording}: must be a file that ends in .mcap")
    if recording.exists():
        raise SettingsError(f"record: {recording}: exists already; choose another name")
    if not recording.absolute().parent.is_dir():
        raise SettingsError(f"record: {recording}: there is no such folder; make it first")


def goes_on(running: NodeProcess, wanted: NodeProcess | None) -> bool:
    """Whether a process can stay when another plan wants its node.

    Those that record and play follow most parameters while they run.
    """
    decisive = {RECORDER: ("file",), "path_player": ("path", "topic"), "session_player": ("path",)}
    if wanted is None or running.node not in decisive:
        return running == wanted
    before, after = running.parameters, wanted.parameters
    return all(before.get(name) == after.get(name) for name in decisive[running.node])


def plan_of(request: Request) -> Plan:
    """The processes that run a scene as requested.

    Raises:
        UsSimError: a parameter will not do, or the file to be played cannot be.
    """
    request = _with_path_of_tracker(request)
    scene, parameters = request.scene, dict(request.parameters)

    def taken(node: str) -> dict[str, object]:
        return checked_parameters(node, scene, parameters.pop(node, {}))

    processes = []
    if request.view is not None:  # it goes first: a page can load while tissue is built
        processes.append(viewer_process(request.view, taken(VIEWER)))
    recorder = taken(RECORDER) if request.record is not None or request.is_changed else {}
    player = taken("path_player") if request.path is not None or request.is_changed else {}
    played = "" if request.path is None else str(full_path(request.path))
    settings: dict[str, object]
    if request.path is not None and request.everything:
        running = ["diagnostics", "session/scenes", "session/bags"]
        running += [f"/{name}" for name in running]  # of a session without namespace
        settings = {"path": played, "exclude": running, **request.playing}
        processes.append(NodeProcess("session_player", settings))
        return Plan(processes, duration=request.duration, player="session_player")
    if request.record is not None:
        settings = {"file": str(full_path(request.record)), **scene_settings(scene)}
        if request.path is not None:
            settings["path"] = played
        processes.append(NodeProcess(RECORDER, settings | recorder))
    is_played = request.by_hand or request.path is not None
    processes += simulation_nodes(scene, parameters, played=is_played)
    for process in processes:
        if process.node == RECORDER:
            process.parameters["parameters"] = parameters_file(processes)
    awaited = recorder_of(processes)
    if request.path is None:
        return Plan(processes, duration=request.duration)
    path = path_of(scene, request.path, request.topic or str(player.get("topic") or "") or None)
    settings = player_settings(scene, request.path, awaited, path.topic) | dict(request.playing)
    poses = None if settings.get("stay") else len(path)
    settings |= player
    processes.append(NodeProcess("path_player", settings))
    loops = bool(settings.get("loop"))
    return Plan(processes, poses, request.duration, loops=loops, topic=path.topic)


def _with_path_of_tracker(request: Request) -> Request:
    """The same, which plays the scene's own recording where that is its tracker, and holds its end.

    Raises:
        SceneError: the scene names no recording.
    """
    tracker = request.scene.tracker
    if tracker.source.name != "path" or request.by_hand or request.path:
        return request
    if tracker.file is None:
        raise SceneError(
            f"{request.scene.origin}: tracker.file: is missing; name the bag or recording to play"
        )
    return replace(request, path=Path(tracker.file), playing={"stay": True})


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
            common
            | ({"source": "pose"} if played and part.node == "probe_tracker" else {})
            | checked_parameters(part.node, scene, given.pop(part.node, {})),
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
    return NodeProcess(VIEWER, settings | (given or {}), {TOKEN: _viewer_token()})


@functools.cache
def _viewer_token() -> str:
    """One for as long as this program runs, so that pages find a viewer that was started again."""
    return os.environ.get(TOKEN) or secrets.token_urlsafe(16)


def scene_settings(scene: Scene) -> dict[str, object]:
    """The parameters that tell a node the scene."""
    settings: dict[str, object] = {"scene": scene.origin}
    if scene.volume.file:
        settings["volume"] = scene.volume.file
    return settings


def parameters_file(processes: Sequence[NodeProcess]) -> str:
    """The parameters of nodes as ROS reads them with ``--params-file``."""
    document = {process.node: {"ros__parameters": process.parameters} for process in processes}
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


def _awaited(topics: Sequence[str], recorder: SessionRecorderSettings | None) -> dict[str, object]:
    """Parameters that have a player wait for these topics, and for a recorder to record them."""
    space = namespace()
    recorded = [
        topic
        for topic in topics
        if recorder and recorder.records(posixpath.join(space, topic), space)
    ]
    return {"await_topics": topics, "await_recorded": recorded or [""]}  # [] has no type


def recorder_of(processes: Iterable[NodeProcess]) -> SessionRecorderSettings | None:
    """The settings of the recorder among them."""
    for process in processes:
        if process.node == RECORDER:
            known = rules_of(SessionRecorderSettings).keys() & process.parameters
            values: Any = {name: process.parameters[name] for name in known}
            return SessionRecorderSettings(**values)
    return None
