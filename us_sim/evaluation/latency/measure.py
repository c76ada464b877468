"""Run the arm in many ways, one thing changed at a time, and listen to its graph.

>>> from us_sim.evaluation.latency.measure import cases
>>> [str(case) for case in cases(quick=True)][:2]
['fem, 512 x 512, recorder', 'fem_nonlinear, 512 x 512, recorder']
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
from typing import Any

import numpy as np
import yaml

from us_sim.evaluation.processes import UsageOverTime, listening, simulating, started_by
from us_sim.evaluation.report import percentile
from us_sim.recording.reader import read_bag
from us_sim.share import find_bag

HAND = 0.1  # m/s of a hand, by which a delay becomes a distance
Heard = Sequence[tuple[int, int]]  # stamps and times of arrival, ns


@dataclass(frozen=True)
class Case:
    """One way to run the scene ``upper_arm``."""

    solver: str = "fem"
    image: tuple[int, int] = (512, 512)  # columns and rows
    recorder: bool = True
    busy: bool = False  # something else keeps every core busy
    realtime: bool = True  # the nodes go before ordinary programs, where the system allows that
    seconds: float = 20.0

    def __str__(self) -> str:
        columns, rows = self.image
        parts = [self.solver, f"{columns} x {rows}"]
        parts += ["recorder"] if self.recorder else []
        parts += ["cores busy"] if self.busy else []
        return ", ".join([*parts, "as ordinary programs"] if not self.realtime else parts)

    @property
    def columns(self) -> dict[str, Any]:
        """The case in the CSV; its words are for the report."""
        return {
            "case": str(self),
            "solver": self.solver,
            "image": "x".join(map(str, self.image)),
            "recorder": self.recorder,
            "cores_busy": self.busy,
            "seconds": self.seconds,
        }


DEMO = Case("fem_nonlinear", seconds=130.0)  # the method of the demo
BUSY = replace(DEMO, busy=True, seconds=20.0)


def cases(quick: bool) -> list[Case]:
    """Cases of a run; a quick one has a few, of some seconds each."""
    base, ordinary = Case(), replace(BUSY, realtime=False)
    if quick:
        return [replace(case, seconds=8.0) for case in (base, DEMO, BUSY, ordinary)]
    return [
        base,
        replace(base, recorder=False),
        replace(base, image=(256, 256)),
        replace(base, image=(768, 768)),
        *(replace(base, solver=solver) for solver in ("fem_cg", "msds")),
        DEMO,
        BUSY,
        ordinary,
    ]


def write_scene(case: Case, folder: Path) -> Path:
    """Write ``scene.yaml`` to a folder, and return it."""
    document = {
        "name": "latency",
        "based_on": "upper_arm",
        "probe": {"image": list(case.image)},
        "tissue": {"solver": case.solver},
    }
    file = folder / "scene.yaml"
    file.write_text(yaml.safe_dump(document, sort_keys=False), encoding="utf-8")
    return file


def run_case(case: Case) -> list[dict[str, Any]]:
    """Run the arm as the case says, and return its row.

    Raises:
        UsSimError: the simulation ends, or no image comes.
    """
    from us_sim.nodes.process import scheduling_of

    with tempfile.TemporaryDirectory(prefix="us_sim_latency_") as name:
        folder = Path(name)
        session = folder / "session.mcap"
        words = ["run", str(write_scene(case, folder)), "--param", "path_player.loop=true"]
        words += ["--path", str(find_bag("press_and_slide.mcap"))]
        words += ["--record", str(session)] if case.recorder else []
        for node in ("probe_tracker", "tissue_deformer", "skin_deformer", "slice_interpolator"):
            words += ["--param", f"{node}.realtime={str(case.realtime).lower()}"]
        busy = _busy_cores() if case.busy else contextlib.nullcontext()
        with listening() as arrivals, busy, simulating(*words) as simulation:
            simulation.await_images(arrivals)
            time.sleep(2.0)  # these images do not count
            pids = {node: pid for pid, node in started_by(simulation.process.pid).items()}
            scheduling = scheduling_of(pids["tissue_deformer"])
            usage = UsageOverTime(simulation.process.pid)
            began, began_ns = time.monotonic(), time.time_ns()
            while time.monotonic() - began < case.seconds:
                simulation.check()
                usage.update()
                time.sleep(0.5)
            ended_ns = time.time_ns()
            time.sleep(1.5)  # for messages under way to arrive, and to be recorded
            heard = arrivals.heard_between(began_ns, ended_ns)
        stamps = {stamp for stamp, _ in heard["ultrasound/image"]}
        recorded = _recorded(session, stamps) if case.recorder else None
    return [{"scheduling": scheduling, **row_of(heard, recorded, usage.columns())}]


def row_of(
    heard: Mapping[str, Heard], recorded: int | None, usage: Mapping[str, float]
) -> dict[str, Any]:
    """Row of what was heard by topic, in their order, and of the usage.

    Args:
        heard: stamps and times of arrival, ns, by topic.
        recorded: number of the images that were heard and recorded; None without a recorder.
        usage: columns of `UsageOverTime`.
    """
    images = heard["ultrasound/image"]
    ages = {
        topic: np.array([1e-6 * (came - stamp) for stamp, came in heard[topic]]) for topic in heard
    }
    age = ages["ultrasound/image"]
    passed = images[-1][1] - images[0][1] if len(images) > 1 else 0
    stamps = {stamp for stamp, _ in images}
    missed = {stamp for stamp, _ in heard["tracker/pose"]} - stamps
    of_all = {
        part: [value for name, value in usage.items() if name.startswith(f"{part}_")]
        for part in ("cores", "memory_mb", "growth_mb_a_minute")
    }
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
        **{name: value for name, value in usage.items() if name.startswith("cores_")},
        "cores_all": sum(of_all["cores"]),
        "memory_mb_all": sum(of_all["memory_mb"]),
        "growth_mb_a_minute": max(of_all["growth_mb_a_minute"], default=np.nan),
        "ages": [
            {"s": 1e-9 * (came - images[0][1]), "ms": 1e-6 * (came - stamp)}
            for stamp, came in images
        ],
    }


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
