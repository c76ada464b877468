"""What is asked of the slices, against what was seen in one run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from us_sim.evaluation.power_law import exponent
from us_sim.evaluation.slice.cases import MAIN
from us_sim.evaluation.slice.methods import OURS
from us_sim.evaluation.slice.points import Point
from us_sim.evaluation.target import Target

LARGE_VOLUME = 512  # voxels a side, of the volume whose memory is asked for


def main_points(points: Sequence[Point]) -> list[Point]:
    """Those of the case by which methods are compared."""
    return [p for p in mesh_points(points) if p.nodes == np.prod(MAIN.counts)]


def mesh_points(points: Sequence[Point]) -> list[Point]:
    """The same image on every mesh."""
    return [p for p in _of_main_image(points) if p.size == MAIN.size]


def size_points(points: Sequence[Point]) -> list[Point]:
    """The same image in every size."""
    return [p for p in _of_main_image(points) if p.nodes == np.prod(MAIN.counts)]


def targets(
    points: Sequence[Point], peak_memory: int | None, publishing: float | None
) -> list[Target]:
    """Every measure that is asked for; the bytes of the process and ms of sending where known."""
    main = {(p.method, p.threads): p for p in main_points(points)}
    wall = {threads: p.ms_median for (method, threads), p in main.items() if method == OURS}
    own = [p for p in points if p.method == OURS and not p.failure]
    meshes = [p for p in mesh_points(points) if p.method == OURS and p.threads == 1]
    sizes = [p for p in size_points(points) if p.method == OURS and p.threads == 1]
    image = f"{MAIN.size} × {MAIN.size} on {_tetrahedra(points)} tetrahedra pressed 12 mm"
    mismatches = sum(p.coverage_mismatch_px for p in own if p.threads == 1) if own else np.nan
    pixels = sum(p.size**2 for p in own if p.threads == 1)
    grey = max((p.max_grey_difference for p in own), default=np.nan)
    times = {p.nodes: p.cpu_ms_median for p in meshes}
    growth = times[max(times)] / times[min(times)] if len(times) > 1 else np.nan
    linear = exponent({p.size**2: p.cpu_ms_median for p in sizes})
    beyond = np.nan if peak_memory is None else (peak_memory - LARGE_VOLUME**3) / 1e6
    return [
        Target.at_most(f"{image}, one core", 2.0, wall.get(1, np.nan), "ms", form=".2f"),
        Target.at_most(f"{image}, two cores", 1.2, wall.get(2, np.nan), "ms", form=".2f"),
        _ratio("times as fast as VTK (filter and sampling)", 20, main, "vtk"),
        _ratio("times as fast as `row_subdivision`", 5, main, "row_subdivision"),
        Target.at_most(f"pixels of {pixels:,} with a wrong coverage", 0, mismatches, form="g"),
        Target.at_most("grey levels that a pixel is off", 1, grey, form="g"),
        Target.at_most("time on 65,536 nodes over that on 2,000", 1.5, growth, form=".2f"),
        # A measured exponent of 1.004 is linear, too.
        Target.at_most("k in time ~ pixels^k", 1, round(linear, 2), form=".2f"),
        Target.at_most(
            f"memory beyond the volume's own, {LARGE_VOLUME}³ voxels, Python and libraries "
            f"included",
            300,
            beyond,
            "MB",
            form=".0f",
        ),
        Target.at_most(
            f"making and publishing the message of an image, {MAIN.size} × {MAIN.size} at 60 Hz",
            1.0,
            np.nan if publishing is None else publishing,
            "ms",
            form=".2f",
        ),
    ]


def _tetrahedra(points: Sequence[Point]) -> str:
    return "".join(f"{tets:,}" for tets in {p.tets for p in main_points(points)})


def _of_main_image(points: Sequence[Point]) -> list[Point]:
    image = (MAIN.deformation, MAIN.plane)
    return [p for p in points if (p.deformation, p.plane) == image and not p.failure]


def _ratio(what: str, asked: float, main: dict[tuple[str, int], Point], slow: str) -> Target:
    """The lesser of the ratios of wall clock and processor time, both methods on one thread."""
    if not {(slow, 1), (OURS, 1)} <= main.keys():
        return Target.at_least(what, asked, np.nan)
    other, own = main[slow, 1], main[OURS, 1]
    seen = min(other.ms_median / own.ms_median, other.cpu_ms_median / own.cpu_ms_median)
    return Target.at_least(what, asked, seen, form=".1f")
