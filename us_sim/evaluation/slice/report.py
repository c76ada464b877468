"""slice.md: what was asked and seen, the tables, the pictures, and how it was measured.

What is asked of the slices, against what was seen in one run.

Pictures of error against run time, and of run time against mesh and image size.

Pictures of what is cut, and of where each method goes wrong.

`us-sim evaluate slice`: how wrong each method's images are, against how long they take.

Every method cuts the same images of a block of speckle, in turns in one run; each is compared with
what it must show by brute force in float64 (`us_sim.evaluation.slice.cases`). VTK takes part
where it is installed.

What the evaluation knows of each slicing method: all of it stands here, one entry a method.

>>> from us_sim.evaluation.slice.report import SLICING_METHODS
>>> [name for name, method in SLICING_METHODS.items() if method.tissue_only]
['vtk']

The same images by VTK, as a user of VTK would make them, to compare with.

`vtkProbeFilter` finds the pixels in the deformed mesh, whose nodes carry their coordinates at
rest, and interpolates those; a second one samples the volume there. The mesh is passed to it in
columns, rows and heights over the image, since it ignores an image's direction matrix; that is
also its fast method, which goes through the cells instead of searching one for each pixel.

One point of error against run time: a method, a case, and what it got wrong.

>>> from us_sim.evaluation.slice.report import Point
>>> Point("per_pixel", 256, 2000, 7695, 1).title
'per_pixel on 256 px, 2000 nodes'

What each probe's geometry and each setting of image formation adds to the time of an image.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.lines import Line2D
from matplotlib.ticker import LogFormatterMathtext, NullFormatter
from numpy.typing import NDArray

from us_sim.evaluation.processes import peak_memory, publishing_ms
from us_sim.evaluation.report import (
    ReportFolder,
    Target,
    exponent,
    failures,
    key_beside,
    markdown_table,
    new_figure,
    plain,
    save,
    target_table,
    words_of,
)
from us_sim.evaluation.settings import RecordedSweep
from us_sim.evaluation.slice.cases import (
    DEPTHS,
    MAIN,
    PLANES,
    Case,
    ExactSlice,
    black_and_white,
    cases,
    exact_slice,
    sampled,
    speckle,
    voxel_distance,
)
from us_sim.evaluation.slice.measure import (
    HOW_TO_GET,
    OURS,
    SLICING_METHODS,
    Contender,
    Cost,
    Point,
    compare,
    contender,
    costs,
    is_installed,
    methods,
    timed_together,
    wrong_pixels,
)
from us_sim.evaluation.slice.recorded import RecordedComparison, compare_with_recorded
from us_sim.evaluation.timing import steps
from us_sim.progress import Progress
from us_sim.volume.volume import Volume


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


_FRAME = 1000.0 / 60.0  # ms, at 60 images a second
_TENTH = 0.1  # voxels
_SMALLEST = 1e-14  # voxels, drawn where a method is exact to the last bit


def plot_errors(panels: Mapping[str, Sequence[Point]], file: Path) -> None:
    """A panel each: the worst pixel's distance from its true place against ms an image."""
    title = "Error against run time (dotted: 60 images a second; dashed: a tenth of a voxel)"
    figure = new_figure(3.9 * len(panels) + 2.2, 4.4, title)
    axes = figure.subplots(1, len(panels), squeeze=False, sharex=True, sharey=True)[0]
    for panel, (title, points) in zip(axes, panels.items(), strict=True):
        for name, method in SLICING_METHODS.items():
            mine = [p for p in points if p.method == name and np.isfinite(p.ms_median)]
            mine.sort(key=lambda p: p.threads)
            x = [p.cpu_ms_median if p.threads == 1 else p.ms_median for p in mine]
            y = [max(p.max_voxel_error, _SMALLEST) for p in mine]
            panel.plot(x, y, "-", color=method.colour, lw=1.2, alpha=0.8)
            for at, error, point in zip(x, y, mine, strict=True):
                fill = method.colour if point.threads == 1 else "white"
                panel.plot(at, error, method.mark, mfc=fill, mec=method.colour, ms=8)
        panel.set_title(title, fontsize=11, loc="left")
        panel.set_xlabel("ms an image (median; one thread: processor time)", fontsize=9)
        panel.axvline(_FRAME, color="0.75", lw=1, ls=":", zorder=0)
        panel.set(xscale="log", yscale="log")
        panel.margins(0.08, 0.14)
        panel.axhline(_TENTH, color="0.75", lw=1, ls="--", zorder=0)
        plain(panel)
        panel.yaxis.set_major_formatter(LogFormatterMathtext())
    _keys(axes[-1], {p.method for points in panels.values() for p in points})
    axes[0].set_ylabel("worst pixel's error at rest, voxels")
    save(figure, file)


def plot_meshes(points: Sequence[Point], title: str, file: Path) -> None:
    """Processor time of an image against the mesh's nodes."""
    figure = new_figure(8.2, 5.0, title)
    panel = figure.subplots()
    _times(panel, points, lambda p: p.nodes)
    panel.set_xlabel("nodes of the mesh")
    panel.set_xticks(nodes := sorted({p.nodes for p in points}), [f"{n:,}" for n in nodes])
    panel.tick_params(labelsize=8)
    save(figure, file)


def plot_pixels(points: Sequence[Point], title: str, file: Path) -> None:
    """Processor time of an image against its pixels, with a line in proportion to them."""
    figure = new_figure(8.2, 5.0, title)
    panel = figure.subplots()
    _times(panel, points, lambda p: p.size**2)
    first = [p for p in points if p.method == OURS and p.threads == 1]
    if first:
        largest = max(first, key=lambda p: p.size)
        pixels = np.array([min(p.size for p in first), largest.size]) ** 2
        proportional = largest.cpu_ms_median * pixels / pixels[-1]
        panel.plot(pixels, proportional, "--", color="0.6", lw=1, zorder=0)
    sizes = sorted({p.size for p in points})
    panel.set_xticks([n**2 for n in sizes], [f"{n} × {n}" for n in sizes])
    panel.set_xlabel("pixels (dashed: in proportion)")
    save(figure, file)


def _times(panel: Axes, points: Sequence[Point], across: Callable[[Point], float]) -> None:
    for name, method in SLICING_METHODS.items():
        mine = [p for p in points if p.method == name and p.threads == 1]
        mine = sorted((p for p in mine if np.isfinite(p.cpu_ms_median)), key=across)
        x, y = [across(p) for p in mine], [p.cpu_ms_median for p in mine]
        panel.plot(x, y, method.mark + "-", color=method.colour, ms=6, lw=1.4)
    panel.set(xscale="log", yscale="log")
    panel.axhline(_FRAME, color="0.75", lw=1, ls=":", zorder=0)
    panel.set_ylabel("processor time of an image, ms (median, one thread)")
    plain(panel)
    panel.xaxis.set_minor_formatter(NullFormatter())
    _keys(panel, {p.method for p in points}, two_threads=False)


def _keys(panel: Axes, known: set[str], two_threads: bool = True) -> None:
    """What colours and marks mean, beside a panel."""
    keys = [
        Line2D([], [], color=method.colour, marker=method.mark, label=name)
        for name, method in SLICING_METHODS.items()
        if name in known
    ]
    if two_threads:
        words = "two threads, wall clock"
        keys.append(Line2D([], [], color="0.4", ls="", marker="o", mfc="white", label=words))
    key_beside(panel, keys)


SHOWN = (
    MAIN,
    replace(MAIN, deformation="pressed_30mm", plane="oblique"),
    replace(MAIN, deformation="pressed_30mm", plane="corner"),
)
"""The cases that the picture has, a row each."""
_LEAST, _MOST = 1e-13, 1e-2  # voxels, at the ends of the colours
_RIGHT = 1e-14  # voxels, drawn for what is exact to the last bit
_WRONG = "#00e5ff"


def draw_differences(volume: Volume, methods: Sequence[str], file: Path) -> None:
    """A row a case: the image, then for every method how far each pixel is from its true place."""
    columns = 1 + len(methods)
    figure = new_figure(
        2.7 * columns + 0.9,
        3.75 * len(SHOWN) + 0.5,
        "What is cut, and where each pixel's tissue is taken from (grey: nothing there; "
        "cyan: wrong coverage)",
    )
    axes = figure.subplots(len(SHOWN), columns, squeeze=False)
    norm = LogNorm(_LEAST, _MOST, clip=True)
    colours = None
    for panel, title in zip(axes[0], ("reference, float64", *methods), strict=True):
        panel.set_title(title, fontsize=10)
    for line, case in zip(axes, SHOWN, strict=True):
        mesh, frame = case.mesh(), case.frames(1)[0]
        exact = exact_slice(volume, mesh.nodes, mesh.tetrahedra, frame.nodes, frame.plane)
        line[0].imshow(np.rint(exact.grey), cmap="gray", vmin=0, vmax=255)
        line[0].set_ylabel(f"{case.deformation}\n{PLANES[case.plane].words}", fontsize=8)
        for panel, method in zip(line[1:], methods, strict=True):
            distance, wrong = _pixel_errors(volume, case, method, exact)
            shown = np.maximum(distance, _RIGHT)
            colours = panel.imshow(shown, norm=norm, cmap="magma", interpolation="nearest")
            row, column = np.nonzero(wrong)
            panel.plot(column, row, "s", ms=3, color=_WRONG, mec="none")
            worst = np.nanmax(distance, initial=0.0)
            panel.set_xlabel(f"worst {worst:.1e} voxels, {wrong.sum()} px wrong", fontsize=8)
        step, down = (np.linalg.norm(v) for v in (frame.plane.column_step, frame.plane.row_step))
        for panel in line:
            panel.set(aspect=down / step, xticks=[], yticks=[], facecolor="0.85")
    if colours is not None:
        bar = figure.colorbar(colours, ax=axes[:, 1:], shrink=0.6, pad=0.01)
        bar.set_label("distance from the true place at rest, voxels", fontsize=9)
    save(figure, file)


def _pixel_errors(
    volume: Volume, case: Case, method: str, exact: ExactSlice
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(rows, columns) voxels, NaN where nothing is compared; and where the coverage is wrong."""
    frame = case.frames(1)[0]
    rest = contender(volume, case, method, 1).rest_coordinates(frame)
    tissue_only = SLICING_METHODS[method].tissue_only
    right, wrong, expected = wrong_pixels(volume, frame, exact, rest, tissue_only)
    return np.where(right, voxel_distance(volume, rest, expected), np.nan), wrong


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
