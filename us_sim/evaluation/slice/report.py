"""`us-sim evaluate slice`: slice.csv, its pictures, and slice.md."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.lines import Line2D
from matplotlib.ticker import LogFormatterMathtext, NullFormatter

from us_sim.evaluation.processes import peak_memory, publishing_ms
from us_sim.evaluation.report import (
    ReportFolder,
    Target,
    exponent,
    failures,
    filled,
    key_beside,
    markdown_table,
    method_keys,
    number,
    picture,
    plain,
    target_table,
)
from us_sim.evaluation.settings import RecordedSweep
from us_sim.evaluation.slice.cases import DEPTHS, MAIN, PLANES, cases, exact_slice, voxel_distance
from us_sim.evaluation.slice.measure import (
    HOW_TO_GET,
    OURS,
    SLICING_METHODS,
    Bench,
    Point,
    costs,
    is_installed,
    methods,
    slicer_of,
    wrong_pixels,
)
from us_sim.evaluation.slice.recorded import RecordedComparison, compare_with_recorded
from us_sim.evaluation.timing import steps
from us_sim.progress import Progress
from us_sim.volume.volume import Volume

SHOWN = (
    MAIN,
    replace(MAIN, deformation="pressed_30mm", plane="oblique"),
    replace(MAIN, deformation="pressed_30mm", plane="corner"),
)
"""The cases of the picture of differences, a row each."""

_LARGE_VOLUME = 512  # voxels a side, of the volume whose memory is asked for
_QUICK_SECONDS = (5.0, 1.0)  # s, of timing the main case, and another
_FRAME = 1000.0 / 60.0  # ms, at 60 images a second


def evaluate_slice(out: Path, quick: bool, recorded: RecordedSweep | None = None) -> int:
    """Write slice.csv, the pictures and slice.md, as `us_sim.evaluation` says.

    A quick run has fewer cases, timed more shortly. The frames of a recorded sweep are compared
    with images of its volume, if there is one.
    """
    folder = ReportFolder("slice", out, quick)
    comparison = _compared(recorded, out, quick)
    bench = Bench(_QUICK_SECONDS if quick else (12.0, 2.0))
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
        _draw_differences(bench.volume, working, folder.picture("differences"))
        progress.update(1, "probes and image formation")
        probes, settings, shown = costs(bench.volume, quick)
        progress.update(2, "publishing")
        publishing = publishing_ms(MAIN.size)
        progress.update(3, "memory")
        memory = peak_memory(_LARGE_VOLUME)
        progress.update(4)
    table = _table(points)
    _plot(folder, points)
    probe_rows = [(name, f"{ms:.2f}", f"{100 * shown[name]:.0f} %") for name, ms in probes.items()]
    default = next(iter(settings.values()), 0.0)
    setting_rows = [(name, f"{ms:.2f}", f"{ms - default:+.2f}") for name, ms in settings.items()]
    if not is_installed():
        print(HOW_TO_GET)
    return folder.finish(
        table,
        failures(points),
        ("numpy", "scipy", "numba", "vtk"),
        without_vtk="" if any(p.method == "vtk" for p in points) else HOW_TO_GET + ".",
        targets=target_table(targets(points, memory, publishing)),
        table=table,
        size=f"{MAIN.size}",
        nodes=f"{np.prod(MAIN.counts):,}",
        by_size=_across(_size_points(points), "size", lambda p: p.size**2, lambda p: f"{p.size}²"),
        by_mesh=_across(_mesh_points(points), "nodes", lambda p: p.nodes, lambda p: f"{p.nodes:,}"),
        planes="; ".join(f"`{name}`: {view.words}" for name, view in PLANES.items()),
        by_case=_by_case(points),
        vtk=_vtk(points),
        probes=markdown_table(("probe", "CPU ms", "pixels in the image"), probe_rows),
        settings=markdown_table(("imaging", "CPU ms", "more than at the defaults"), setting_rows),
        recorded=comparison.markdown() if comparison else "",
    )


def _compared(recorded: RecordedSweep | None, out: Path, quick: bool) -> RecordedComparison | None:
    if recorded is None or recorded.volume is None or recorded.sweep is None:
        return None
    with Progress("recorded frames", 1, "sweep") as progress:
        progress.update(0, recorded.sweep.name)
        found = compare_with_recorded(recorded.volume, recorded.sweep, out, quick)
        progress.update(1)
    return found


def _of_main_image(points: Sequence[Point]) -> list[Point]:
    image = (MAIN.deformation, MAIN.plane)
    return [p for p in points if (p.deformation, p.plane) == image and not p.failure]


def _mesh_points(points: Sequence[Point]) -> list[Point]:
    """The same image on every mesh."""
    return [p for p in _of_main_image(points) if p.size == MAIN.size]


def _size_points(points: Sequence[Point]) -> list[Point]:
    """The same image in every size."""
    return [p for p in _of_main_image(points) if p.nodes == np.prod(MAIN.counts)]


def _main_points(points: Sequence[Point]) -> list[Point]:
    """Those of the case by which methods are compared."""
    return [p for p in _mesh_points(points) if p.nodes == np.prod(MAIN.counts)]


def targets(
    points: Sequence[Point], peak_memory: int | None, publishing: float | None
) -> list[Target]:
    """Limits against the measured numbers.

    Args:
        points: all rows.
        peak_memory: bytes of the process that cut the large volume, where known.
        publishing: ms of sending an image, where known.
    """
    main = {(p.method, p.threads): p for p in _main_points(points)}
    wall = {threads: p.ms_median for (method, threads), p in main.items() if method == OURS}
    own = [p for p in points if p.method == OURS and not p.failure]
    meshes = [p for p in _mesh_points(points) if p.method == OURS and p.threads == 1]
    sizes = [p for p in _size_points(points) if p.method == OURS and p.threads == 1]
    tetrahedra = "".join(f"{tets:,}" for tets in {p.tets for p in main.values()})
    image = f"{MAIN.size} × {MAIN.size} on {tetrahedra} tetrahedra pressed 12 mm"
    mismatches = sum(p.coverage_mismatch_px for p in own if p.threads == 1) if own else np.nan
    pixels = sum(p.size**2 for p in own if p.threads == 1)
    grey = max((p.max_grey_difference for p in own), default=np.nan)
    times = {p.nodes: p.cpu_ms_median for p in meshes}
    growth = times[max(times)] / times[min(times)] if len(times) > 1 else np.nan
    linear = exponent({p.size**2: p.cpu_ms_median for p in sizes})
    beyond = np.nan if peak_memory is None else (peak_memory - _LARGE_VOLUME**3) / 1e6
    memory = (
        f"memory beyond the volume's own, {_LARGE_VOLUME}³ voxels, Python and libraries included"
    )
    sending = f"making and publishing the message of an image, {MAIN.size} × {MAIN.size} at 60 Hz"
    sent = np.nan if publishing is None else publishing
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
        Target.at_most(memory, 300, beyond, "MB", form=".0f"),
        Target.at_most(sending, 1.0, sent, "ms", form=".2f"),
    ]


def _ratio(what: str, asked: float, main: dict[tuple[str, int], Point], slow: str) -> Target:
    """The lesser of the ratios of wall clock and processor time, both methods on one thread."""
    if not {(slow, 1), (OURS, 1)} <= main.keys():
        return Target.at_least(what, asked, np.nan)
    other, own = main[slow, 1], main[OURS, 1]
    seen = min(other.ms_median / own.ms_median, other.cpu_ms_median / own.cpu_ms_median)
    return Target.at_least(what, asked, seen, form=".1f")


def _table(points: Sequence[Point]) -> str:
    """Every method in the main case, and its worst in all of them."""
    head = ("method", "threads", "ms", "p99", "CPU ms")
    rows: list[Sequence[str]] = []
    for p in _main_points(points):
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


def _across(points, what, across, word) -> str:  # type: ignore[no-untyped-def]
    """Processor times of every method along one axis, and the exponent."""
    steps = sorted({across(p): word(p) for p in points}.items())
    rows = []
    for method in dict.fromkeys(p.method for p in points):
        mine = [p for p in points if (p.method, p.threads) == (method, 1)]
        times = {across(p): p.cpu_ms_median for p in mine}
        cells = [f"{times[at]:.2f}" if at in times else "" for at, _ in steps]
        rows.append((method, *cells, number(exponent(times), ".2f")))
    words = [f"{what} {name}, CPU ms" for _, name in steps]
    return markdown_table(("method", *words, "exponent"), rows)


def _by_case(points: Sequence[Point]) -> str:
    image = (1, int(np.prod(MAIN.counts)), MAIN.size)
    shown = [p for p in points if (p.threads, p.nodes, p.size) == image and not p.failure]
    names = list(dict.fromkeys(p.method for p in shown))
    rows = []
    for deformation in DEPTHS:
        for plane in PLANES:
            mine = {p.method: p for p in shown if (p.deformation, p.plane) == (deformation, plane)}
            cells = [f"{mine[m].cpu_ms_median:.2f}" if m in mine else "" for m in names]
            wrong = [f"{mine[m].coverage_mismatch_px}" if m in mine else "" for m in names]
            if mine:
                rows.append((deformation, plane, *cells, *wrong))
    times, wrongs = [f"{m}, CPU ms" for m in names], [f"{m}, wrong px" for m in names]
    return markdown_table(("deformation", "plane", *times, *wrongs), rows)


def _vtk(points: Sequence[Point]) -> str:
    mine = [p for p in _size_points(points) if p.method == "vtk" and p.threads == 1]
    if not mine:
        return ""
    mine.sort(key=lambda p: p.size)
    rows = [(f"{p.size}²", f"{p.filter_ms:.1f}", f"{p.sampling_ms:.1f}") for p in mine]
    table = markdown_table(("size", "filter, CPU ms", "sampling, CPU ms"), rows)
    return filled("slice", "vtk", table=table)


def _plot(folder: ReportFolder, points: Sequence[Point]) -> None:
    in_sizes = _size_points(points)
    panels = {
        f"{size} × {size}": [p for p in in_sizes if p.size == size]
        for size in sorted({p.size for p in in_sizes})
    }
    if not panels:
        return
    _plot_errors(panels, folder.picture("error"))
    meshes = _mesh_points(points)
    title = f"{MAIN.size} × {MAIN.size}, pressed by 12 mm"
    with picture(folder.picture("meshes"), 8.2, 5.0, title) as figure:
        panel = figure.subplots()
        _times(panel, meshes, lambda p: p.nodes)
        panel.set_xlabel("nodes of the mesh")
        panel.set_xticks(nodes := sorted({p.nodes for p in meshes}), [f"{n:,}" for n in nodes])
        panel.tick_params(labelsize=8)
    title = f"{np.prod(MAIN.counts):,} nodes, pressed by 12 mm"
    with picture(folder.picture("pixels"), 8.2, 5.0, title) as figure:
        panel = figure.subplots()
        _times(panel, in_sizes, lambda p: p.size**2)
        first = [p for p in in_sizes if p.method == OURS and p.threads == 1]
        if first:
            largest = max(first, key=lambda p: p.size)
            pixels = np.array([min(p.size for p in first), largest.size]) ** 2
            proportional = largest.cpu_ms_median * pixels / pixels[-1]
            panel.plot(pixels, proportional, "--", color="0.6", lw=1, zorder=0)
        sizes = sorted({p.size for p in in_sizes})
        panel.set_xticks([n**2 for n in sizes], [f"{n} × {n}" for n in sizes])
        panel.set_xlabel("pixels (dashed: in proportion)")


def _plot_errors(panels: Mapping[str, Sequence[Point]], file: Path) -> None:
    """A panel each: the worst pixel's distance from its true place against ms an image."""
    title = "Error against run time (dotted: 60 images a second; dashed: a tenth of a voxel)"
    with picture(file, 3.9 * len(panels) + 2.2, 4.4, title) as figure:
        axes = figure.subplots(1, len(panels), squeeze=False, sharex=True, sharey=True)[0]
        for panel, (name_of_panel, points) in zip(axes, panels.items(), strict=True):
            for name, method in SLICING_METHODS.items():
                mine = [p for p in points if p.method == name and np.isfinite(p.ms_median)]
                mine.sort(key=lambda p: p.threads)
                x = [p.cpu_ms_median if p.threads == 1 else p.ms_median for p in mine]
                y = [max(p.max_voxel_error, 1e-14) for p in mine]  # exact to the last bit
                panel.plot(x, y, "-", color=method.colour, lw=1.2, alpha=0.8)
                for at, error, point in zip(x, y, mine, strict=True):
                    fill = method.colour if point.threads == 1 else "white"
                    panel.plot(at, error, method.mark, mfc=fill, mec=method.colour, ms=8)
            panel.set_title(name_of_panel, fontsize=11, loc="left")
            panel.set_xlabel("ms an image (median; one thread: processor time)", fontsize=9)
            panel.axvline(_FRAME, color="0.75", lw=1, ls=":", zorder=0)
            panel.set(xscale="log", yscale="log")
            panel.margins(0.08, 0.14)
            panel.axhline(0.1, color="0.75", lw=1, ls="--", zorder=0)
            plain(panel)
            panel.yaxis.set_major_formatter(LogFormatterMathtext())
        _keys(axes[-1], {p.method for points in panels.values() for p in points})
        axes[0].set_ylabel("worst pixel's error at rest, voxels")


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
    keys = method_keys({name: SLICING_METHODS[name] for name in SLICING_METHODS if name in known})
    if two_threads:
        words = "two threads, wall clock"
        keys.append(Line2D([], [], color="0.4", ls="", marker="o", mfc="white", label=words))
    key_beside(panel, keys)


def _draw_differences(volume: Volume, names: Sequence[str], file: Path) -> None:
    """A row a case: the image, then for every method how far each pixel is from its true place."""
    columns = 1 + len(names)
    title = (
        "What is cut, and where each pixel's tissue is taken from (grey: nothing there; "
        "cyan: wrong coverage)"
    )
    with picture(file, 2.7 * columns + 0.9, 3.75 * len(SHOWN) + 0.5, title) as figure:
        axes = figure.subplots(len(SHOWN), columns, squeeze=False)
        norm, colours = LogNorm(1e-13, 1e-2, clip=True), None
        for panel, name in zip(axes[0], ("reference, float64", *names), strict=True):
            panel.set_title(name, fontsize=10)
        for line, case in zip(axes, SHOWN, strict=True):
            mesh, frame = case.mesh(), case.frames(1)[0]
            exact = exact_slice(volume, mesh.nodes, mesh.tetrahedra, frame.nodes, frame.plane)
            line[0].imshow(np.rint(exact.grey), cmap="gray", vmin=0, vmax=255)
            line[0].set_ylabel(f"{case.deformation}\n{PLANES[case.plane].words}", fontsize=8)
            for panel, name in zip(line[1:], names, strict=True):
                slicer = slicer_of(name, 1, volume, mesh)
                rest = slicer.rest_coordinates(frame.nodes, frame.plane)
                tissue_only = SLICING_METHODS[name].tissue_only
                right, wrong, expected = wrong_pixels(volume, frame, exact, rest, tissue_only)
                distance = np.where(right, voxel_distance(volume, rest, expected), np.nan)
                shown = np.maximum(distance, 1e-14)  # what is exact to the last bit
                colours = panel.imshow(shown, norm=norm, cmap="magma", interpolation="nearest")
                row, column = np.nonzero(wrong)
                panel.plot(column, row, "s", ms=3, color="#00e5ff", mec="none")
                worst = np.nanmax(distance, initial=0.0)
                panel.set_xlabel(f"worst {worst:.1e} voxels, {wrong.sum()} px wrong", fontsize=8)
            steps = (frame.plane.column_step, frame.plane.row_step)
            across, down = (np.linalg.norm(step) for step in steps)
            for panel in line:
                panel.set(aspect=down / across, xticks=[], yticks=[], facecolor="0.85")
        if colours is not None:
            bar = figure.colorbar(colours, ax=axes[:, 1:], shrink=0.6, pad=0.01)
            bar.set_label("distance from the true place at rest, voxels", fontsize=9)
