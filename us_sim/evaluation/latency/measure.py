"""Run the arm in many ways, one thing changed at a time, and listen to its graph.

>>> from us_sim.evaluation.latency.measure import cases
>>> [str(case) for case in cases(quick=True)][:2]
['fem, 2,000 nodes, 512 x 512, recorder', 'fem, 8,192 nodes, 512 x 512, recorder']
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from us_sim.errors import UsSimError
from us_sim.evaluation.processes import UsageByName, UsageOverTime, listening
from us_sim.evaluation.report import percentile
from us_sim.recording.reader import read_bag
from us_sim.run.plan import NodeProcess, player_settings, recorder_of, simulation_nodes
from us_sim.run.processes import ProcessGroup
from us_sim.scene.reading import load_scene
from us_sim.scene.scene import Scene

if TYPE_CHECKING:
    from us_sim.evaluation.latency.arrivals import Arrivals

COARSE, FINE = (20, 10, 10), (32, 16, 16)  # nodes of the meshes in x, y and z
HAND = 0.1  # m/s of a hand, by which a delay becomes a distance
Heard = Sequence[tuple[int, int]]  # stamps and times of arrival, ns


@dataclass(frozen=True)
class Case:
    """One way to run the scene ``upper_arm``."""

    solver: str = "fem"
    mesh: tuple[int, int, int] = COARSE
    image: tuple[int, int] = (512, 512)  # columns and rows
    recorder: bool = True
    viewer: bool = False  # somebody looks at the annotated image and the structures
    busy: bool = False  # something else keeps every core busy
    realtime: bool = True  # the nodes go before ordinary programs, where the system allows that
    seconds: float = 20.0

    def __str__(self) -> str:
        columns, rows = self.image
        parts = [self.solver, f"{np.prod(self.mesh):,} nodes", f"{columns} x {rows}"]
        parts += ["recorder"] if self.recorder else []
        parts += ["viewer"] if self.viewer else []
        parts += ["cores busy"] if self.busy else []
        return ", ".join([*parts, "as ordinary programs"] if not self.realtime else parts)

    @property
    def columns(self) -> dict[str, Any]:
        """The case in the CSV; its words and ``realtime`` are for the report."""
        return {
            "case": str(self),
            "solver": self.solver,
            "nodes": int(np.prod(self.mesh)),
            "image": "x".join(map(str, self.image)),
            "recorder": self.recorder,
            "viewer": self.viewer,
            "cores_busy": self.busy,
            "seconds": self.seconds,
        }


LIVE = Case(mesh=FINE, seconds=300.0)  # the case of the limits for a live simulation
DEMO = Case("fem_nonlinear")  # the method and mesh of the demo
BUSY = replace(DEMO, busy=True)


def cases(quick: bool) -> list[Case]:
    """Cases of a run; a quick one has a few, of some seconds each."""
    base = Case()
    ordinary = replace(BUSY, realtime=False)
    if quick:
        return [replace(case, seconds=8.0) for case in (base, LIVE, DEMO, BUSY, ordinary)]
    return [
        base,
        replace(base, recorder=False),
        replace(base, viewer=True),
        replace(base, image=(256, 256)),
        replace(base, image=(768, 768)),
        replace(base, busy=True),
        *(replace(base, solver=solver) for solver in ("fem_cg", "msds")),
        DEMO,
        replace(DEMO, viewer=True),
        BUSY,
        ordinary,
        LIVE,
        replace(LIVE, busy=True, seconds=base.seconds),
        replace(DEMO, mesh=FINE),
    ]


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


def run_case(case: Case) -> list[dict[str, Any]]:
    """Run the arm as the case says, and return its row.

    Raises:
        UsSimError: a node ends, or no image comes.
    """
    with tempfile.TemporaryDirectory(prefix="us_sim_latency_") as name:
        folder = Path(name)
        scene = load_scene(str(write_scene(case, folder)))
        with _busy_cores() if case.busy else contextlib.nullcontext():
            return [_run_live(case, scene, folder)]


def _run_live(case: Case, scene: Scene, folder: Path) -> dict[str, Any]:
    from us_sim.nodes.process import scheduling_of

    file = folder / "session.mcap"
    processes = [
        replace(process, parameters=process.parameters | {"realtime": case.realtime})
        for process in simulation_nodes(scene, played=True)
    ]
    if case.recorder:
        processes.insert(0, NodeProcess("session_recorder", {"file": str(file)}))
    assert scene.path is not None
    player = player_settings(scene, Path(scene.path), recorder_of(processes)) | {"loop": True}
    processes.append(NodeProcess("path_player", player))
    group = ProcessGroup(folder / "nodes.log")
    with listening(viewer=case.viewer) as arrivals, contextlib.ExitStack() as stack:
        stack.callback(group.stop)
        group.start(processes)
        _await_images(arrivals, group)
        usage, scheduling = UsageByName(), scheduling_of(group.pids["tissue_deformer"])
        began, began_ns = time.monotonic(), time.time_ns()
        while time.monotonic() - began < case.seconds:
            group.check()
            usage.update({pid: node for node, pid in group.pids.items()})
            time.sleep(0.5)
        ended_ns = time.time_ns()
        time.sleep(1.5)  # for messages under way to arrive, and to be recorded
        heard = arrivals.heard_between(began_ns, ended_ns)
    recorded = _recorded(file, {s for s, _ in heard["ultrasound/image"]}) if case.recorder else None
    return {"scheduling": scheduling, **row_of(heard, recorded, usage.uses)}


def row_of(
    heard: Mapping[str, Heard], recorded: int | None, usage: Mapping[str, UsageOverTime]
) -> dict[str, Any]:
    """Row of what was heard by topic, in their order, and of the usage by node.

    Args:
        heard: stamps and times of arrival, ns, by topic.
        recorded: number of the images that were heard and recorded; None without a recorder.
        usage: by node.
    """
    images = heard["ultrasound/image"]
    ages = {
        topic: np.array([1e-6 * (came - stamp) for stamp, came in heard[topic]]) for topic in heard
    }
    grown = [use.growth for use in usage.values() if not np.isnan(use.growth)]
    age = ages["ultrasound/image"]
    passed = images[-1][1] - images[0][1] if len(images) > 1 else 0
    stamps = {stamp for stamp, _ in images}
    missed = {stamp for stamp, _ in heard["tracker/pose"]} - stamps
    return {
        "poses": len(heard["tracker/pose"]),
        "images": len(images),
        "images_a_second": 1e9 * (len(images) - 1) / passed if passed else np.nan,
        # Of the poses between the first and the last image.
        "dropped": sum(min(stamps) <= stamp <= max(stamps) for stamp in missed) if stamps else 0,
        "not_recorded": np.nan if recorded is None else float(len(images) - recorded),
        **{
            f"{topic.replace('/', '_')}_ms_{name}": percentile(ages[topic], percent)
            for topic in ages
            if topic != "tracker/pose"
            for name, percent in (("p50", 50), ("p99", 99), ("worst", 100))
        },
        "image_mm_p50": HAND * percentile(age, 50),
        "image_mm_p99": HAND * percentile(age, 99),
        **{f"cores_{node}": use.processor for node, use in usage.items()},
        "cores_all": sum(use.processor for use in usage.values()) or np.nan,
        "memory_mb_all": 1e-6 * sum(use.memory for use in usage.values()) or np.nan,
        "growth_mb_a_minute": 1e-6 * max(grown) if grown else np.nan,
        "ages": [
            {"s": 1e-9 * (came - images[0][1]), "ms": 1e-6 * (came - stamp)}
            for stamp, came in images
        ],
    }


def _await_images(arrivals: Arrivals, group: ProcessGroup) -> None:
    """Wait until images have come for two seconds, which do not count."""
    began, first = time.monotonic(), 0.0
    while not first or time.monotonic() - first < 2.0:
        time.sleep(0.1)
        group.check()
        if not first and arrivals.heard("ultrasound/image"):
            first = time.monotonic()
        if time.monotonic() - began > 300.0:  # the first run compiles
            raise UsSimError("no image came in 300 s")


def _recorded(file: Path, stamps: set[int]) -> int:
    """How many images with one of the stamps (ns) the recording has."""
    there = set()
    for message in read_bag(file).messages(["/ultrasound/image"]):
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
