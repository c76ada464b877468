"""Lockstep: all nodes of a scene in one process, one image out for every pose in, repeatably."""

from __future__ import annotations

import csv
import importlib
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from us_sim.errors import UsSimError
from us_sim.progress import ProgressBar
from us_sim.run.domain import make_ros_context
from us_sim.run.plan import NodeProcess, RunRequest, make_plan, prepare_scene
from us_sim.run.processes import prepare_ros
from us_sim.scene.building import load_volume
from us_sim.scene.scene import Scene
from us_sim.settings.spelling import format_count

QUIET_S = 0.25  # silence after which everything that was sent has been taken
_RECORDED: dict[str, object] = {
    "compression": "zstd",
    "exclude": ["diagnostics"],
    "max_cache_size": 0,  # lose nothing, wait for the disk
}


def render_scene(request: RunRequest, out: Path, *, truth: bool = False) -> int:
    """Run a scene along its path: ``out/images/*.png`` and ``out/session.mcap``.

    With ``truth`` what is known of each image is written beside it, too.

    Raises:
        UsSimError: bad input, or ``out`` is not empty or cannot be written.
    """
    prepare_ros(network=False)
    request = replace(request.with_path(), record=out / "session.mcap")
    if out.exists() and any(out.iterdir()):
        raise UsSimError(f"--out {out}: is not empty; choose another folder")
    out.mkdir(parents=True, exist_ok=True)
    plan = make_plan(request)
    prepare_scene(request.scene, request.path, plan.topic)
    folders = _make_truth_folders(request.scene, out) if truth else {}
    recorder, *nodes = plan.processes
    written = {"folder": out / "images", **folders}
    processes = [  # listeners first, the player last
        replace(recorder, parameters=_RECORDED | recorder.parameters),
        NodeProcess("image_writer", {what: str(folder) for what, folder in written.items()}),
        *(replace(node, parameters={"lockstep": True} | node.parameters) for node in nodes),
    ]
    with ProgressBar("rendering", plan.poses, "images") as bar:
        count = _run(processes, bar.update, [*folders])
    print(f"{format_count(count, 'image')} in {out / 'images'}, all messages in {request.record}")
    for what, folder in folders.items():
        print(f"the {what} of each in {folder}")
    return 0


def _make_truth_folders(scene: Scene, out: Path) -> dict[str, Path]:
    """Return folders in ``out`` for all that can be known of the scene's images, or refuse.

    Beside the labels goes a table of what their numbers mean, ``labels.csv``.
    """
    volume = load_volume(scene)
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
def _run(processes: list[NodeProcess], progress: Callable[[int], None], truth: list[str]) -> int:
    """Run nodes in this process until all poses are played; return the number of images.

    BLAS is held to one thread: the sums of several differ in their last bits with their number.
    """
    from rclpy.executors import SingleThreadedExecutor

    context = make_ros_context(None if "ROS_DOMAIN_ID" in os.environ else 1 + os.getpid() % 100)
    executor = SingleThreadedExecutor(context=context)
    nodes: list[Any] = []
    try:
        for process in processes:
            nodes.append(_make_node(process, context))
            executor.add_node(nodes[-1])
        return _spin(executor, nodes, progress, truth)
    finally:
        for node in reversed(nodes):
            executor.remove_node(node)
            node.destroy_node()
        executor.shutdown()
        context.try_shutdown()


def _make_node(process: NodeProcess, context: Any) -> Any:
    """Make a node in this process; say why it refuses a parameter."""
    from rclpy.exceptions import ParameterException
    from rclpy.parameter import Parameter

    kind = "".join(word.capitalize() for word in process.node.split("_"))
    node_class: Any = getattr(importlib.import_module(f"us_sim.nodes.{process.node}"), kind)
    overrides = [Parameter(key, value=value) for key, value in process.parameters.items()]
    try:
        return node_class(context=context, parameter_overrides=overrides)
    except ParameterException as error:
        raise UsSimError(" ".join(str(error).split())) from error


def _spin(
    executor: Any, nodes: list[Any], progress: Callable[[int], None], truth: list[str]
) -> int:
    recorder, writer, player = nodes[0], nodes[1], nodes[-1]
    clock = player.get_clock()
    changed, last = clock.now().nanoseconds, (-1, -1)
    while True:
        executor.spin_once(timeout_sec=0.05)
        for node in nodes:
            if failure := getattr(node, "last_failure", ""):  # the node itself would go on
                raise UsSimError(failure)
        images, files = writer.counts["ultrasound/image"], writer.counts.total()
        state, now = (images, recorder.health.received + files), clock.now().nanoseconds
        if state != last:
            progress(images)
            changed, last = now, state
        silence = (now - changed) * 1e-9
        is_complete = files == (1 + len(truth)) * images
        if player.finished.done() and silence > QUIET_S and is_complete:
            return int(images)
        if silence > 60.0:
            raise UsSimError(
                f"pose {images} was not answered in full in a minute; the path is rendered up to it"
            )
