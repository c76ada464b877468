"""Live runs: the nodes of a scene as separate processes, followed until they are done."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from us_sim.errors import UsSimError
from us_sim.nodes.settings import RECORDER, VIEWER, PlayerSettings, check_parameters
from us_sim.progress import ProgressBar
from us_sim.run.domain import get_domain, get_ros_arguments, lock_domain
from us_sim.run.plan import (
    NodeProcess,
    Parameters,
    Plan,
    RunRequest,
    make_plan,
    plan_viewer,
    prepare_scene,
    require_free_port,
    require_new,
)
from us_sim.run.simulation import Simulation
from us_sim.run.supervision import (
    IMAGER,
    IMAGES,
    Outcome,
    SupervisionSettings,
    Supervisor,
    print_above_bar,
)
from us_sim.scene.scene import Scene
from us_sim.settings.viewer import ViewerSettings
from us_sim.share import full_path
from us_sim.viewer.access import is_loopback

if TYPE_CHECKING:
    from us_sim.nodes.session_monitor import SessionMonitor

SETTLE_S = 1.2  # after the path's end: for the last images and each node's last report
_LONG_START_S = 15.0  # longer than a start takes that compiles nothing


def follow_plan(
    plan: Plan,
    log: Path | None,
    settings: SupervisionSettings,
    request: RunRequest | None = None,
) -> Outcome:
    """Start the plan's processes and stay with them until they are done; return how it went.

    The ``request`` that the plan was made for may change while it runs. Without one what runs is no
    simulation, of which there is one on a domain.

    Raises:
        UsSimError: a node cannot start, or another simulation runs on this domain.
    """
    with contextlib.nullcontext() if request is None else lock_domain():
        supervisor = Supervisor(settings, log)
        try:
            supervisor.start_plan(plan)
            update = supervisor.update
            if request is not None:
                update = Simulation(request, supervisor).update
            _await_all(update, supervisor)
            _stay(update, supervisor)
        except KeyboardInterrupt:
            supervisor.end_plan()
            if supervisor.plan.processes and (lost := supervisor.make_outcome().describe_losses()):
                print_above_bar(lost)
            raise
        finally:
            supervisor.end_plan()
        return supervisor.make_outcome()


def _await_all(update: Callable[[], None], supervisor: Supervisor) -> None:
    count, began = len(supervisor.plan.nodes), time.monotonic()
    with ProgressBar("starting", count, "nodes") as bar:
        while waiting := supervisor.waiting:
            update()
            more = f" and {len(waiting) - 2} more" if len(waiting) > 2 else ""
            is_long = time.monotonic() - began > _LONG_START_S
            why = "a first run compiles for minutes: " if is_long else ""  # what is behind is cut
            bar.update(count - len(waiting), why + ", ".join(waiting[:2]) + more)


def _stay(update: Callable[[], None], supervisor: Supervisor) -> None:
    began, duration = time.monotonic(), supervisor.plan.duration
    ended: float | None = None
    with ProgressBar("running", duration, "s") as bar:
        while True:
            update()
            now = time.monotonic()
            ended = ended or now if supervisor.finished else None
            bar.update(now - began, _status(supervisor.plan, supervisor.monitor))
            is_over = duration is not None and now - began > duration
            if is_over or (ended is not None and now - ended > SETTLE_S):
                return


def _status(plan: Plan, monitor: SessionMonitor) -> str:
    """Return how far what plays is, which images there are, and where the page is."""
    player, slicer, viewer = (monitor.reports.get(n, {}) for n in (plan.player, IMAGER, VIEWER))
    told = []
    if plan.poses is not None and "played" in player:
        told.append(f"{player['played']} of {plan.poses} played")
    elif player.get("state") == "playing":
        told.append(f"{player.get('position')} of {player.get('duration')} s played")
    if images := monitor.count_messages(IMAGER, IMAGES):
        latency, rate = slicer.get("latency_p99_ms", "?"), slicer.get("rate_hz", "?")
        told.append(f"{images} images, {rate}/s, p99 latency {latency} ms")
    elif slicer.get("received", "0") != "0":
        told.append("nobody subscribes to ultrasound/image")
    elif IMAGER in plan.nodes:
        told.append(f"waiting for {player.get('awaited', 'poses')}")
    elif player.get("state") == "waiting":
        told.append(f"waiting for the simulation on ROS domain {get_domain()}")
    if port := viewer.get("port"):
        host = str(next(each for each in plan.processes if each.node == VIEWER).parameters["host"])
        address = f"http://{f'[{host}]' if ':' in host else host}:{port}/"
        told.append(f"open {address if is_loopback(host) else 'the address with its token, above'}")
    return "; ".join(told)


def dry_run(request: RunRequest) -> str:
    """Return what :func:`run_scene` would start or leave out, and why, one line each."""
    scene, view, path, record = request.scene, request.view, request.path, request.record
    if record is not None:
        require_new(full_path(record))
    make_plan(request)
    rows = [(part.node, part.needed, part.reason) for part in scene.list_parts()]
    source = f"no --path: poses come from `{scene.tracker.source.name}`"
    rows.append(("path_player", path is not None, f"plays {path}" if path else source))
    rows.append((RECORDER, record is not None, f"records to {record}" if record else "no --record"))
    page = f"serves a page at {view.host}, port {view.port or 'any'}" if view else "no --view"
    rows.append((VIEWER, view is not None, page))
    lines = [f"scene {scene.name} ({scene.origin}), volume {scene.volume.name}"]
    lines += [f"{'runs' if runs else 'left out':<9} {node:<19} {why}" for node, runs, why in rows]
    on_demand = "wrench, tf, markers, annotated image, what is known of images"
    lines.append(f"on demand {on_demand}: nothing is computed for a topic nobody subscribes")
    return "\n".join(lines)


def run_scene(request: RunRequest, supervision: SupervisionSettings) -> int:
    """Run a scene until its path ends, the duration is over, or Ctrl-C.

    Raises:
        UsSimError: bad input, or something was lost: a node ended or hung, images were not
            recorded.
    """
    if request.topic and request.path is None:
        raise UsSimError(f"--topic {request.topic}: is of a path: name its file with --path")
    if request.record is not None:
        require_new(full_path(request.record))
    outcome = _simulate(request, None, supervision)
    for file in outcome.files:
        print(f"recorded to {file}")
    return _require_nothing_lost(outcome)


def _simulate(request: RunRequest, log: Path | None, supervision: SupervisionSettings) -> Outcome:
    plan = make_plan(request)
    require_free_port(plan)
    prepare_scene(request.scene, request.path, plan.topic)
    if log is not None:
        log.parent.mkdir(parents=True, exist_ok=True)
    return follow_plan(plan, log, supervision, request)


def run_demo(request: RunRequest, out: Path, supervision: SupervisionSettings) -> int:
    """Replay a path through a scene's nodes; recording, contact sheet and summary in ``out``.

    Raises:
        UsSimError: as for `run_scene`, or ``out`` already holds a session.
    """
    if get_ros_arguments():
        raise UsSimError(
            "--ros-args: the demo's report is of topics under their usual names: use `us-sim run "
            "--record FILE` where they have others"
        )
    recording, scene = out / "session.mcap", request.scene
    if recording.exists():
        raise UsSimError(f"{recording} exists already; choose another folder with --out")
    request = replace(request.with_path(), record=recording)
    started = time.monotonic()
    outcome = _simulate(request, out / "nodes.log", supervision)
    try:
        _report(scene, out, outcome, time.monotonic() - started)
    except UsSimError as error:
        why = filter(None, [outcome.describe_losses(), str(error)])
        raise UsSimError("; ".join(why)) from error
    return _require_nothing_lost(outcome)


def view_running(view: ViewerSettings, given: Parameters, supervision: SupervisionSettings) -> int:
    """Show whatever runs on this ROS domain, here or on other machines, until Ctrl-C.

    Raises:
        UsSimError: the viewer cannot start, or one is there already.
    """
    viewer = plan_viewer(view, check_parameters("viewer", None, given.get("viewer", {})))
    others = sorted(set(given) - {viewer.node})
    if others:
        raise UsSimError(
            f"--param {others[0]}: --attach starts the viewer alone; set parameters of what runs "
            f"already with `ros2 param set`, or in the page"
        )
    plan = Plan([viewer])
    require_free_port(plan)
    return _require_nothing_lost(follow_plan(plan, None, supervision))


def play_bag(
    bag: Path, player: PlayerSettings, *, topic: str, everything: bool, lockstep: bool
) -> int:
    """Play a bag into whatever runs on this ROS domain.

    Raises:
        UsSimError: it cannot be played.
    """
    from us_sim.recording.path import read_path
    from us_sim.recording.reader import read_bag

    given = {name: value for name, value in vars(player).items() if value is not None}
    settings: dict[str, object] = {"path": str(full_path(bag)), **given}
    if everything:
        process, poses = NodeProcess("session_player", settings), read_bag(bag).message_count
    else:
        poses = len(read_path(bag, topic or None, option="--topic"))
        process = NodeProcess("path_player", settings | {"topic": topic, "lockstep": lockstep})
    plan = Plan([process], poses, player=process.node)
    return _require_nothing_lost(follow_plan(plan, None, SupervisionSettings()))


def _require_nothing_lost(outcome: Outcome) -> int:
    if lost := outcome.describe_losses():
        raise UsSimError(lost)
    return 0


def _report(scene: Scene, out: Path, outcome: Outcome, wall: float) -> None:
    from us_sim.run.contact_sheet import contact_sheet
    from us_sim.run.session_summary import read_session

    with ProgressBar("measuring the recording", 100, "%") as bar:
        session = read_session(*outcome.files)
        meter = session.measure_lumens(scene, 120, lambda done: bar.update(50 * done))
        sections = meter.collect_comparable_sections() if meter is not None else {}
        summary = session.summarize(sections)
        summary |= {"scene": scene.name, "startup_s": round(outcome.startup, 2)}
        summary |= {"wall_s": round(wall, 2), "lost": list(outcome.losses)}
        bar.update(50, "drawing the contact sheet")
        contact_sheet(session, scene, sections, out / "contact_sheet.png")
        bar.update(100)
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    latency = summary["latency_ms"]
    image, recorder = latency["/ultrasound/image"], latency["end_to_end"]
    print(
        f"{summary['poses_in']} poses in, {summary['images_out']} images out, "
        f"{summary['dropped']} dropped, {summary['images_per_second']:.1f} images/s, "
        f"pose to image p50 {image['p50']:.1f} ms, p99 {image['p99']:.1f} ms; "
        f"to the recorder {recorder['p50']:.1f} ms, {recorder['p99']:.1f} ms"
    )
    for vessel in sections:
        told = []
        for moment, form in (("at_full_press", "+.0%"), ("after_release", "+.1%")):
            change = summary["areas"][f"{vessel}_change_{moment}"]
            shown = "not in the image" if change is None else format(change, form)
            told.append(f"{shown} {moment.replace('_', ' ')}")
        print(f"{vessel}: {', '.join(told)}")
    recordings = (file.name for file in outcome.files)
    for name in (*recordings, "contact_sheet.png", "summary.json", "nodes.log"):
        print(out / name)
