"""Run the arm in many ways, one thing changed at a time, and listen to its graph.

>>> from us_sim.evaluation.latency.measure import cases
>>> [str(case) for case in cases(quick=True)][:2]
['fem, 2,000 nodes, 512 x 512, recorder', 'fem, 8,192 nodes, 512 x 512, recorder']
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from numpy.typing import NDArray

from us_sim.errors import UsSimError
from us_sim.evaluation.processes import UsageByName, UsageOverTime, listening, start_program
from us_sim.evaluation.report import ReportFolder, Row, percentile, words_of
from us_sim.evaluation.timing import Tell
from us_sim.progress import Progress
from us_sim.recording.reader import read_bag
from us_sim.run.live import prepare_volume
from us_sim.run.lockstep import render
from us_sim.run.plan import NodeProcess, player_settings, recorder_of, simulation_nodes
from us_sim.run.processes import ProcessGroup, prepare_ros
from us_sim.scene.reading import load_scene
from us_sim.scene.scene import Scene

if TYPE_CHECKING:
    from us_sim.evaluation.latency.arrivals import Arrivals


RATE = 60.0  # poses a second

COARSE, FINE = (20, 10, 10), (32, 16, 16)  # nodes of the meshes in x, y and z

PLACED = ("processes", "one process", "lockstep")
"""One process for each node; all nodes in one process, each in a thread; or one pose at a time."""


@dataclass(frozen=True)
class Case:
    """One way to run the scene ``upper_arm``."""

    solver: str = "fem"
    mesh: tuple[int, int, int] = COARSE
    image: tuple[int, int] = (512, 512)  # columns and rows
    placed: str = "processes"  # one of `PLACED`
    recorder: bool = True
    viewer: bool = False  # somebody looks at the annotated image and the structures
    busy: bool = False  # something else keeps every core busy
    realtime: bool = True  # the nodes go before ordinary programs, where the system allows that
    seconds: float = 20.0

    @property
    def nodes(self) -> int:
        """Number of nodes of the mesh."""
        x, y, z = self.mesh
        return x * y * z

    def __str__(self) -> str:
        columns, rows = self.image
        parts = [self.solver, f"{self.nodes:,} nodes", f"{columns} x {rows}"]
        parts += [self.placed] if self.placed != PLACED[0] else []
        parts += ["recorder"] if self.recorder else []
        parts += ["viewer"] if self.viewer else []
        parts += ["cores busy"] if self.busy else []
        return ", ".join([*parts, "as ordinary programs"] if not self.realtime else parts)


LIVE = Case(mesh=FINE, seconds=300.0)  # the case of the limits for a live simulation

DEMO = Case("fem_nonlinear")  # the method and mesh of the demo


def cases(quick: bool) -> list[Case]:
    """Cases of a run; a quick one has a few, of some seconds each."""
    base = Case()
    if quick:
        chosen = [base, LIVE, DEMO, *_beside(DEMO), replace(base, placed=PLACED[1])]
        return [replace(case, seconds=8.0) for case in chosen]
    return [
        base,
        replace(base, recorder=False),
        replace(base, viewer=True),
        replace(base, image=(256, 256)),
        replace(base, image=(768, 768)),
        *(replace(base, placed=placed) for placed in PLACED[1:]),
        replace(base, busy=True),
        *(replace(base, solver=solver) for solver in ("fem_cg", "msds")),
        DEMO,
        replace(DEMO, viewer=True),
        *_beside(DEMO),
        *(replace(DEMO, placed=placed) for placed in PLACED[1:]),
        LIVE,
        replace(LIVE, busy=True, seconds=base.seconds),
        replace(DEMO, mesh=FINE),
    ]


def _beside(case: Case) -> list[Case]:
    """The case while other programs keep every core busy, with realtime priority and without."""
    busy = replace(case, busy=True)
    return [busy, replace(busy, realtime=False)]


HAND = 0.1  # m/s of a hand, by which a delay becomes a distance

Heard = Sequence[tuple[int, int]]  # stamps and times of arrival, ns


@dataclass(frozen=True)
class Point(Row):
    """A row of latency.csv."""

    case: Case
    heard: Mapping[str, Heard] = field(default_factory=dict)  # by topic, in their order
    recorded: int | None = None  # of the images that were heard; None without a recorder
    usage: Mapping[str, UsageOverTime] = field(default_factory=dict)  # by node
    scheduling: str = "ordinary"  # or realtime: what the nodes got
    throughput: float = float("nan")  # images a second, in lockstep
    failure: str = ""

    @property
    def title(self) -> str:
        return str(self.case)

    @property
    def values(self) -> dict[str, object]:
        case = self.case
        columns, rows = case.image
        return {
            "solver": case.solver,
            "nodes": case.nodes,
            "image": f"{columns}x{rows}",
            "placed": case.placed,
            "recorder": case.recorder,
            "viewer": case.viewer,
            "cores_busy": case.busy,
            "scheduling": self.scheduling,
            "seconds": case.seconds,
            "poses": len(self.heard.get("tracker/pose", ())),
            "images": len(self.images),
            "images_a_second": self.rate,
            "dropped": self.dropped,
            "not_recorded": self.lost,
            **{
                f"{topic.replace('/', '_')}_ms_{name}": self.latency(topic, percent)
                for topic in self.heard
                if topic != "tracker/pose"
                for name, percent in (("p50", 50), ("p99", 99), ("worst", 100))
            },
            "image_mm_p50": HAND * self.latency("ultrasound/image", 50),
            "image_mm_p99": HAND * self.latency("ultrasound/image", 99),
            **{f"cores_{node}": use.processor for node, use in self.usage.items()},
            "cores_all": sum(use.processor for use in self.usage.values()) or np.nan,
            "memory_mb_all": 1e-6 * sum(use.memory for use in self.usage.values()) or np.nan,
            "growth_mb_a_minute": self.growth,
            "failure": self.failure,
        }

    @property
    def images(self) -> Heard:
        """Stamps and arrivals of the images."""
        return self.heard.get("ultrasound/image", ())

    @property
    def rate(self) -> float:
        """Images a second."""
        if len(self.images) < 2:
            return self.throughput
        return (len(self.images) - 1) / (1e-9 * (self.images[-1][1] - self.images[0][1]))

    @property
    def dropped(self) -> int:
        """Poses between the first and the last image of which there is no image."""
        stamps = {stamp for stamp, _ in self.images}
        if not stamps:
            return 0
        poses = {stamp for stamp, _ in self.heard.get("tracker/pose", ())}
        return sum(min(stamps) <= stamp <= max(stamps) for stamp in poses - stamps)

    @property
    def lost(self) -> float:
        """Images that came here and are not in the recording."""
        return np.nan if self.recorded is None else len(self.images) - self.recorded

    @property
    def growth(self) -> float:
        """MB a minute of the process whose memory grows fastest."""
        grown = [use.growth for use in self.usage.values() if not np.isnan(use.growth)]
        return 1e-6 * max(grown) if grown else np.nan

    def ages(self, topic: str) -> NDArray[np.float64]:
        """ms from the tracker's pose to the arrival of each message."""
        return np.array([1e-6 * (came - stamp) for stamp, came in self.heard.get(topic, ())])

    def latency(self, topic: str, percent: float) -> float:
        """Percentile of the ages of a topic, ms; NaN where nothing came."""
        return percentile(self.ages(topic), percent)


def live_cases(
    folder: ReportFolder,
    cases: Sequence[Any],
    run: Callable[[Any, Tell], Row],
    row: Callable[..., Row],
) -> list[Any]:
    """Rows of the running arm, one case after another with a bar, also written to the folder.

    Args:
        folder: of the subject.
        cases: each with the ``seconds`` that it takes; one that breaks leaves the rest.
        run: runs one, on this host only.
        row: makes the row of one that broke, from the case and its ``failure`` in words.
    """
    prepare_ros(network=False)
    prepare_volume(load_scene("upper_arm"))
    points: list[Any] = []
    done = 0.0
    with Progress(folder.subject, sum(case.seconds for case in cases), "s") as progress:
        for case in cases:

            def tell(passed: float, words: str, case: Any = case, before: float = done) -> None:
                progress.update(before + min(passed, case.seconds), f"{case}: {words}")

            try:
                points.append(run(case, tell))
            except Exception as error:
                points.append(row(case, failure=words_of(error)))
            done += case.seconds
            progress.update(done)
    folder.write_rows(folder.subject, points)
    return points


def write_scene(case: Case, folder: Path) -> Path:
    """Write ``scene.yaml`` to a folder, and return it."""
    tissue: dict[str, object] = {"solver": case.solver}
    if case.mesh != COARSE:
        tissue["mesh"] = {"nodes": list(case.mesh), "planes": _planes(case.mesh)}
    document = {
        "name": "latency",
        "based_on": "upper_arm",
        "probe": {"image": list(case.image)},
        "tissue": tissue,
    }
    file = folder / "scene.yaml"
    file.write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")
    return file


def _planes(counts: tuple[int, int, int]) -> dict[str, list[float]]:
    """m, more planes of nodes than the arm has, as close together as there."""
    arm = load_scene("upper_arm")
    assert arm.tissue is not None
    planes = {}
    for axis, count in zip("xyz", counts, strict=True):
        own = arm.tissue.mesh.planes.get(axis)
        if own is not None:
            places = np.linspace(0, len(own) - 1, count)
            planes[axis] = np.interp(places, np.arange(len(own)), own).round(6).tolist()
    return planes


def run_case(case: Case, tell: Tell) -> Point:
    """Run the arm as the case says; ``tell`` is told how many of its seconds are over.

    Raises:
        UsSimError: a node ends, or no image comes.
    """
    with tempfile.TemporaryDirectory(prefix="us_sim_latency_") as name:
        folder = Path(name)
        scene = load_scene(str(write_scene(case, folder)))
        with _busy_cores() if case.busy else contextlib.nullcontext():
            if case.placed == "lockstep":
                return _in_lockstep(case, scene, folder, tell)
            return _live(case, scene, folder, tell)


def _in_lockstep(case: Case, scene: Scene, folder: Path, tell: Tell) -> Point:
    """Images a second where each pose waits for the one before."""
    began: list[float] = []

    def count(done: int, total: int) -> None:
        began.append(time.monotonic())
        tell(case.seconds * done / total, "in lockstep")

    out = folder / "out"
    out.mkdir()
    images = render(scene, _path(scene), out, count)
    if images < 2:
        raise UsSimError("lockstep made no two images")
    return Point(case, throughput=(len(began) - 1) / (began[-1] - began[0]))


def _live(case: Case, scene: Scene, folder: Path, tell: Tell) -> Point:
    file = folder / "session.mcap"
    processes = [
        replace(process, parameters=process.parameters | {"realtime": case.realtime})
        for process in simulation_nodes(scene, played=True)
    ]
    if case.recorder:
        processes.insert(0, NodeProcess("session_recorder", {"file": str(file)}))
    player = player_settings(scene, _path(scene), recorder_of(processes)) | {"loop": True}
    processes.append(NodeProcess("path_player", player))
    with listening(viewer=case.viewer) as arrivals, _started(case, processes, folder) as running:
        _await_images(arrivals, running, tell)
        usage, scheduling = UsageByName(), running.scheduling
        began, began_ns = time.monotonic(), time.time_ns()
        while (passed := time.monotonic() - began) < case.seconds:
            running.check()
            usage.update({pid: node for node, pid in running.pids.items()})
            tell(passed, f"{len(arrivals.heard('ultrasound/image'))} images")
            time.sleep(0.5)
        ended_ns = time.time_ns()
        time.sleep(1.5)  # for messages under way to arrive, and to be recorded
        heard = arrivals.heard_between(began_ns, ended_ns)
    recorded = _recorded(file, {s for s, _ in heard["ultrasound/image"]}) if case.recorder else None
    return Point(case, heard, recorded, usage.uses, scheduling)


def _path(scene: Scene) -> Path:
    assert scene.path is not None
    return Path(scene.path)


@dataclass(frozen=True)
class _Running:
    """Processes of a graph."""

    pids: Mapping[str, int]  # by node, or by how the nodes are placed
    ended: Callable[[], list[str]]  # which of them have
    log: Path | None = None

    @property
    def scheduling(self) -> str:
        """As `scheduling_of` the node that has most to do."""
        from us_sim.nodes.process import scheduling_of

        return scheduling_of(self.pids.get("tissue_deformer") or next(iter(self.pids.values())))

    def check(self) -> None:
        """Raise UsSimError when one has ended."""
        if ended := self.ended():
            lines = self.log.read_text(encoding="utf-8").splitlines() if self.log else []
            raise UsSimError(f"{ended[0]} has ended{': ' if lines else ''}{''.join(lines[-1:])}")


@contextlib.contextmanager
def _started(case: Case, processes: list[NodeProcess], folder: Path) -> Iterator[_Running]:
    """The nodes' processes, which end with the context."""
    if case.placed == PLACED[0]:
        log = folder / "nodes.log"
        group = ProcessGroup(log)
        try:
            group.start(processes)
            pids = group.pids
            yield _Running(pids, lambda: [node for node in pids if not group.is_running(node)], log)
        finally:
            group.stop()
        return
    nodes = [(process.node, process.parameters) for process in processes]
    child = start_program("nodes", json.dumps(nodes))
    try:
        yield _Running(
            {case.placed: child.pid}, lambda: [case.placed] if child.poll() is not None else []
        )
    finally:
        child.terminate()
        try:
            child.communicate(timeout=10.0)
        except subprocess.TimeoutExpired:
            child.kill()
            child.communicate()


def _await_images(arrivals: Arrivals, running: _Running, tell: Tell) -> None:
    """Wait until images have come for two seconds, which do not count."""
    began, first = time.monotonic(), 0.0
    while not first or time.monotonic() - first < 2.0:
        tell(0.0, "imaging" if first else "starting")
        time.sleep(0.1)
        running.check()
        if not first and arrivals.heard("ultrasound/image"):
            first = time.monotonic()
        if time.monotonic() - began > 300.0:  # the first run compiles
            raise UsSimError("no image came in 300 s")


def _recorded(file: Path, stamps: set[int]) -> int:
    """How many images with one of the stamps (ns) the recording has."""
    bag = read_bag(file)
    there = set()
    for message in bag.messages(["/ultrasound/image"]):
        stamp = message.data[4:12]
        seconds = int.from_bytes(stamp[:4], "little", signed=True)
        there.add(1_000_000_000 * seconds + int.from_bytes(stamp[4:], "little"))
    return len(stamps & there)


@contextlib.contextmanager
def _busy_cores() -> Iterator[None]:
    """Something else that takes all it can get of every core."""
    work = [sys.executable, "-c", "while True: pass"]
    busy = [subprocess.Popen(work) for _ in range(os.cpu_count() or 1)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()
