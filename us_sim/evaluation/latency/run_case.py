"""Runs the arm in one way, and listens to it."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from us_sim.errors import UsSimError
from us_sim.evaluation.latency.cases import PLACED, Case
from us_sim.evaluation.latency.listener import listening
from us_sim.evaluation.latency.points import Point
from us_sim.evaluation.latency.scene import write_scene
from us_sim.evaluation.latency.usage import UsageOverTime, usage_of
from us_sim.evaluation.own_process import start_module
from us_sim.evaluation.timed_cases import Tell
from us_sim.recording.reader import read_bag
from us_sim.run.lockstep import render
from us_sim.run.plan import NodeProcess, player_settings, recorder_of, simulation_nodes
from us_sim.run.processes import ProcessGroup
from us_sim.scene.reading import load_scene
from us_sim.scene.scene import Scene

if TYPE_CHECKING:
    from us_sim.nodes.arrivals import Arrivals

_START_S = 300.0  # the first run compiles
_WARMING_S = 2.0  # of images that do not count
_SETTLE_S = 1.5  # for what is under way to arrive, and to be recorded
_SAMPLE_S = 0.5


def run_case(case: Case, tell: Tell) -> Point:
    """What the case shows.

    Args:
        case: how to run the arm.
        tell: is told how many of the case's seconds are over.

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
    """How many images a second there are where each pose waits for the one before."""
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
        replace(process, given={"realtime": case.realtime})
        for process in simulation_nodes(scene, played=True)
    ]
    if case.recorder:
        processes.insert(0, NodeProcess("session_recorder", {"file": str(file)}))
    player = player_settings(scene, _path(scene), recorder_of(processes)) | {"loop": True}
    processes.append(NodeProcess("path_player", player))
    with listening(viewer=case.viewer) as arrivals, _started(case, processes, folder) as running:
        _await_images(arrivals, running, tell)
        usage: dict[str, UsageOverTime] = {node: UsageOverTime() for node in running.pids}
        scheduling = running.scheduling
        began, began_ns = time.monotonic(), time.time_ns()
        while (passed := time.monotonic() - began) < case.seconds:
            running.check()
            for node, pid in running.pids.items():
                usage[node].add(passed, usage_of(pid))
            tell(passed, f"{len(arrivals.heard('ultrasound/image'))} images")
            time.sleep(_SAMPLE_S)
        ended_ns = time.time_ns()
        time.sleep(_SETTLE_S)
        heard = {
            topic: [each for each in arrivals.heard(topic) if began_ns <= each[0] < ended_ns]
            for topic in arrivals.topics
        }
    recorded = _recorded(file, {s for s, _ in heard["ultrasound/image"]}) if case.recorder else None
    return Point(case, heard, recorded, usage, scheduling)


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
    nodes = [(process.node, process.all_parameters) for process in processes]
    child = start_module("us_sim.evaluation.latency.one_process", json.dumps(nodes))
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
    """Until images have come for a while."""
    began, first = time.monotonic(), 0.0
    while not first or time.monotonic() - first < _WARMING_S:
        tell(0.0, "imaging" if first else "starting")
        time.sleep(0.1)
        running.check()
        if not first and arrivals.heard("ultrasound/image"):
            first = time.monotonic()
        if time.monotonic() - began > _START_S:
            raise UsSimError(f"no image came in {_START_S:g} s")


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
