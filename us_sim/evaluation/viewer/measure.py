"""`us-sim evaluate viewer`: what the viewer costs the simulator, and how long a page waits.

The scene `upper_arm` is run without a viewer, with one that nobody looks at, with pages that take
what streams without drawing it, and with pages in a real browser.
"""

from __future__ import annotations

from pathlib import Path

from us_sim.evaluation.report_folder import ReportFolder
from us_sim.evaluation.row import failures
from us_sim.evaluation.timed_cases import timed_cases
from us_sim.evaluation.viewer.cases import cases
from us_sim.evaluation.viewer.points import Point
from us_sim.evaluation.viewer.report import table, write_report
from us_sim.evaluation.viewer.run_case import run_case
from us_sim.run.live import prepare_volume
from us_sim.run.processes import keep_on_this_host
from us_sim.scene.reading import load_scene


def evaluate_viewer(out: Path, quick: bool) -> int:
    """Write viewer.csv, the plots and viewer.md, as `us_sim.evaluation` says."""
    folder = ReportFolder("viewer", out, quick)
    keep_on_this_host(network=False)
    planned = cases(quick)
    prepare_volume(load_scene("upper_arm"))
    points = timed_cases(
        "viewer",
        {case: case.seconds for case in planned},
        run_case,
        lambda case, words: Point(case, failure=words),
    )
    folder.write_rows("viewer", points)
    write_report(folder, points)
    return folder.finish(table(points), failures(points))
