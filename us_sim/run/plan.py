"""The processes of a run: the nodes of a scene with their parameters, a recorder, a player, a page.

A `RunRequest` says what a person wants; `make_plan` makes a `Plan` of processes from it.
"""

from __future__ import annotations

import json
import os
import posixpath
import secrets
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml

from us_sim.errors import SceneError, SettingsError, UsSimError
from us_sim.nodes.settings import RECORDER, VIEWER, SessionRecorderSettings, check_parameters
from us_sim.progress import late_progress
from us_sim.run.domain import get_namespace, get_ros_arguments, name_enclave
from us_sim.scene.building import load_path, load_volume
from us_sim.scene.reading import check_structure_names
from us_sim.scene.scene import Scene
from us_sim.settings.setting import rules_of
from us_sim.settings.viewer import TOKEN, ViewerSettings
from us_sim.share import full_path
from us_sim.viewer.server import require_free_address

Parameters = dict[str, dict[str, str]]  # parameters given by a person: YAML texts by node and name


@dataclass(frozen=True)
class NodeProcess:
    """One node and its parameters."""

    node: str
    parameters: dict[str, object] = field(default_factory=dict)  # JSON-like values by name
    secrets: dict[str, str] = field(default_factory=dict, repr=False)  # in its environment alone

    @property
    def module(self) -> str:
        """Name the module that runs it."""
        return "us_sim.viewer.viewer" if self.node == VIEWER else f"us_sim.nodes.{self.node}"

    def arguments(self) -> list[str]:
        """List its ROS arguments: its enclave, those that all nodes get, and its parameters."""
        arguments = ["--ros-args", "--enclave", name_enclave(self.node), *get_ros_arguments()]
        for name, value in self.parameters.items():
            arguments += ["-p", f"{name}:={json.dumps(value)}"]
        return arguments


@dataclass(frozen=True)
class RunRequest:
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
    student: str = ""  # name that results of exercises bear
    results: str | None = None  # folder, or address of fsspec, that they are written to
    is_changed: bool = False  # while it ran: parameters may be of nodes that do not run now

    def with_path(self) -> RunRequest:
        """Return the same with the scene's own path, where no other is to be played.

        Raises:
            SceneError: it has none.
        """
        if self.path is not None:
            return self
        if self.scene.path is None:
            raise SceneError(f"{self.scene.origin}: path: is missing; name a bag with --path")
        return replace(self, path=Path(self.scene.path))

    def with_tracker_file(self) -> RunRequest:
        """Return the same with the recording that is the scene's tracker, its end held.

        Raises:
            SceneError: the scene does not name it.
        """
        tracker = self.scene.tracker
        if tracker.source.name != "path" or self.by_hand or self.path is not None:
            return self
        if tracker.file is None:
            raise SceneError(
                f"{self.scene.origin}: tracker.file: is missing; name the bag or recording to play"
            )
        return replace(self, path=Path(tracker.file), playing={"stay": True})

    def with_scene(self, scene: Scene) -> RunRequest:
        """Return a request of another scene, in which nothing is recorded or played yet.

        Parameters of the scene's nodes were given for the scene before.
        """
        of_any_scene = (VIEWER, RECORDER, "path_player")
        kept = {node: given for node, given in self.parameters.items() if node in of_any_scene}
        return replace(self.without_replay(), scene=scene, parameters=kept, record=None)

    def without_replay(self) -> RunRequest:
        """Return the same with nothing played; after a whole recording its seed is no secret."""
        scene = replace(self.scene, is_drawn=False) if self.everything else self.scene
        same = replace(self, scene=scene, path=None, topic=None, playing={})
        return replace(same, everything=False, is_changed=True)


@dataclass(frozen=True)
class Plan:
    """The processes of a live run, and how long it lasts."""

    processes: list[NodeProcess]
    poses: int | None = None  # or images, in the path that is played to its end
    duration: float | None = None  # s
    player: str = "path_player"  # node that plays them
    topic: str | None = None  # of the body in the path that is played

    @property
    def nodes(self) -> list[str]:
        """The names of its nodes, in the order in which they start."""
        return [process.node for process in self.processes]


def require_free_port(plan: Plan) -> None:
    """Raise UsSimError where the page's address or port cannot be listened at."""
    for process in plan.processes:
        if process.node == VIEWER:
            page = process.parameters
            require_free_address(str(page["host"]), int(str(page["port"])))


def require_new(recording: Path) -> None:
    """Raise SettingsError where this recording cannot be begun."""
    if recording.suffix != ".mcap":
        raise SettingsError(f"record: {recording}: must be a file that ends in .mcap")
    if recording.exists():
        raise SettingsError(f"record: {recording}: exists already; choose another name")
    if not recording.absolute().parent.is_dir():
        raise SettingsError(f"record: {recording}: there is no such folder; make it first")


def can_continue(running: NodeProcess, wanted: NodeProcess | None) -> bool:
    """Tell whether a process can stay when another plan wants its node.

    Those that record and play follow most parameters while they run.
    """
    decisive = {RECORDER: ("file",), "path_player": ("path", "topic"), "session_player": ("path",)}
    if wanted is None or running.node not in decisive:
        return running == wanted
    before, after = running.parameters, wanted.parameters
    return all(before.get(name) == after.get(name) for name in decisive[running.node])


def make_plan(request: RunRequest) -> Plan:
    """Plan the processes that run a scene as requested.

    The scene's own recording is played, and its end held, where that is its tracker.

    Raises:
        UsSimError: a parameter will not do, or the file to be played cannot be, or is not named.
    """
    request = request.with_tracker_file()
    scene, given = request.scene, dict(request.parameters)
    played = "" if request.path is None else str(full_path(request.path))

    def pop_parameters(node: str) -> dict[str, object]:
        return check_parameters(node, scene, given.pop(node, {}))

    processes = []
    if request.view is not None:  # it goes first: a page can load while tissue is built
        processes.append(plan_viewer(request.view, pop_parameters(VIEWER)))
    recorder = pop_parameters(RECORDER) if request.record is not None or request.is_changed else {}
    player = pop_parameters("path_player") if played or request.is_changed else {}
    if played and request.everything:
        running = ["diagnostics", "session/scenes", "session/bags"]
        running += [f"/{name}" for name in running]  # of a session without namespace
        exclude = {"path": played, "exclude": running, **request.playing}
        processes.append(NodeProcess("session_player", exclude))
        return Plan(processes, duration=request.duration, player="session_player")
    volume = {"volume": scene.volume.file} if scene.volume.file else {}
    common: dict[str, object] = {"scene": scene.origin, **volume}
    if request.record is not None:
        source = {"path": played} if played else {}
        recorder = {"file": str(full_path(request.record)), **common, **source, **recorder}
        processes.append(NodeProcess(RECORDER, recorder))
    needed = [part.node for part in scene.list_parts() if part.needed]
    own: dict[str, dict[str, object]] = {node: {} for node in needed}
    if played or request.by_hand:
        own["probe_tracker"] = {"source": "pose"}
    own["scorer"] = _make_chosen(scene, given)
    if request.results:
        own["scorer"] |= {"student": request.student, "results": request.results}
    processes += [NodeProcess(node, common | own[node] | pop_parameters(node)) for node in needed]
    if given:
        raise UsSimError(
            f"--param {next(iter(given))}: this scene does not run such a node; it runs "
            f"{', '.join(needed)}"
        )
    if request.record is not None:
        document = {each.node: {"ros__parameters": each.parameters} for each in processes}
        recorder["parameters"] = yaml.safe_dump(document, sort_keys=False)
    if request.path is None:
        return Plan(processes, duration=request.duration)
    path = load_path(scene, request.path, request.topic or str(player.get("topic") or "") or None)
    settings = {"path": played, "topic": path.topic, **_await_scene(scene, processes)}
    settings |= request.playing
    poses = None if settings.get("stay") else len(path)
    processes.append(NodeProcess("path_player", settings | player))
    return Plan(processes, poses, request.duration, topic=path.topic)


def _make_chosen(scene: Scene, given: Parameters) -> dict[str, object]:
    """Return the scorer's parameter of what a person has set in place of the scene's, if any."""
    texts = [(f"{node}.{name}", text) for node in given for name, text in given[node].items()]
    if scene.origin.endswith(f"#{scene.volume.seed}") and not scene.is_drawn:
        texts.append(("scene.seed", str(scene.volume.seed)))
    chosen = [f"{name} = {text}" for name, text in texts if not name.startswith("scorer.")]
    return {"chosen": chosen} if chosen else {}  # [] has no type


def _await_scene(scene: Scene, processes: Iterable[NodeProcess]) -> dict[str, object]:
    """Return the topics without which a path is not played, and those the recorder must hear."""
    topics, space = ["tracker/pose", *scene.ready_topics], get_namespace()
    recording = find_recorder(processes)
    recorded = [
        each
        for each in topics
        if recording and recording.records_topic(posixpath.join(space, each), space)
    ]
    return {"await_topics": topics, "await_recorded": recorded or [""]}  # [] has no type


def plan_viewer(view: ViewerSettings, given: dict[str, object] | None = None) -> NodeProcess:
    """Return what shows the simulation in browsers, at an address that it says itself."""
    settings: dict[str, object] = {"host": view.host, "port": view.port}
    if view.recordings:
        settings["recordings"] = view.recordings
    token = os.environ.get(TOKEN) or _TOKEN
    return NodeProcess(VIEWER, settings | (given or {}), {TOKEN: token})


_TOKEN = secrets.token_urlsafe(16)
"""One for as long as this program runs, so that pages find a viewer that was started again."""


def find_recorder(processes: Iterable[NodeProcess]) -> SessionRecorderSettings | None:
    """Return the settings of the recorder among processes."""
    for process in processes:
        if process.node == RECORDER:
            known = rules_of(SessionRecorderSettings).keys() & process.parameters
            values: Any = {name: process.parameters[name] for name in known}
            return SessionRecorderSettings(**values)
    return None


def prepare_scene(scene: Scene, path: Path | None = None, topic: str | None = None) -> None:
    """Make a phantom that is not in the cache yet, in view of the person who waits.

    The tissue of a case is made too, and kept there. Of a phantom that is there nothing is
    read, unless a path, or the body of a topic in it, is to be played: its nodes do that, and
    notice damage.

    Raises:
        UsSimError: the volume cannot be read, lacks what the scene names, or no image along the
            path shows any of it.
    """
    check_structure_names(scene)
    phantom = scene.volume.phantom
    if path is None and phantom is not None:
        from us_sim.volume.phantom.phantom import is_phantom_cached

        if is_phantom_cached(phantom, scene.volume.seed, scene.volume.voxel_size):
            return
    volume = load_volume(scene, late_progress(f"making {scene.volume.name}"))
    if path is not None:
        from us_sim.scene.placement import check_path_in_volume

        check_path_in_volume(scene, path, volume, topic)
    if scene.volume.case is not None:
        from us_sim.scene.case_tissue import cache_tissue

        cache_tissue(scene, volume)
