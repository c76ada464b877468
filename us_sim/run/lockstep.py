"""Lockstep: all nodes of a scene in one process, one image out for every pose in, repeatably."""

from __future__ import annotations

import csv
import importlib
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from us_sim.errors import UsSimError
from us_sim.nodes.settings import RECORDER
from us_sim.progress import Progress
from us_sim.run.monitored import ros_context
from us_sim.run.plan import (
    NodeProcess,
    Parameters,
    parameters_file,
    player_settings,
    recorder_of,
    require_texts,
    scene_settings,
    simulation_nodes,
)
from us_sim.run.preparation import prepare_scene
from us_sim.run.processes import prepare_ros
from us_sim.scene.building import path_of, volume_of
from us_sim.scene.scene import Scene
from us_sim.settings.spelling import counted
from us_sim.share import full_path


def node_in_process(name: str, parameters: Mapping[str, object], context: Any) -> Any:
    """The node called ``name`` in an initialised context, with parameters by name.

    Raises:
        UsSimError: a parameter is refused, or what the node itself refuses.
    """
    from rclpy.exceptions import ParameterException
    from rclpy.parameter import Parameter

    require_texts(parameters)
    kind = "".join(word.capitalize() for word in name.split("_"))
    node_class: Any = getattr(importlib.import_module(f"us_sim.nodes.{name}"), kind)
    overrides = [Parameter(key, value=value) for key, value in parameters.items()]
    try:
        return node_class(context=context, parameter_overrides=overrides)
    except ParameterException as error:
        raise UsSimError(" ".join(str(error).split())) from error


QUIET_S = 0.25  # silence after which everything that was sent has been taken


def render_scene(
    scene: Scene,
    path: Path | None,
    out: Path,
    parameters: Parameters,
    *,
    topic: str | None = None,
    truth: bool = False,
) -> int:
    """`us-sim render`: with checks of its arguments, and progress.

    Raises:
        UsSimError: no path, an output folder that is not empty, or what :func:`render` raises.
    """
    prepare_ros(network=False)
    path = path or (Path(scene.path) if scene.path else None)
    if path is None:
        raise UsSimError(f"{scene.origin}: path: is missing; give a bag with --path")
    if out.exists() and any(out.iterdir()):
        raise UsSimError(f"--out {out}: is not empty; choose another folder")
    out.mkdir(parents=True, exist_ok=True)
    topic = path_of(scene, path, topic).topic
    prepare_scene(scene, path, topic)
    folders = truth_folders(scene, out) if truth else {}
    with Progress("rendering", len(path_of(scene, path, topic)), "images") as bar:
        count = render(
            scene, path, out, lambda done, _: bar.update(done), parameters, folders, topic=topic
        )
    print(f"{counted(count, 'image')} in {out / 'images'}, all messages in {out / 'session.mcap'}")
    for what, folder in folders.items():
        print(f"the {what} of each in {folder}")
    return 0


def truth_folders(scene: Scene, out: Path) -> dict[str, Path]:
    """Folders in ``out`` for all that can be known of the scene's images.

    Beside the labels goes a table of what their numbers mean, ``labels.csv``.

    Raises:
        UsSimError: nothing is known of them.
    """
    volume = volume_of(scene)
    folders = {}
    if volume.labels is not None:
        folders["labels"] = out / "labels"
        names = {0: "nothing", **volume.label_names}
        with (out / "labels.csv").open("w", encoding="utf-8", newline="") as file:
            csv.writer(file).writerows([("number", "name"), *sorted(names.items())])
    if scene.tissue is not None:
        folders["displacement"] = out / "displacement"
    if not folders:
        raise UsSimError(
            f"--truth: {scene.origin} has neither a volume with labels nor tissue, so there is "
            f"nothing to know of its images"
        )
    return folders


@threadpool_limits.wrap(limits=1, user_api="blas")
def render(
    scene: Scene,
    path: Path,
    out: Path,
    progress: Callable[[int, int], None],
    parameters: Parameters | None = None,
    truth: Mapping[str, Path] | None = None,
    topic: str = "",
) -> int:
    """Run ``scene`` along the path: ``out/images/*.png`` and ``out/session.mcap``.

    BLAS is held to one thread: the sums of several differ in their last bits with their number.

    Args:
        progress: called with the images done and the poses there are.
        parameters: more parameters by node, as YAML texts.
        truth: folders for what is known of each image, as `truth_folders` gives them.
        topic: of the body in the path's file.

    Returns:
        The number of images, equal to the number of poses.

    Raises:
        UsSimError: bad input, or an output that cannot be written.
    """
    from rclpy.executors import SingleThreadedExecutor

    context = ros_context(None if "ROS_DOMAIN_ID" in os.environ else 1 + os.getpid() % 100)
    executor = SingleThreadedExecutor(context=context)
    nodes: list[Any] = []
    try:
        for process in _processes(scene, path, topic, out, parameters or {}, truth or {}):
            nodes.append(node_in_process(process.node, process.parameters, context))
            executor.add_node(nodes[-1])
        return _spin(executor, nodes, progress, [*(truth or {})])
    finally:
        for node in reversed(nodes):
            executor.remove_node(node)
            node.destroy_node()
        executor.shutdown()
        context.try_shutdown()


def _processes(
    scene: Scene,
    path: Path,
    topic: str,
    out: Path,
    parameters: Parameters,
    truth: Mapping[str, Path],
) -> list[NodeProcess]:
    """The nodes and their parameters: listeners first, the player last."""
    nodes = simulation_nodes(scene, parameters, played=True)
    folders = {"folder": out / "images", **truth}
    recorder: dict[str, object] = {
        "file": str(out / "session.mcap"),
        "compression": "zstd",
        "exclude": ["diagnostics"],
        "max_cache_size": 0,  # lose nothing, wait for the disk
        **scene_settings(scene),
        "path": str(full_path(path)),
        "parameters": parameters_file(nodes),
    }
    recording = NodeProcess(RECORDER, recorder)
    player = player_settings(scene, path, recorder_of([recording]), topic)
    return [
        recording,
        NodeProcess("image_writer", {what: str(folder) for what, folder in folders.items()}),
        *(replace(node, parameters={"lockstep": True, **node.parameters}) for node in nodes),
        NodeProcess("path_player", player | {"lockstep": True}),
    ]


def _spin(
    executor: Any, nodes: list[Any], progress: Callable[[int, int], None], truth: list[str]
) -> int:
    recorder, writer, player = nodes[0], nodes[1], nodes[-1]
    clock = player.get_clock()
    total = player.pose_count
    changed, last = clock.now().nanoseconds, (-1, -1)
    while True:
        executor.spin_once(timeout_sec=0.05)
        failure = next(filter(None, (getattr(node, "last_failure", "") for node in nodes)), "")
        if failure:  # the node itself would go on
            raise UsSimError(failure)
        images, files = writer.counts["ultrasound/image"], writer.counts.total()
        state = (images, recorder.health.received + files)
        now = clock.now().nanoseconds
        if state != last:
            if state[0] != last[0]:
                progress(state[0], total)
            changed, last = now, state
        silence = (now - changed) * 1e-9
        is_complete = files == (1 + len(truth)) * images
        if player.finished.done() and silence > QUIET_S and is_complete:
            return int(images)
        if silence > 60.0:
            what = "image" if is_complete else f"{' or '.join(truth)} of each image"
            raise UsSimError(
                f"no {what} came for pose {images} in a minute; the path is rendered up to it"
            )
