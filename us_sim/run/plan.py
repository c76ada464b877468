"""What a live run starts: the processes of a scene, and what is played to them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from us_sim.nodes.settings import checked_parameters
from us_sim.run.graph import (
    RECORDER,
    NodeProcess,
    Parameters,
    parameters_file,
    player_settings,
    scene_settings,
    simulation_nodes,
    video_settings,
)
from us_sim.scene.building import path_of
from us_sim.scene.scene import Scene

if TYPE_CHECKING:
    from us_sim.demo.camera_video import PathVideo

__all__ = ["Plan", "plan_of"]


@dataclass(frozen=True)
class Plan:
    """What a live run starts."""

    scene: Scene
    processes: list[NodeProcess]
    poses: int | None  # or images, in the path or video that is played
    duration: float | None  # s
    player: str = "path_player"  # node that plays them
    loops: bool = False  # it begins again at its end

    @property
    def nodes(self) -> list[str]:
        return [process.node for process in self.processes]


def plan_of(
    scene: Scene,
    parameters: Parameters,
    *,
    record: Path | None,
    path: Path | None,
    duration: float | None = None,
    video: PathVideo | None = None,
) -> Plan:
    """What is started to run a scene.

    Args:
        scene: what is run.
        parameters: given by a person, by node.
        record: MCAP file to record to.
        path: bag to play to the tracker.
        duration: s, after which all ends.
        video: to show the scene's camera in place of a path.
    """
    parameters = dict(parameters)

    def taken(node: str) -> dict[str, object]:
        return checked_parameters(node, scene, parameters.pop(node, {}))

    processes = []
    if record is not None:
        settings: dict[str, object] = {"file": str(record.expanduser().resolve())}
        settings |= scene_settings(scene)
        if video is not None:
            settings["exclude"] = ["/camera/image_raw"]  # the video is there already
        processes.append(NodeProcess(RECORDER, settings, taken(RECORDER)))
    player = taken("path_player") if path is not None else {}
    driver = taken("camera_driver") if video is not None else {}
    processes += simulation_nodes(scene, parameters, played=path is not None)
    for recorder in processes[: record is not None]:
        recorder.parameters["parameters"] = parameters_file(processes)
    if video is not None:
        settings = video_settings(scene, video.file, video.camera_info, recorded=record is not None)
        processes.append(NodeProcess("camera_driver", settings, driver))
        count = len(video.poses)
        loops = bool(driver.get("loop"))
        return Plan(scene, processes, count, duration, "camera_driver", loops)
    poses = None
    if path is not None:
        poses = len(path_of(scene, path, str(player.get("topic") or "") or None))
        settings = player_settings(scene, path, recorded=record is not None)
        processes.append(NodeProcess("path_player", settings, player))
    return Plan(scene, processes, poses, duration, loops=bool(player.get("loop")))
