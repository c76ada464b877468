"""slice.md: what was asked and seen, the tables, the pictures, and how it was measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from us_sim.evaluation.markdown_table import markdown_table
from us_sim.evaluation.power_law import exponent
from us_sim.evaluation.report_folder import ReportFolder
from us_sim.evaluation.row import failures
from us_sim.evaluation.slice.cases import DEPTHS, MAIN, PLANES
from us_sim.evaluation.slice.costs import Cost
from us_sim.evaluation.slice.plots import plot_errors, plot_meshes, plot_pixels
from us_sim.evaluation.slice.points import Point
from us_sim.evaluation.slice.recorded_frames import RecordedComparison
from us_sim.evaluation.slice.targets import main_points, mesh_points, size_points, targets
from us_sim.evaluation.slice.vtk_images import HOW_TO_GET
from us_sim.evaluation.target import target_table


@dataclass(frozen=True)
class Surroundings:
    """What is measured around the slices themselves."""

    probes: Sequence[Cost]
    settings: Sequence[Cost]
    publishing: float | None  # ms, where known
    peak_memory: int | None  # bytes held with a volume of 512³ voxels, where known
    recorded: RecordedComparison | None  # where it was asked for


def table(points: Sequence[Point]) -> str:
    """What the command prints: every method in the main case, and its worst in all of them."""
    head = ("method", "threads", "ms", "p99", "CPU ms")
    rows: list[Sequence[str]] = []
    for p in main_points(points):
        mine = [q for q in points if (q.method, q.threads) == (p.method, p.threads)]
        mine = [q for q in mine if not q.failure]
        times = (f"{ms:.2f}" for ms in (p.ms_median, p.ms_p99, p.cpu_ms_median))
        worst = (
            f"{sum(q.coverage_mismatch_px for q in mine)}",
            f"{max(q.max_grey_difference for q in mine):g}",
            f"{max(q.mean_grey_difference for q in mine):.2g}",
            f"{max(q.max_voxel_error for q in mine):.2g}",
        )
        rows.append((p.method, f"{p.threads}", *times, *worst))
    return markdown_table((*head, "wrong px", "max grey", "mean grey", "max voxel"), rows)


def write_report(folder: ReportFolder, points: Sequence[Point], around: Surroundings) -> None:
    """Draw the plots and write slice.md."""
    in_sizes = size_points(points)
    panels = {
        f"{size} × {size}": [p for p in in_sizes if p.size == size]
        for size in sorted({p.size for p in in_sizes})
    }
    if panels:
        plot_errors(panels, folder.picture("error"))
        title = f"{MAIN.size} × {MAIN.size}, pressed by 12 mm"
        plot_meshes(mesh_points(points), title, folder.picture("meshes"))
        plot_pixels(in_sizes, f"{_nodes()} nodes, pressed by 12 mm", folder.picture("pixels"))
    folder.write_report(_parts(folder, points, around), failures(points))


def _parts(folder: ReportFolder, points: Sequence[Point], around: Surroundings) -> list[str]:
    asked = targets(points, around.peak_memory, around.publishing)
    without_vtk = not any(p.method == "vtk" for p in points)
    views = "; ".join(f"`{name}`: {view.words}" for name, view in PLANES.items())
    return [
        "# Slices: error against run time",
        folder.opening("numpy", "scipy", "numba", "vtk"),
        "A block of 0.2 × 0.1 × 0.1 m in a volume of speckle (0.4 mm voxels, 5 mm of it around the "
        "block, which stays rigid) is dented by a smooth field, down and aside, by up to 30 mm. "
        "Every method cuts the same images of 60 × 80 mm in one run, in turns, while the probe "
        "trembles and the dent changes, so that no image repeats another. Each is held against "
        "brute force in float64 by NumPy and SciPy, which shares no arithmetic with any of them.",
        HOW_TO_GET + "." if without_vtk else "",
        "## What is asked",
        target_table(asked),
        "Times are of this run and this machine. Ratios are of methods that took turns on one "
        "thread, the lesser of those of wall clock and of processor time; what grows with nodes "
        "and pixels is processor time. Other programs on the machine lengthen the wall clock, "
        "that of slow methods most, so the plots and tables that compare cases have processor time "
        "(CPU ms), which is the wall clock of one thread on a machine that does nothing else.",
        "## Error against run time",
        "![Error against run time](slice_error.png)",
        table(points),
        f"Times are of {MAIN.size} × {MAIN.size} pixels on {_nodes()} nodes pressed by 12 mm, the "
        "errors the worst of all cases. VTK knows nothing of the rigid volume around the block: "
        "its errors count where tissue is. A voxel error is the distance between where a pixel's "
        "tissue lies at rest and where it was taken from, by the method's own account, and by its "
        "image (on one thread) of a volume of black and white voxels, which tells 0.002 voxels.",
        "![What is cut, and where pixels are taken from](slice_differences.png)",
        "## Images' sizes",
        "![Time against pixels](slice_pixels.png)",
        _across(size_points(points), "size", lambda p: p.size**2, lambda p: f"{p.size}²"),
        "## Meshes' sizes",
        "![Time against nodes](slice_meshes.png)",
        _across(mesh_points(points), "nodes", lambda p: p.nodes, lambda p: f"{p.nodes:,}"),
        "## Deformations and planes",
        f"Planes lie {views}. Times are processor time of one thread; wrong pixels are those whose "
        "coverage (tissue, rigid volume or nothing) is not the reference's.",
        _cases_table(points),
        *_vtk_apart(points),
        "## Probes and image formation",
        f"Whole images of {MAIN.size} × {MAIN.size} pixels by `scan_conversion` on one thread, on "
        f"{_nodes()} nodes pressed by 12 mm, in turns; contact includes finding where the "
        "face touches the skin.",
        markdown_table(
            ("probe", "CPU ms", "pixels in the image"),
            [(c.what, f"{c.ms:.2f}", f"{100 * c.shown:.0f} %") for c in around.probes],
        ),
        _settings_table(around.settings),
        *_recorded(around.recorded),
        "## How it was measured",
        "Wall clock of one call that returns the image, for the methods here and for VTK from the "
        "deformed nodes as an array to the image as an array. A turn has five images in a row of "
        "methods that take less than 8 ms, one of the others; medians and 99th percentiles are "
        "over all turns; images cut before them, which may compile, are not counted. Methods that "
        "take more than 150 ms sit turns out when the case's time is over. Coverage, grey values "
        "and rest coordinates are of one image a case. A pixel is at fault where the method finds "
        "nothing and the reference something, or the reverse, or where it takes tissue that moved "
        "by more than a hundredth of a voxel for the rigid volume, or the reverse. The memory is "
        "the peak of a process of its own; the message of an image goes to a subscriber in "
        "another process.",
    ]


def _across(points, what, across, word) -> str:  # type: ignore[no-untyped-def]
    """Processor times of every method along one axis, and the exponent."""
    steps = sorted({across(p): word(p) for p in points}.items())
    rows = []
    for method in dict.fromkeys(p.method for p in points):
        mine = [p for p in points if (p.method, p.threads) == (method, 1)]
        times = {across(p): p.cpu_ms_median for p in mine}
        cells = [f"{times[at]:.2f}" if at in times else "" for at, _ in steps]
        power = exponent(times)
        rows.append((method, *cells, f"{power:.2f}" if np.isfinite(power) else ""))
    words = [f"{what} {name}, CPU ms" for _, name in steps]
    return markdown_table(("method", *words, "exponent"), rows)


def _cases_table(points: Sequence[Point]) -> str:
    image = (1, int(np.prod(MAIN.counts)), MAIN.size)
    shown = [p for p in points if (p.threads, p.nodes, p.size) == image and not p.failure]
    methods = list(dict.fromkeys(p.method for p in shown))
    rows = []
    for deformation in DEPTHS:
        for plane in PLANES:
            mine = {p.method: p for p in shown if (p.deformation, p.plane) == (deformation, plane)}
            cells = [f"{mine[m].cpu_ms_median:.2f}" if m in mine else "" for m in methods]
            wrong = [f"{mine[m].coverage_mismatch_px}" if m in mine else "" for m in methods]
            if mine:
                rows.append((deformation, plane, *cells, *wrong))
    times, wrongs = [f"{m}, CPU ms" for m in methods], [f"{m}, wrong px" for m in methods]
    return markdown_table(("deformation", "plane", *times, *wrongs), rows)


def _vtk_apart(points: Sequence[Point]) -> list[str]:
    mine = [p for p in size_points(points) if p.method == "vtk" and p.threads == 1]
    if not mine:
        return []
    rows = [
        (f"{p.size}²", f"{p.filter_ms:.1f}", f"{p.sampling_ms:.1f}")
        for p in sorted(mine, key=lambda p: p.size)
    ]
    return [
        "## VTK's two parts",
        "`vtkProbeFilter` finds the pixels in the deformed `vtkUnstructuredGrid` and interpolates "
        "the rest coordinates of its nodes (filter); another samples the volume there (sampling). "
        "The mesh is in the image's own coordinates, for the filter ignores an image's "
        "direction. VTK's wheels use one thread unless told otherwise.",
        markdown_table(("size", "filter, CPU ms", "sampling, CPU ms"), rows),
    ]


def _nodes() -> str:
    return f"{np.prod(MAIN.counts):,}"


def _settings_table(settings: Sequence[Cost]) -> str:
    plain = settings[0].ms if settings else 0.0
    rows = [(c.what, f"{c.ms:.2f}", f"{c.ms - plain:+.2f}") for c in settings]
    return markdown_table(("imaging", "CPU ms", "more than at the defaults"), rows)


def _recorded(comparison: RecordedComparison | None) -> list[str]:
    if comparison is None:
        return []
    pictures = [f"![Recorded and cut]({f.name})" for f in comparison.files if f.suffix == ".png"]
    return ["## Recorded frames", comparison.markdown(), *pictures]
