"""A plan of node processes, started, followed by what they report, and ended together."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from us_sim.errors import UsSimError
from us_sim.nodes.settings import checked_parameters
from us_sim.progress import Progress
from us_sim.run.graph import (
    NodeProcess,
    Parameters,
    ProcessGroup,
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
    from us_sim.nodes.session_monitor import SessionMonitor

__all__ = ["Monitored", "Plan", "follow", "plan_of", "refuse_unknown"]

SETTLE_S = 1.2
"""After the path's end: the last images, and each node's last report, which comes every second."""
START_LIMIT_S = 300.0
LOOK_AROUND_S = 0.4
"""To discover whether another simulation is on this ROS domain."""
ANSWER_S = 5.0
"""For a node to say which parameters it has."""


@dataclass(frozen=True)
class Plan:
    """What a live run starts."""

    scene: Scene
    processes: list[NodeProcess]
    poses: int | None  # or images, in the path or video that is played
    duration: float | None  # s
    player: str = "path_player"  # node that plays them
    played: str = "tracker/pose"  # topic

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
        processes.append(NodeProcess("session_recorder", settings, taken("session_recorder")))
    player = taken("path_player") if path is not None else {}
    driver = taken("camera_driver") if video is not None else {}
    processes += simulation_nodes(scene, parameters, played=path is not None)
    for recorder in processes[: record is not None]:
        recorder.parameters["parameters"] = parameters_file(processes)
    if video is not None:
        settings = video_settings(scene, video.file, video.camera_info, recorded=record is not None)
        processes.append(NodeProcess("camera_driver", settings, driver))
        count = len(video.poses)
        return Plan(scene, processes, count, duration, "camera_driver", "camera/image_raw")
    poses = None
    if path is not None:
        poses = len(path_of(scene, path, str(player.get("topic") or "") or None))
        settings = player_settings(scene, path, recorded=record is not None)
        processes.append(NodeProcess("path_player", settings, player))
    return Plan(scene, processes, poses, duration)


class Monitored:
    """A monitor node in this process, with its own context and executor."""

    def __init__(self, nodes: list[str]) -> None:
        import us_sim.nodes  # noqa: F401, I001 - provides rclpy where ROS 2 is not installed
        import rclpy
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.signals import SignalHandlerOptions

        from us_sim.nodes.session_monitor import SessionMonitor

        self.names = nodes
        self._context = Context()
        try:
            rclpy.init(
                args=[], context=self._context, signal_handler_options=SignalHandlerOptions.NO
            )
        except Exception as error:  # what rcl raises differs between its versions
            raise UsSimError(f"ROS cannot be used: {' '.join(str(error).split())}") from error
        self.node: SessionMonitor = SessionMonitor(context=self._context)
        self._executor: Any = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)

    def spin(self) -> None:
        """Take what has come, for at most a tenth of a second."""
        self._executor.spin_once(timeout_sec=0.1)

    def refuse_company(self) -> None:
        """Raise UsSimError when a node of one of these names is on the domain already."""
        until = time.monotonic() + LOOK_AROUND_S
        while time.monotonic() < until:
            self.spin()
        taken = sorted(set(self.names) & set(self.node.get_node_names()))
        if taken:
            raise UsSimError(
                f"{taken[0]} runs already on ROS domain {os.environ.get('ROS_DOMAIN_ID', '0')}: "
                f"end that simulation, or set ROS_DOMAIN_ID to another number for this one"
            )

    @property
    def waiting(self) -> list[str]:
        """Nodes that have not reported yet."""
        return [name for name in self.names if name not in self.node.reports]

    def refuse_unknown(self, processes: Sequence[NodeProcess]) -> None:
        """Raise UsSimError when a parameter was given that its node does not have."""
        from rclpy.parameter_client import AsyncParameterClient

        for process in processes:
            if not process.given:
                continue
            client = AsyncParameterClient(self.node, process.node)
            client.wait_for_services(timeout_sec=ANSWER_S)
            answer = client.list_parameters()
            self._executor.spin_until_future_complete(answer, timeout_sec=ANSWER_S)
            if answer.done():
                refuse_unknown(process, answer.result().result.names)

    def close(self) -> None:
        """Leave the domain."""
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()


def refuse_unknown(process: NodeProcess, known: Collection[str]) -> None:
    """Raise UsSimError when a parameter was given by a name that is not among the ``known``."""
    for name in process.given:
        if name not in known and not name.startswith("qos_overrides."):
            own = sorted(n for n in known if not n.startswith("qos_overrides."))
            raise UsSimError(
                f"--param {process.node}.{name}: {process.node} has no such parameter; it has "
                f"{', '.join(own)}"
            )


def follow(plan: Plan, log: Path | None) -> float:
    """Start the plan's processes and stay with them; seconds until all were ready.

    Raises:
        UsSimError: a node fails or does not start, or another simulation runs on this domain.
    """
    group = ProcessGroup(log)
    try:
        # The monitor goes first: it would wait for what a killed node never acknowledges.
        with contextlib.closing(Monitored(plan.nodes)) as monitor:
            monitor.refuse_company()
            began = time.monotonic()
            group.start(plan.processes)
            _await_all(group, monitor, began)
            monitor.refuse_unknown(plan.processes)
            startup = time.monotonic() - began
            _stay(plan, group, monitor)
    finally:
        group.stop()
    return startup


def _await_all(group: ProcessGroup, monitor: Monitored, began: float) -> None:
    """Until every node has reported."""
    with Progress("starting (the first run compiles)", len(monitor.names), "nodes") as bar:
        while monitor.waiting:
            monitor.spin()
            group.check()
            waiting = monitor.waiting
            more = f" and {len(waiting) - 2} more" if len(waiting) > 2 else ""
            bar.update(len(monitor.names) - len(waiting), ", ".join(waiting[:2]) + more)
            if time.monotonic() - began > START_LIMIT_S:
                raise UsSimError(f"{', '.join(waiting)} did not start in {START_LIMIT_S:g} s")


def _stay(plan: Plan, group: ProcessGroup, monitor: Monitored) -> None:
    """Until the path is at its end, the time is up, or a node fails."""
    began = time.monotonic()
    ended: float | None = None
    total = plan.poses if plan.poses is not None else plan.duration
    unit = "s"
    if plan.poses is not None:
        unit = "poses" if plan.player == "path_player" else "images"
    with Progress("running", total, unit) as bar:
        while True:
            monitor.spin()
            group.check()
            if "rejected disk" in monitor.node.reports.get("session_recorder", {}):
                raise UsSimError(monitor.node.messages["session_recorder"])
            now = time.monotonic()
            done = monitor.node.count(plan.player, plan.played) if plan.poses else now - began
            if plan.poses is not None and ended is None and not group.is_running(plan.player):
                ended = now
            if ended is not None:
                done = total or done
            bar.update(min(done, total or done), _status(monitor.node))
            if plan.duration is not None and now - began > plan.duration:
                return
            if ended is not None and now - ended > SETTLE_S:
                return


def _status(monitor: SessionMonitor) -> str:
    """The images so far, their rate and their age, in words."""
    slicer = monitor.reports.get("slice_interpolator", {})
    count = slicer.get("published ultrasound/image")
    if count is None:
        heard = int(slicer.get("received", 0))
        return "nobody subscribes to ultrasound/image" if heard else "waiting for poses"
    return (
        f"{count} images, {slicer.get('rate_hz', '?')}/s, "
        f"p99 {slicer.get('latency_p99_ms', '?')} ms"
    )
