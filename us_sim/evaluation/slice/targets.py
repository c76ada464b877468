"""What is asked of the slices, against what was seen in one run."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from us_sim.evaluation.slice.cases import MAIN
from us_sim.evaluation.slice.points import Point
from us_sim.evaluation.target import Target

__all__ = [
    "LARGE_VOLUME",
    "exponent",
    "main_points",
    "mesh_points",
    "size_points",
    "targets",
]

_METHOD = "scan_conversion"
LARGE_VOLUME = 512
"""Voxels a side, of the volume whose memory is asked for."""


def main_points(points: Sequence[Point]) -> list[Point]:
    """Those of the case by which methods are compared."""
    return [p for p in mesh_points(points) if p.nodes == np.prod(MAIN.counts)]


def mesh_points(points: Sequence[Point]) -> list[Point]:
    """The same image on every mesh."""
    return [p for p in _of_main_image(points) if p.size == MAIN.size]


def size_points(points: Sequence[Point]) -> list[Point]:
    """The same image in every size."""
    return [p for p in _of_main_image(points) if p.nodes == np.prod(MAIN.counts)]


def exponent(points: Sequence[Point], across: Callable[[Point], float]) -> float:
    """k in processor time ~ across^k, by least squares of logarithms; NaN with fewer than two."""
    known = {across(p): p.cpu_ms_median for p in points if np.isfinite(p.cpu_ms_median)}
    if len(known) < 2:
        return float("nan")
    return float(np.polyfit(np.log(list(known)), np.log(list(known.values())), 1)[0])


def targets(
    points: Sequence[Point], peak_memory: int | None, publishing: float | None
) -> list[Target]:
    """Every measure that is asked for.

    Args:
        points: all rows.
        peak_memory: bytes that a process held with a volume of 512³ voxels, where known.
        publishing: ms of sending an image, where known.
    """
    main = {(p.method, p.threads): p for p in main_points(points)}
    wall = {threads: p.ms_median for (method, threads), p in main.items() if method == _METHOD}
    own = [p for p in points if p.method == _METHOD and not p.failure]
    meshes = [p for p in mesh_points(points) if p.method == _METHOD and p.threads == 1]
    sizes = [p for p in size_points(points) if p.method == _METHOD and p.threads == 1]
    image = f"{MAIN.size} × {MAIN.size} on {_tetrahedra(points)} tetrahedra pressed 12 mm"
    return [
        _at_most(f"{image}, one core", 2.0, wall.get(1, float("nan")), "ms"),
        _at_most(f"{image}, two cores", 1.2, wall.get(2, float("nan")), "ms"),
        _ratio("times as fast as VTK (filter and sampling)", 20, main, "vtk"),
        _ratio("times as fast as `row_subdivision`", 5, main, "row_subdivision"),
        _count(
            f"pixels of {sum(p.size**2 for p in own if p.threads == 1):,} with a wrong coverage",
            0,
            sum(p.coverage_mismatch_px for p in own if p.threads == 1) if own else None,
        ),
        _count(
            "grey levels that a pixel is off, at most",
            1,
            max((p.max_grey_difference for p in own), default=None),
        ),
        _growth(meshes),
        _linear(sizes),
        _memory(peak_memory),
        _at_most(
            f"making and publishing the message of an image, {MAIN.size} × {MAIN.size} at 60 Hz",
            1.0,
            float("nan") if publishing is None else publishing,
            "ms",
        ),
    ]


def _tetrahedra(points: Sequence[Point]) -> str:
    return "".join(f"{tets:,}" for tets in {p.tets for p in main_points(points)})


def _of_main_image(points: Sequence[Point]) -> list[Point]:
    return [
        p
        for p in points
        if (p.deformation, p.plane) == (MAIN.deformation, MAIN.plane) and not p.failure
    ]


def _at_most(what: str, asked: float, seen: float, unit: str) -> Target:
    if not np.isfinite(seen):
        return Target(what, f"at most {asked:g} {unit}", "not measured", None)
    return Target(what, f"at most {asked:g} {unit}", f"{seen:.2f} {unit}", seen <= asked)


def _ratio(what: str, asked: float, main: dict[tuple[str, int], Point], slow: str) -> Target:
    """The lesser of the ratios of wall clock and processor time, both methods on one thread."""
    if not {(slow, 1), (_METHOD, 1)} <= main.keys():
        return Target(what, f"at least {asked:g}", "not measured", None)
    other, own = main[slow, 1], main[_METHOD, 1]
    seen = min(other.ms_median / own.ms_median, other.cpu_ms_median / own.cpu_ms_median)
    return Target(what, f"at least {asked:g}", f"{seen:.1f}", seen >= asked)


def _count(what: str, asked: int, seen: float | None) -> Target:
    if seen is None:
        return Target(what, f"{asked}", "not measured", None)
    return Target(what, f"{asked}", f"{seen:g}", seen <= asked)


def _growth(meshes: Sequence[Point]) -> Target:
    """The longest time over the smallest mesh's."""
    what, asked = "time on 65,536 nodes over that on 2,000", "at most 1.5"
    times = {p.nodes: p.cpu_ms_median for p in meshes}
    if len(times) < 2:
        return Target(what, asked, "not measured", None)
    ratio = times[max(times)] / times[min(times)]
    return Target(what, asked, f"{ratio:.2f}", ratio <= 1.5)


def _linear(sizes: Sequence[Point]) -> Target:
    what, asked = "k in time ~ pixels^k", "at most 1 (linear)"
    found = exponent(sizes, lambda p: p.size**2)
    if not np.isfinite(found):
        return Target(what, asked, "not measured", None)
    return Target(what, asked, f"{found:.2f}", round(found, 2) <= 1.0)


def _memory(peak: int | None) -> Target:
    what = f"memory beyond the volume's own, {LARGE_VOLUME}³ voxels, Python and libraries included"
    if peak is None:
        return Target(what, "at most 300 MB", "not measured", None)
    beyond = (peak - LARGE_VOLUME**3) / 1e6
    return Target(what, "at most 300 MB", f"{beyond:.0f} MB", beyond <= 300)
