"""`us-sim evaluate latency`: how old the pose is when its image has come.

The scene `upper_arm` is run in many ways, with its path played again and again at 60 Hz: as the
separate processes of a live run, in one process, in lockstep; with meshes, methods and images of
several sizes; recorded or not, looked at or not, and with every core kept busy by something else.
"""

from __future__ import annotations

from pathlib import Path

from us_sim.evaluation.latency.cases import cases
from us_sim.evaluation.latency.points import Point
from us_sim.evaluation.latency.report import table, write_report
from us_sim.evaluation.latency.run_case import run_case
from us_sim.evaluation.report_folder import ReportFolder
from us_sim.evaluation.row import failures
from us_sim.evaluation.timed_cases import timed_cases
from us_sim.run.live import prepare_volume
from us_sim.run.processes import keep_on_this_host
from us_sim.scene.reading import load_scene


def evaluate_latency(out: Path, quick: bool) -> int:
    """Write latency.csv, the plots and latency.md, as `us_sim.evaluation` says."""
    folder = ReportFolder("latency", out, quick)
    keep_on_this_host(network=False)
    planned = cases(quick)
    prepare_volume(load_scene("upper_arm"))
    points = timed_cases(
        "latency",
        {case: case.seconds for case in planned},
        run_case,
        lambda case, words: Point(case, failure=words),
    )
    folder.write_rows("latency", points)
    write_report(folder, points)
    return folder.finish(table(points), failures(points))
