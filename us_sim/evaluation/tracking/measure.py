"""`us-sim evaluate tracking`: how wrong tracked poses are, and how long they take.

Bodies of markers are rendered as a camera sees them at known poses
(`us_sim.tracking.camera.rendered_views`), in short sequences as a hand moves them, and tracked as
`probe_tracker` does it. Filters are compared with the path to which noise was added for them.
"""

from __future__ import annotations

from pathlib import Path

from us_sim.evaluation.report_folder import ReportFolder
from us_sim.evaluation.row import failures, words_of
from us_sim.evaluation.steps import steps
from us_sim.evaluation.tracking.cases import LARGE, RIGID_BODY, SINGLE, SMALL, Case, cases
from us_sim.evaluation.tracking.filters import filter_point, filter_trials
from us_sim.evaluation.tracking.pictures import draw_views
from us_sim.evaluation.tracking.points import Bench, Point
from us_sim.evaluation.tracking.report import table, write_report
from us_sim.evaluation.tracking.small_markers import small_marker_point, small_marker_trials

_SEQUENCES, _QUICK_SEQUENCES = {SMALL: 12, LARGE: 8}, {SMALL: 5, LARGE: 3}
"""Sequences of views a case, by the size of the images."""
_MORE = 3  # times as many sequences of the cases that the targets are about


def evaluate_tracking(out: Path, quick: bool) -> int:
    """Write the CSV files, the pictures and tracking.md, as `us_sim.evaluation` says.

    A quick run has fewer distances, angles and views.
    """
    folder = ReportFolder("tracking", out, quick)
    bench = Bench()
    bench.warm_up()
    points = [_point(bench, case, quick) for case in steps("views", cases(quick), "cases")]
    trials = list(small_marker_trials(quick))
    small = [small_marker_point(*trial) for trial in steps("small markers", trials, "sizes")]
    filters = [filter_point(*trial) for trial in steps("filters", filter_trials(quick), "settings")]
    folder.write_rows("tracking", points)
    folder.write_rows("small_markers", small)
    folder.write_rows("filters", filters)
    draw_views(folder.picture("views"))
    write_report(folder, points, small, filters)
    return folder.finish(table(points, small), failures(points))


def _point(bench: Bench, case: Case, quick: bool) -> Point:
    sequences = (_QUICK_SEQUENCES if quick else _SEQUENCES)[case.image_size]
    if case.condition == "plain" and case.marker in (SINGLE, RIGID_BODY):
        sequences *= _MORE
    try:
        return bench.point(case, sequences)
    # Whatever breaks in one case must not take the others' results along.
    except Exception as error:
        return Point(case, failure=words_of(error))
