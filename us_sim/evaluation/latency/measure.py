"""Run the arm in many ways, one change at a time, and record the messages of its graph.

>>> from us_sim.evaluation.latency.measure import list_cases
>>> [str(case) for case in list_cases(quick=True)][:2]
['fem, 512x512, recorder', 'fem_nonlinear, 512x512, recorder']
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

from us_sim.evaluation.processes import (
    UsageOverTime,
    find_descendants,
    record_arrivals,
    run_simulator,
)
from us_sim.evaluation.report import compute_percentile
from us_sim.recording.decoding import read_stamp
from us_sim.recording.reader import read_bag
from us_sim.share import find_bag


@dataclass(frozen=True)
class LatencyCase:
    """One way to run the scene ``upper_arm``."""

    solver: str = "fem"
    image: str = "512x512"  # columns and rows
    recorder: bool = True
    cores_busy: bool = False  # with other programs
    seconds: float = 20.0
    realtime: bool = True  # nodes go before ordinary programs, if the system allows it

    def __str__(self) -> str:
        parts = {
            f"{self.solver}, {self.image}": True,
            "recorder": self.recorder,
            "cores busy": self.cores_busy,
            "as ordinary programs": not self.realtime,
        }
        return ", ".join(part for part, is_named in parts.items() if is_named)


DEMO = LatencyCase("fem_nonlinear", seconds=130.0)  # the method of the demo
BUSY = replace(DEMO, cores_busy=True, seconds=20.0)


def list_cases(quick: bool) -> list[LatencyCase]:
    """List the cases; a quick run has a few, of some seconds each."""
    base, ordinary = LatencyCase(), replace(BUSY, realtime=False)
    if quick:
        return [replace(case, seconds=8.0) for case in (base, DEMO, BUSY, ordinary)]
    return [
        base,
        replace(base, recorder=False),
        replace(base, image="256x256"),
        replace(base, image="768x768"),
        *(replace(base, solver=solver) for solver in ("fem_cg", "msds")),
        DEMO,
        BUSY,
        ordinary,
    ]


def run_case(case: LatencyCase) -> list[dict[str, Any]]:
    """Run the arm as in the case, and return its row.

    Raises:
        UsSimError: the simulation ends, or no image comes.
    """
    with tempfile.TemporaryDirectory(prefix="us_sim_latency_") as name:
        scene, session = Path(name) / "scene.yaml", Path(name) / "session.mcap"
        size = f"[{case.image.replace('x', ', ')}]"
        changes = f"probe: {{image: {size}}}\ntissue: {{solver: {case.solver}}}\n"
        scene.write_text(f"name: latency\nbased_on: upper_arm\n{changes}")
        arguments = ["run", str(scene), "--path", str(find_bag("press_and_slide.mcap"))]
        arguments += ["--param", "path_player.loop=true"]
        arguments += ["--record", str(session)] if case.recorder else []
        for node in ("probe_tracker", "tissue_deformer", "skin_deformer", "slice_interpolator"):
            arguments += ["--param", f"{node}.realtime={str(case.realtime).lower()}"]
        busy = _keep_cores_busy() if case.cores_busy else contextlib.nullcontext()
        with record_arrivals() as arrivals, busy, run_simulator(*arguments) as simulation:
            simulation.await_image(arrivals)
            time.sleep(2.0)  # these images do not count
            pids = {node: pid for pid, node in find_descendants(simulation.process.pid).items()}
            policy = os.sched_getscheduler(pids["tissue_deformer"]) & ~os.SCHED_RESET_ON_FORK
            scheduling = "realtime" if policy == os.SCHED_RR else "ordinary"
            usage = UsageOverTime(simulation.process.pid)
            began, began_ns = time.monotonic(), time.time_ns()
            while time.monotonic() - began < case.seconds:
                simulation.require_running()
                usage.update()
                time.sleep(0.5)
            ended_ns = time.time_ns()
            time.sleep(1.5)  # for messages under way to arrive, and to be recorded
            messages = arrivals.list_arrivals_between(began_ns, ended_ns)
        recorded = None
        if case.recorder:
            images = read_bag(session).read_messages(["/ultrasound/image"])
            stamps = {stamp for stamp, _ in messages["ultrasound/image"]}
            recorded = len(stamps & {read_stamp(image.data) for image in images})
    return [{"scheduling": scheduling, **make_row(messages, recorded, usage.make_columns())}]


def make_row(
    messages: Mapping[str, Sequence[tuple[int, int]]],
    recorded: int | None,
    usage: Mapping[str, float],
) -> dict[str, Any]:
    """Make the row of a case.

    Args:
        messages: stamps and times of arrival (ns) by topic, in the order of the graph.
        recorded: number of arrived images that were also recorded; None without a recorder.
        usage: columns of `UsageOverTime`.
    """
    ages = {
        topic: np.array([1e-6 * (b - a) for a, b in pairs]) for topic, pairs in messages.items()
    }
    age = ages["ultrasound/image"]
    stamps, came = np.array(messages["ultrasound/image"], dtype=np.int64).reshape(-1, 2).T
    passed = 1e-9 * np.ptp(came) if len(came) else 0.0
    poses = np.array([stamp for stamp, _ in messages["tracker/pose"]])
    # Of the poses between the first and the last image.
    missed = np.setdiff1d(poses, stamps)
    missed = missed[(missed > stamps.min(initial=2**62)) & (missed < stamps.max(initial=0))]

    def select_usage(part: str) -> list[float]:
        return [value for name, value in usage.items() if name.startswith(part)]

    return {
        "poses": len(poses),
        "images": len(stamps),
        "images_a_second": (len(stamps) - 1) / passed if passed else np.nan,
        "dropped": len(missed),
        "not_recorded": np.nan if recorded is None else float(len(stamps) - recorded),
        **{
            f"{topic.replace('/', '_')}_ms_{name}": compute_percentile(ages[topic], percent)
            for topic in ages
            if topic != "tracker/pose"
            for name, percent in (("p50", 50), ("p99", 99), ("worst", 100))
        },
        "image_mm_p50": 0.1 * compute_percentile(age, 50),  # way of a hand at 0.1 m/s
        "image_mm_p99": 0.1 * compute_percentile(age, 99),
        **{name: value for name, value in usage.items() if name.startswith("cores_")},
        "cores_all": sum(select_usage("cores_")),
        "memory_mb_all": sum(select_usage("memory_mb_")),
        "growth_mb_a_minute": max(select_usage("growth_mb_a_minute_"), default=np.nan),
    }


@contextlib.contextmanager
def _keep_cores_busy() -> Iterator[None]:
    """Keep every core busy with an ordinary program."""
    loop = [sys.executable, "-c", "while True: pass"]
    busy = [subprocess.Popen(loop) for _ in range(os.cpu_count() or 1)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()
