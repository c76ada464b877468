"""What a live run starts: the processes of a scene, and what is played to them."""

from __future__ import annotations

from dataclasses import dataclass, replace

from us_sim.nodes.settings import checked_parameters
from us_sim.run.graph import (
    RECORDER,
    VIEWER,
    NodeProcess,
    parameters_file,
    player_settings,
    recorder_of,
    scene_settings,
    simulation_nodes,
    video_settings,
    viewer_process,
)
from us_sim.run.request import Request
from us_sim.scene.building import path_of
from us_sim.share import full_path
from us_sim.viewer.server import require_free

PLAYERS = ("path_player", "session_player")
_WHAT_COUNTS = {
    RECORDER: ("file",),
    "path_player": ("path", "topic"),
    "session_player": ("path",),
}
"""Parameters of which a change takes another process; of other nodes it is every parameter."""
_NOT_PLAYED = ("/diagnostics", "/session/scenes", "/session/thumbnails", "/session/bags")
"""Topics of a recording on which those publish that are there while it is played."""


@dataclass(frozen=True)
class Plan:
    """What a live run starts."""

    processes: list[NodeProcess]
    poses: int | None = None  # or images, in the path or video that is played to its end
    duration: float | None = None  # s
    player: str = "path_player"  # node that plays them
    loops: bool = False  # it begins again at its end
    topic: str | None = None  # of the body in the path that is played

    @property
    def nodes(self) -> list[str]:
        return [process.node for process in self.processes]

    def with_free_port(self) -> Plan:
        """The same plan, whose page can be served: seen before anything is made for it.

        Raises:
            UsSimError: the page's address or port cannot be listened at.
        """
        for process in self.processes:
            if process.node == VIEWER:
                parameters = process.all_parameters
                require_free(str(parameters["host"]), int(str(parameters["port"])))
        return self


def goes_on(running: NodeProcess, wanted: NodeProcess | None) -> bool:
    """Whether a process that runs can stay when another plan wants its node."""
    if wanted is None or running.node not in _WHAT_COUNTS:
        return running == wanted
    before, after = running.all_parameters, wanted.all_parameters
    return all(before.get(name) == after.get(name) for name in _WHAT_COUNTS[running.node])


def plan_of(request: Request) -> Plan:
    """What is started to run a scene.

    Raises:
        UsSimError: a parameter will not do, or what is to be played cannot be.
    """
    scene, parameters = request.scene, dict(request.parameters)

    def taken(node: str) -> dict[str, object]:
        return checked_parameters(node, scene, parameters.pop(node, {}))

    processes = []
    if request.view is not None:  # it goes first: a page can load while tissue is built
        processes.append(viewer_process(request.view, taken(VIEWER)))
    recorder = taken(RECORDER) if request.record is not None or request.is_changed else {}
    player = taken("path_player") if request.path is not None or request.is_changed else {}
    if request.path is not None and request.everything:
        settings: dict[str, object] = {"path": _absolute(request), "exclude": list(_NOT_PLAYED)}
        processes.append(NodeProcess("session_player", settings | dict(request.playing)))
        return Plan(processes, duration=request.duration, player="session_player")
    if request.record is not None:
        settings = {"file": str(full_path(request.record))}
        settings |= scene_settings(scene)
        if request.path is not None:
            settings["path"] = _absolute(request)
        if request.video is not None:
            settings["exclude"] = ["/camera/image_raw"]  # the video is there already
        processes.append(NodeProcess(RECORDER, settings, recorder))
    driver = taken("camera_driver") if request.video is not None else {}
    played = request.by_hand or request.path is not None
    processes += [
        replace(process, kept=dict(request.kept.get(process.node, {})))
        for process in simulation_nodes(scene, parameters, played=played)
    ]
    for process in processes:
        if process.node == RECORDER:
            process.parameters["parameters"] = parameters_file(processes)
    awaited = recorder_of(processes)
    if request.video is not None:
        video = request.video
        settings = video_settings(scene, video.file, video.camera_info, awaited)
        processes.append(NodeProcess("camera_driver", settings, driver))
        loops = bool(driver.get("loop"))
        return Plan(processes, len(video.poses), request.duration, "camera_driver", loops)
    if request.path is None:
        return Plan(processes, duration=request.duration)
    path = path_of(scene, request.path, request.topic or str(player.get("topic") or "") or None)
    settings = player_settings(scene, request.path, awaited, path.topic) | dict(request.playing)
    processes.append(NodeProcess("path_player", settings, player))
    ends = not settings.get("stay")
    loops = bool(processes[-1].all_parameters.get("loop"))
    return Plan(
        processes, len(path) if ends else None, request.duration, loops=loops, topic=path.topic
    )


def _absolute(request: Request) -> str:
    return str(full_path(request.path)) if request.path is not None else ""
