"""`us-sim evaluate tracking`: how wrong tracked poses are, and how long they take.

Bodies of markers are rendered as a camera sees them at known poses
(`us_sim.tracking.camera.rendered_views`), in short sequences as a hand moves them, and tracked as
`probe_tracker` does it. Filters are held against the path that they are given with noise.
"""

from __future__ import annotations

import time
from pathlib import Path

from us_sim.evaluation.report_folder import prepare_folder, write_rows
from us_sim.evaluation.tracking.cases import RIGID_BODY, SINGLE, Case, cases
from us_sim.evaluation.tracking.filters import COLUMNS as FILTER_COLUMNS
from us_sim.evaluation.tracking.filters import filter_points
from us_sim.evaluation.tracking.pictures import draw_views
from us_sim.evaluation.tracking.points import COLUMNS, Bench, Point
from us_sim.evaluation.tracking.report import table, write_report
from us_sim.progress import Progress

__all__ = ["evaluate_tracking"]

# Sequences of views a case, of small and of large images.
_SEQUENCES = {"640x480": 12, "1920x1080": 8}
_QUICK_SEQUENCES = {"640x480": 5, "1920x1080": 3}
# Times as many of the cases that the measures are about.
_MORE = 3


def evaluate_tracking(out: Path, quick: bool) -> int:
    """Measure, write tracking.csv, filters.csv, the pictures and tracking.md, print the table.

    Args:
        out: folder to write to; made if it is not there.
        quick: fewer distances, angles and views.

    Returns:
        0, or 1 when a case failed; its row says how, and the others are there.

    Raises:
        UsSimError: the folder cannot be written, or holds a report.
    """
    begin = time.perf_counter()
    prepare_folder(out, "tracking.md")
    planned = cases(quick)
    bench = Bench()
    points: list[Point] = []
    with Progress("views", len(planned), "cases") as progress:
        bench.warm_up()
        for done, case in enumerate(planned):
            progress.update(done, f"{case.marker}, {case.distance:g} m, {case.condition}")
            points.append(_point(bench, case, quick))
        progress.update(len(planned))
    with Progress("filters", 1, "path") as progress:
        filters = filter_points(quick)
        progress.update(1)
    write_rows(out / "tracking.csv", COLUMNS, [point.row for point in points])
    write_rows(out / "filters.csv", FILTER_COLUMNS, [point.row for point in filters])
    views = out / "tracking_views.png"
    draw_views(views)
    seconds = time.perf_counter() - begin
    pictures = [*write_report(out, points, filters, quick, seconds), views]
    print(table(points))
    print(f"Report: {out / 'tracking.md'}; pictures: {', '.join(map(str, pictures))}")
    failed = [point for point in points if point.failure]
    for point in failed:
        print(f"failed: {point.case}: {point.failure}")
    return 1 if failed else 0


def _point(bench: Bench, case: Case, quick: bool) -> Point:
    sequences = (_QUICK_SEQUENCES if quick else _SEQUENCES)[case.image_size]
    if case.condition == "plain" and case.marker in (SINGLE, RIGID_BODY):
        sequences *= _MORE
    try:
        return bench.point(case, sequences)
    # Whatever breaks in one case must not take the others' results along.
    except Exception as error:
        words = f"{type(error).__name__}: {error}".replace("\n", " ")
        return Point(case, failure=words)
