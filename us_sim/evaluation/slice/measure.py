"""`us-sim evaluate slice`: how wrong each method's images are, against how long they take.

Every method cuts the same images of a block of speckle, in turns in one run; each is compared with
what it must show by brute force in float64 (`us_sim.evaluation.slice.reference`). VTK takes part
where it is installed.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.report_folder import ReportFolder
from us_sim.evaluation.row import failures, words_of
from us_sim.evaluation.slice.cases import MAIN, Case, black_and_white, cases, speckle
from us_sim.evaluation.slice.costs import costs
from us_sim.evaluation.slice.memory import peak_memory
from us_sim.evaluation.slice.methods import Contender, contender, methods
from us_sim.evaluation.slice.pictures import draw_differences
from us_sim.evaluation.slice.points import Point, compare, timed_together
from us_sim.evaluation.slice.publishing import publishing_ms
from us_sim.evaluation.slice.recorded_frames import RecordedComparison, compare_with_recorded
from us_sim.evaluation.slice.recorded_sweep import RecordedSweep
from us_sim.evaluation.slice.reference import exact_slice, sampled
from us_sim.evaluation.slice.report import Surroundings, table, write_report
from us_sim.evaluation.slice.targets import LARGE_VOLUME
from us_sim.evaluation.slice.vtk_images import HOW_TO_GET, is_installed
from us_sim.evaluation.steps import steps
from us_sim.progress import Progress

_FRAMES = 4  # images that a case's are taken from, in turns
_SECONDS, _QUICK_SECONDS = (12.0, 2.0), (5.0, 1.0)  # s, of timing the main case, and another


def evaluate_slice(out: Path, quick: bool, recorded: RecordedSweep | None = None) -> int:
    """Write slice.csv, the pictures and slice.md, as `us_sim.evaluation` says.

    A quick run has fewer cases, timed more shortly. The frames of a recorded sweep are compared
    with images of its volume, if there is one.
    """
    folder = ReportFolder("slice", out, quick)
    comparison = _compared(recorded, out, quick)
    bench = _Bench(quick)
    points = [
        point
        for case in steps("slices", cases(quick), "cases", lambda case: case.name)
        for point in bench.points(case)
    ]
    folder.write_rows("slice", points)
    with Progress("around the slices", 4, "parts") as progress:
        progress.update(0, "picture of differences")
        failed = {point.method for point in points if point.failure}
        working = [method.name for method in methods() if method.name not in failed]
        draw_differences(bench.volume, working, folder.picture("differences"))
        progress.update(1, "probes and image formation")
        probes, settings = costs(bench.volume, quick)
        progress.update(2, "publishing")
        publishing = publishing_ms(MAIN.size)
        progress.update(3, "memory")
        memory = peak_memory(LARGE_VOLUME)
        progress.update(4)
    around = Surroundings(probes, settings, publishing, memory, comparison)
    write_report(folder, points, around)
    if not is_installed():
        print(HOW_TO_GET)
    return folder.finish(table(points), failures(points))


def _compared(recorded: RecordedSweep | None, out: Path, quick: bool) -> RecordedComparison | None:
    """The comparison with recorded frames, where there are some."""
    if recorded is None or recorded.volume is None or recorded.sweep is None:
        return None
    with Progress("recorded frames", 1, "sweep") as progress:
        progress.update(0, recorded.sweep.name)
        found = compare_with_recorded(recorded.volume, recorded.sweep, out, quick)
        progress.update(1)
    return found


class _Bench:
    """Cuts cases with every method; keeps the volumes that they cut."""

    def __init__(self, quick: bool) -> None:
        self.volume = speckle()
        self._contrast = black_and_white()
        self._seconds = _QUICK_SECONDS if quick else _SECONDS

    def points(self, case: Case) -> list[Point]:
        """A row for every method."""
        mesh, frames = case.mesh(), case.frames(_FRAMES)
        first = frames[0]
        exact = exact_slice(self.volume, mesh.nodes, mesh.tetrahedra, first.nodes, first.plane)
        shown = sampled(self._contrast, exact.rest)
        seen: dict[str, NDArray[np.uint8]] = {}
        contenders: list[Contender] = []
        points: dict[tuple[str, int], Point] = {}
        for method, threads in ((m, n) for m in methods() for n in m.threads):
            point = Point(
                *(method.name, case.size, len(mesh.nodes), len(mesh.tetrahedra), threads),
                deformation=case.deformation,
                plane=case.plane,
            )
            try:
                ready = contender(self.volume, case, method.name, threads)
                if method.name not in seen:
                    other = contender(self._contrast, case, method.name, threads)
                    seen[method.name] = other.image(first)
                errors = compare(
                    *(self.volume, first, exact, ready.image(first)),
                    ready.rest_coordinates(first),
                    (shown, seen[method.name]),
                    tissue_only=method.tissue_only,
                )
            # Whatever breaks in one method must not take the others' results along.
            except Exception as error:
                points[method.name, threads] = replace(point, failure=words_of(error))
                continue
            points[method.name, threads] = replace(point, **errors._asdict())
            contenders.append(ready)
        times = timed_together(contenders, frames, self._seconds[case != MAIN])
        for ready, timing in zip(contenders, times, strict=True):
            key = (ready.method, ready.threads)
            points[key] = replace(
                points[key],
                ms_median=timing.median,
                ms_p99=timing.p99,
                cpu_ms_median=float(np.median(timing.processor)),
                filter_ms=timing.parts[0],
                sampling_ms=timing.parts[1],
                images=len(timing.milliseconds),
            )
        return list(points.values())
