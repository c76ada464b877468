"""Live runs: the nodes of a scene as separate processes, followed until they are done."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from us_sim.assembly import volume_of
from us_sim.errors import UsSimError
from us_sim.graph import NodeProcess, ProcessGroup, keep_on_this_host, simulation_nodes
from us_sim.progress import Progress
from us_sim.scene import Scene
from us_sim.scene_file import load_scene

if TYPE_CHECKING:
    from us_sim.nodes.session_monitor import SessionMonitor

__all__ = ["demo", "dry_run", "play", "prepare_volume", "run"]

SETTLE_S = 1.3
"""After the path's end: the last images, and each node's last report, which comes every second."""
START_LIMIT_S = 300.0

Parameters = dict[str, dict[str, str]]


@dataclass(frozen=True)
class Plan:
    """What a live run starts."""

    scene: Scene
    processes: list[NodeProcess]
    poses: int | None  # in the path that is played
    duration: float | None  # s

    @property
    def nodes(self) -> list[str]:
        return [process.node for process in self.processes]


def _plan(
    scene: Scene,
    parameters: Parameters,
    *,
    record: Path | None,
    path: Path | None,
    duration: float | None = None,
) -> Plan:
    parameters = dict(parameters)
    processes = []
    if record is not None:
        settings: dict[str, object] = {"file": str(record.expanduser().resolve())}
        processes.append(
            NodeProcess("session_recorder", settings, parameters.pop("session_recorder", {}))
        )
    player = parameters.pop("path_player", {}) if path is not None else {}
    processes += simulation_nodes(scene, parameters)
    poses = None
    if path is not None:
        from us_sim.recording.path import read_path

        topic = player.get("topic")
        poses = len(read_path(path, topic))
        topics = ["tracker/pose", "probe/pose", "ultrasound/image"]
        topics += ["tissue/nodes"] if scene.tissue else []
        topics += ["skin/nodes"] if scene.skin else []
        settings = {
            "path": str(path.expanduser().resolve()),
            "await_topics": topics,
            "await_subscriber": "session_recorder" if record is not None else "",
        }
        processes.append(NodeProcess("path_player", settings, player))
    return Plan(scene, processes, poses, duration)


def dry_run(scene: Scene, parameters: Parameters, *, record: Path | None, path: Path | None) -> str:
    """What :func:`run` would start and what it would leave out, and why, one line each."""
    _plan(scene, parameters, record=record, path=path)
    rows = [
        ("runs" if part.needed else "left out", part.node, part.reason) for part in scene.parts()
    ]
    rows.append(
        ("runs", "path_player", f"plays {path}")
        if path
        else ("left out", "path_player", "no --path: poses come from outside on tracker/pose")
    )
    rows.append(
        ("runs", "session_recorder", f"records to {record}")
        if record
        else ("left out", "session_recorder", "no --record")
    )
    lines = [f"scene {scene.name} ({scene.origin}), volume {scene.volume_name}"]
    lines += [f"{verdict:<9} {node:<19} {reason}" for verdict, node, reason in rows]
    lines.append("on demand wrench, tf, markers: nothing is computed for a topic nobody subscribes")
    return "\n".join(lines)


def run(
    scene: Scene,
    parameters: Parameters,
    *,
    record: Path | None,
    path: Path | None,
    duration: float | None,
    network: bool,
) -> int:
    """Run a scene until its path ends, the duration is over, or Ctrl-C."""
    keep_on_this_host(network=network)
    plan = _plan(scene, parameters, record=record, path=path, duration=duration)
    prepare_volume(scene)
    _follow(plan, log=None)
    return 0


def demo(
    name: str, volume: Path | None, out: Path, parameters: Parameters, *, network: bool
) -> int:
    """Replay the scene's path through its nodes; recording, contact sheet and summary in ``out``.

    Raises:
        UsSimError: bad input, ``out`` already holds a session, or a node failed.
    """
    keep_on_this_host(network=network)
    scene = load_scene(name, volume=volume)
    if scene.path is None:
        raise UsSimError(f"{scene.origin}: path: is missing, and the demo needs one to play")
    recording = out / "session.mcap"
    if recording.exists():
        raise UsSimError(f"{recording} exists already; choose another folder with --out")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsSimError(f"--out {out}: cannot be made: {error.strerror}") from error
    plan = _plan(scene, parameters, record=recording, path=Path(scene.path))
    prepare_volume(scene)
    started = time.monotonic()
    startup = _follow(plan, log=out / "nodes.log")
    return _report(scene, out, recording, startup, time.monotonic() - started)


def play(bag: Path, *, topic: str, rate: float, loop: bool, everything: bool, network: bool) -> int:
    """Play a bag into whatever runs on this ROS domain."""
    from us_sim.recording.path import read_path
    from us_sim.recording.reader import read_bag

    keep_on_this_host(network=network)
    settings: dict[str, object] = {
        "path": str(bag.expanduser().resolve()),
        "rate": rate,
        "loop": loop,
    }
    if everything:
        count = read_bag(bag).message_count
        process = NodeProcess("session_player", settings)
    else:
        count = len(read_path(bag, topic or None))
        process = NodeProcess("path_player", settings | {"topic": topic})
    group = ProcessGroup()
    monitor = _Monitored([process.node])
    try:
        group.start([process])
        with Progress("playing", count, "messages") as bar:
            while group.is_running(process.node):
                monitor.spin()
                report = monitor.node.reports.get(process.node, {})
                done = sum(int(v) for k, v in report.items() if k.startswith("published "))
                bar.update(min(done, count), report.get("state", "waiting"))
            group.check()
            bar.update(count)
    finally:
        group.stop()
        monitor.close()
    return 0


def prepare_volume(scene: Scene) -> None:
    """Make a phantom that is not in the cache yet, in view of the person who waits."""
    bar: list[Progress] = []

    def show(fraction: float, text: str) -> None:
        if not bar:
            bar.append(Progress(f"making {scene.volume_name}", 100, "%"))
        bar[0].update(100 * fraction, text)

    try:
        volume_of(scene, show)
    finally:
        for shown in bar:
            shown.__exit__(None, None, None)


class _Monitored:
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
        rclpy.init(args=[], context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self.node: SessionMonitor = SessionMonitor(context=self._context)
        self._executor: Any = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)

    def spin(self) -> None:
        """Take what has come, for at most a tenth of a second."""
        self._executor.spin_once(timeout_sec=0.1)

    @property
    def waiting(self) -> list[str]:
        """Nodes that have not reported yet."""
        return [name for name in self.names if name not in self.node.reports]

    def close(self) -> None:
        """Leave the domain."""
        self._executor.shutdown()
        self.node.destroy_node()
        self._context.try_shutdown()


def _follow(plan: Plan, log: Path | None) -> float:
    """Start the plan's processes and stay with them; seconds until all were ready."""
    group = ProcessGroup(log)
    monitor = _Monitored(plan.nodes)
    began = time.monotonic()
    try:
        group.start(plan.processes)
        with Progress("starting (the first run compiles)", len(plan.nodes), "nodes") as bar:
            while monitor.waiting:
                monitor.spin()
                group.check()
                waiting = monitor.waiting
                bar.update(len(plan.nodes) - len(waiting), ", ".join(waiting))
                if time.monotonic() - began > START_LIMIT_S:
                    raise UsSimError(f"{', '.join(waiting)} did not start in {START_LIMIT_S:g} s")
        startup = time.monotonic() - began
        _stay(plan, group, monitor)
    finally:
        group.stop()
        monitor.close()
    return startup


def _stay(plan: Plan, group: ProcessGroup, monitor: _Monitored) -> None:
    """Until the path is at its end, the time is up, or a node fails."""
    began = time.monotonic()
    ended: float | None = None
    total = plan.poses if plan.poses is not None else plan.duration
    unit = "poses" if plan.poses is not None else "s"
    with Progress("running", total, unit) as bar:
        while True:
            monitor.spin()
            group.check()
            now = time.monotonic()
            done = monitor.node.count("path_player", "tracker/pose") if plan.poses else now - began
            if plan.poses is not None and ended is None and not group.is_running("path_player"):
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
        return "waiting for poses"
    return (
        f"{count} images, {slicer.get('rate_hz', '?')}/s, "
        f"p99 {slicer.get('latency_p99_ms', '?')} ms"
    )


def _report(scene: Scene, out: Path, recording: Path, startup: float, wall: float) -> int:
    """Summary and contact sheet of what was recorded, and one paragraph for the person."""
    from us_sim.evaluation.contact_sheet import contact_sheet
    from us_sim.evaluation.session import read_session, write_summary

    with Progress("measuring the recording", 100, "%") as bar:
        session = read_session(recording)
        areas = session.lumen_areas(scene, 120, lambda done: bar.update(100 * done))
    summary = session.summary(areas)
    summary |= {"scene": scene.name, "startup_s": round(startup, 2), "wall_s": round(wall, 2)}
    contact_sheet(session, scene, areas, out / "contact_sheet.png")
    write_summary(summary, out / "summary.json")
    latency = summary["latency_ms"]["end_to_end"]
    print(
        f"{summary['poses_in']} poses in, {summary['images_out']} images out, "
        f"{summary['dropped']} dropped, {summary['images_per_second']:.1f} images/s, "
        f"latency p50 {latency['p50']:.1f} ms, p99 {latency['p99']:.1f} ms"
    )
    for vessel in areas.area if areas is not None else ():
        print(
            f"{vessel}: {summary['areas'][f'{vessel}_change_at_full_press']:+.0%} at full press, "
            f"{summary['areas'][f'{vessel}_change_after_release']:+.1%} after release"
        )
    for file in ("session.mcap", "contact_sheet.png", "summary.json", "nodes.log"):
        print(out / file)
    return 0
