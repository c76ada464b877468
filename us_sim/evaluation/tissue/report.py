"""tissue.md: the machine, the tables, the pictures, and which method is worth its time.

Pictures of error against run time, and of cost against size.

`us-sim evaluate tissue`: how wrong each method is, against how long it takes.

Every method follows the probe's path at its own pace, frame by frame; what it says at the path's
end is compared with its own equations solved without regard to time, and with large deformation on
fine quadratic elements (`us_sim.evaluation.tissue.reference`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, NullFormatter

from us_sim.evaluation.block import MESHES
from us_sim.evaluation.report import (
    ReportFolder,
    exponent,
    failures,
    key_beside,
    markdown_table,
    new_figure,
    plain,
    save,
)
from us_sim.evaluation.timing import steps
from us_sim.evaluation.tissue.cases import LOCKING, SCENES, Scene
from us_sim.evaluation.tissue.measure import (
    Point,
    _Bench,
    plan,
)
from us_sim.evaluation.tissue.reference import Reference, kept_reference
from us_sim.evaluation.tissue_methods import TISSUE_METHODS
from us_sim.progress import Progress

_PAPERS_FINEST = int(np.prod(MESHES[-1]))
_DEFAULTS = ("scene", "method", "nodes", "ms", "p99 ms", "L2 %", "max mm", "force %", "volume %")


def table(points: Sequence[Point]) -> str:
    """What the command prints: the defaults of every method against the nonlinear reference."""
    return markdown_table(_DEFAULTS, [_default_cells(p) for p in _defaults(points)])


def _defaults(points: Sequence[Point]) -> list[Point]:
    return [p for p in points if p.default and not p.own]


def pareto_front(points: Sequence[Point]) -> list[Point]:
    """Those points than which no other is both faster and more accurate, fastest first."""
    front: list[Point] = []
    finite = [p for p in points if np.isfinite(p.ms_median * p.rel_l2_error)]
    for point in sorted(finite, key=lambda p: (p.ms_median, p.rel_l2_error)):
        if not front or point.rel_l2_error < front[-1].rel_l2_error:
            front.append(point)
    return front


def write_report(
    folder: ReportFolder, points: Sequence[Point], references: dict[str, Reference]
) -> None:
    """Draw the pictures and write tissue.md.

    What can be shown of one mesh only is of the paper's finest, or else of the finest there is;
    what can be shown of one scene only is of the one that is pressed on the most meshes.
    """
    sizes = {p.nodes for p in points}
    nodes = _PAPERS_FINEST if _PAPERS_FINEST in sizes else max(sizes)
    meshes = {name: len({p.nodes for p in points if p.scene == name}) for name in references}
    scene = max(meshes, key=lambda name: meshes[name])
    nonlinear = [p for p in points if not p.own]
    by_size = [p for p in _defaults(points) if p.scene == scene]
    panels = {
        "error": (
            f"Error against run time, to large deformation on fine quadratic elements "
            f"({nodes:,} nodes)",
            _by_scene(nonlinear, references, nodes),
        ),
        "own_error": (
            f"Error against run time, to each method's own converged equations ({nodes:,} nodes)",
            _by_scene([p for p in points if p.own], references, nodes),
        ),
        "meshes": (
            f"Error against run time, by mesh, {SCENES[scene].words}",
            {
                f"{count:,} nodes": [p for p in nonlinear if (p.scene, p.nodes) == (scene, count)]
                for count in sorted({p.nodes for p in points if p.scene == scene})
            },
        ),
    }
    for name, (title, panel) in panels.items():
        some = {words: shown for words, shown in panel.items() if shown}
        plot_errors(some, title, folder.picture(name))
    plot_sizes(by_size, f"Cost against size, {SCENES[scene].words}", folder.picture("size"))
    folder.write_report(_parts(folder, points, references, by_size, scene, nodes), failures(points))


def _by_scene(
    points: Sequence[Point], references: dict[str, Reference], nodes: int
) -> dict[str, list[Point]]:
    """The points on one mesh, by scene, without those scenes in which tetrahedra lock."""
    return {
        name: [p for p in points if p.scene == name and p.nodes == nodes]
        for name in references
        if name not in LOCKING[1:]
    }


def _parts(
    folder: ReportFolder,
    points: Sequence[Point],
    references: dict[str, Reference],
    by_size: Sequence[Point],
    scene: str,
    nodes: int,
) -> list[str]:
    return [
        "# Tissue: error against run time",
        folder.opening("numpy", "scipy", "numba", "scikit-fem"),
        "A block of 0.2 × 0.1 × 0.1 m, held at its bottom, E = 10 kPa and ν = 0.45 unless a scene "
        "says otherwise, is pressed by a sphere of 30 mm radius that moves 2.5 mm a frame (in "
        "`tilt` by a capsule of 25 mm radius that turns 2.5° a frame). Times are of whole frames, "
        "wall clock, on one thread unless the column `threads` says more. Errors are of the last "
        "frame as it came out while the probe moved: L2 and maximum of all nodes' displacements, "
        "the force along the probe, and the block's volume over its volume at rest.",
        "## Against large deformation",
        "The reference is a stable neo-Hookean block of 27-node hexahedra, in each of which the "
        "pressure is linear, with contact over the whole surface, by scikit-fem; what it still "
        "changes from one mesh to the next finer is:",
        _reference_table(references),
        "![Error against run time](tissue_error.png)",
        "Full marks are defaults; lines join a method's settings that solve the same equations; "
        "the dotted line is 30 frames a second.",
        _table_of_defaults(points),
        "### The Pareto front",
        f"Methods than which no other was both faster and more accurate, on {nodes:,} nodes:",
        *(_front(points, name, nodes) for name in references if name not in LOCKING[1:]),
        "![Error against run time on several meshes](tissue_meshes.png)",
        "## Against each method's own equations",
        "The same mesh and method with as many iterations as it takes (`fem` against an "
        "independent assembly by scikit-fem, solved by SciPy). This is what the hurry of a frame "
        "costs; what is left in the picture above is the mesh and the model.",
        "![Error to own equations](tissue_own_error.png)",
        _own_table(points, scene, nodes),
        *_locking(points),
        "## Cost against size",
        "Memory is that of the arrays that a solver holds when it is ready, those of its mesh "
        "included. Set-up is the time to make the solver, which may read its precomputed part from "
        "the cache.",
        "![Cost against size](tissue_size.png)",
        _size_table(by_size),
    ]


def _locking(points: Sequence[Point]) -> list[str]:
    """How the reaction grows as tissue becomes incompressible; nothing without those scenes."""
    found = {(p.scene, p.method): p for p in _defaults(points) if not p.failure}
    finest = {key: p for key, p in found.items() if p.nodes == _PAPERS_FINEST}
    ratios = [name for name in LOCKING if any(scene == name for scene, _ in finest)]
    if len(ratios) < 2:
        return []
    head = ["method", *(f"ν = {SCENES[name].poisson_ratio}" for name in ratios)]
    errors = {key: f"{100 * p.force_error:.2g} %" for key, p in finest.items()}
    methods = dict.fromkeys(method for _, method in finest)
    rows = [[method, *(errors.get((name, method), "") for name in ratios)] for method in methods]
    return [
        "## Locking",
        f"Error of the reaction to a press of 12 mm on {_PAPERS_FINEST:,} nodes, while the probe "
        "moves, as the tissue becomes incompressible:",
        markdown_table(head, rows),
    ]


def _reference_table(references: dict[str, Reference]) -> str:
    head = ("scene", "elements", "unknowns", "force N", "L2 change", "force change")
    rows = [
        (
            name,
            f"{r.coarser * 1e3:g} → {r.size * 1e3:g} mm",
            f"{r.unknowns:,}",
            f"{-r.solution.force[2]:.3f}",
            f"{100 * r.difference:.2f} %",
            f"{100 * r.force_difference:.2f} %",
            f"{r.solution.penetration * 1e3:.3f}",
        )
        for name, r in references.items()
    ]
    return markdown_table((*head, "penetration mm"), rows)


def _table_of_defaults(points: Sequence[Point]) -> str:
    rows = [(*_default_cells(p), _number(p.smallest_volume_ratio)) for p in _defaults(points)]
    return markdown_table((*_DEFAULTS, "smallest volume ratio"), rows)


def _default_cells(p: Point) -> tuple[str, ...]:
    """The cells of the columns `_DEFAULTS`."""
    errors = (100 * p.rel_l2_error, p.max_error_mm, 100 * p.force_error, 100 * p.volume_error)
    numbers = (p.ms_median, p.ms_p99, *errors)
    return (p.scene, p.method, f"{p.nodes:,}", *(_number(value) for value in numbers))


def _own_table(points: Sequence[Point], scene: str, nodes: int) -> str:
    rows = []
    for p in (p for p in points if p.own and (p.scene, p.nodes) == (scene, nodes)):
        numbers = (p.ms_median, 100 * p.rel_l2_error, p.max_error_mm, 100 * p.force_error)
        rows.append((p.method, p.setting, f"{p.threads}", *map(_number, numbers), p.reference))
    head = ("method", "setting", "threads", "ms", "L2 %", "max mm", "force %", "reference")
    return markdown_table(head, rows)


def _size_table(sizes: Sequence[Point]) -> str:
    counts = sorted({p.nodes for p in sizes})
    rows = []
    for method in dict.fromkeys(p.method for p in sizes):
        mine = {p.nodes: p for p in sizes if p.method == method}
        for what, value in (
            ("ms a frame", lambda p: p.ms_median),
            ("MB held", lambda p: p.memory / 1e6),
            ("s to set up", lambda p: p.setup),
        ):
            costs: dict[float, float] = {n: value(p) for n, p in mine.items()}
            numbers = [_number(costs[n]) if n in costs else "" for n in counts]
            rows.append((method, what, *numbers, _number(exponent(costs))))
    return markdown_table(("method", "cost", *(f"{n:,} nodes" for n in counts), "exponent"), rows)


def _front(points: Sequence[Point], scene: str, nodes: int) -> str:
    front = pareto_front([p for p in points if p.scene == scene and p.nodes == nodes and not p.own])
    steps = [
        f"`{p.method}` ({p.setting}) leaves {100 * p.rel_l2_error:.2g} % in {p.ms_median:.3g} ms"
        for p in front
    ]
    return f"- **{scene}** ({SCENES[scene].words}): {'; '.join(steps) or 'nothing was measured'}."


def _number(value: float) -> str:
    return f"{value:.3g}" if np.isfinite(value) else "failed"


_LINES = ("-", "--", "-.", ":")  # of a method's settings that solve the same equations
_FRAME = 1000.0 / 30.0  # ms, at the paper's 30 frames a second


def plot_errors(panels: Mapping[str, Sequence[Point]], title: str, file: Path) -> None:
    """A panel each: relative error against ms a frame, both logarithmic.

    Full marks are defaults; a line joins a method's settings that solve the same equations.
    """
    columns = min(3, len(panels))
    rows = -(-len(panels) // columns)
    figure = new_figure(4.6 * columns + 0.4, 4.0 * rows + 0.7, title)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True)
    for number, (name, points) in enumerate(panels.items()):
        panel = axes[divmod(number, columns)]
        _errors(panel, [p for p in points if np.isfinite(p.ms_median * p.rel_l2_error)])
        panel.set_title(name, fontsize=11, loc="left")
    for panel in axes.flat[len(panels) :]:
        panel.set_visible(False)
    for panel in axes[:, 0]:
        panel.set_ylabel("relative L2 error of the nodes")
    for column in range(columns):
        lowest = max(row for row in range(rows) if axes[row, column].get_visible())
        axes[lowest, column].set_xlabel("ms a frame (median)")
        axes[lowest, column].tick_params(labelbottom=True)
    keys: dict[str, Any] = {}
    for panel in axes.flat:
        handles, labels = panel.get_legend_handles_labels()
        keys |= dict(zip(labels, handles, strict=True))
    figure.legend(keys.values(), keys, loc="outside right upper", fontsize=8, frameon=False)
    save(figure, file)


def plot_sizes(points: Sequence[Point], title: str, file: Path) -> None:
    """Time a frame, and memory, against the number of nodes; with the fitted exponents."""
    figure = new_figure(11.0, 4.8, title)
    time_panel, memory_panel = figure.subplots(1, 2)
    for panel, value, label in (
        (time_panel, lambda p: p.ms_median, "ms a frame (median)"),
        (memory_panel, lambda p: p.memory / 1e6, "MB held"),
    ):
        _sizes(panel, points, value)
        panel.set(xlabel="nodes", ylabel=label)
    time_panel.axhline(_FRAME, color="0.75", lw=1, ls=":", zorder=0)
    save(figure, file)


def _errors(axes: Axes, points: Sequence[Point]) -> None:
    for name, method in TISSUE_METHODS.items():
        families: dict[str, list[Point]] = {}
        for point in sorted(points, key=lambda p: p.ms_median):
            if point.method == name:
                families.setdefault(method.family(point.setting), []).append(point)
        for number, (family, chain) in enumerate(sorted(families.items())):
            x, y = [p.ms_median for p in chain], [p.rel_l2_error for p in chain]
            look: Any = {"color": method.colour, "label": f"{name}, {family}" if family else name}
            axes.plot(x, y, _LINES[number] + method.mark, mfc="white", ms=5, lw=1.2, **look)
            for p in (p for p in chain if p.default):
                axes.plot(p.ms_median, p.rel_l2_error, method.mark, color=method.colour, ms=7)
    axes.set(xscale="log", yscale="log")
    axes.axvline(_FRAME, color="0.75", lw=1, ls=":", zorder=0)
    plain(axes)
    axes.yaxis.set_major_formatter(FuncFormatter(_percent))
    axes.margins(0.12)


def _sizes(axes: Axes, points: Sequence[Point], value: Callable[[Point], float]) -> None:
    for name, method in TISSUE_METHODS.items():
        mine = sorted((p for p in points if p.method == name), key=lambda p: p.nodes)
        mine = [p for p in mine if np.isfinite(value(p)) and value(p) > 0]
        if not mine:
            continue
        costs: dict[float, float] = {p.nodes: value(p) for p in mine}
        power = exponent(costs)
        label = name + (f"  ~ n$^{{{power:.2f}}}$" if np.isfinite(power) else "")
        look: Any = {"color": method.colour, "label": label}
        axes.plot(list(costs), list(costs.values()), method.mark + "-", ms=6, lw=1.4, **look)
    axes.set(xscale="log", yscale="log")
    plain(axes)
    sizes = sorted({p.nodes for p in points})
    axes.set_xticks(sizes, [f"{n:,}" for n in sizes])
    axes.tick_params(labelsize=7.5)
    axes.xaxis.set_minor_formatter(NullFormatter())
    key_beside(axes)


def _percent(value: float, _: int) -> str:
    if value >= 1e-5:
        return f"{100 * value:g} %"
    return f"$10^{{{np.log10(100 * value):.0f}}}$ %"


_SIZES, _QUICK_SIZES = (0.01, 0.0065, 0.005), (0.01, 0.0065)  # m, of the reference's elements


def evaluate_tissue(out: Path, quick: bool) -> int:
    """Write tissue.csv, the plots and tissue.md, as `us_sim.evaluation` says.

    A quick run has fewer scenes, meshes and settings, and a coarser reference. It raises UsSimError
    too where no reference can be computed.
    """
    folder = ReportFolder("tissue", out, quick)
    trials = plan(quick)
    references = _references({trial.scene.name: trial.scene for trial in trials}.values(), quick)
    bench = _Bench(references)
    points = [
        point
        for trial in steps("errors and times", trials, "points")
        for point in bench.points(trial)
    ]
    folder.write_rows("tissue", points)
    write_report(folder, points, references)
    return folder.finish(table(points), failures(points))


def _references(scenes: Iterable[Scene], quick: bool) -> dict[str, Reference]:
    scenes, found = list(scenes), {}
    with Progress("nonlinear reference", len(scenes), "scenes") as progress:
        for done, scene in enumerate(scenes):

            def tell(fraction: float, text: str, done: int = done, name: str = scene.name) -> None:
                progress.update(done + fraction, f"{name}: {text}")

            tell(0.0, "")
            coarse = quick or scene.name in LOCKING[1:]
            found[scene.name] = kept_reference(scene, _QUICK_SIZES if coarse else _SIZES, tell)
        progress.update(len(scenes))
    return found
