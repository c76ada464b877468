"""`us-sim evaluate tissue`: tissue.csv, its pictures, and tissue.md."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, NullFormatter

from us_sim.evaluation.block import MESHES
from us_sim.evaluation.report import (
    ReportFolder,
    exponent,
    failures,
    filled,
    key_beside,
    markdown_table,
    number,
    panel_grid,
    picture,
    plain,
)
from us_sim.evaluation.timing import steps
from us_sim.evaluation.tissue.cases import LOCKING, SCENES, Scene
from us_sim.evaluation.tissue.measure import Bench, Point, plan
from us_sim.evaluation.tissue.reference import Reference, kept_reference
from us_sim.evaluation.tissue_methods import TISSUE_METHODS
from us_sim.progress import Progress

_PAPERS_FINEST = int(np.prod(MESHES[-1]))
_FRAME = 1000.0 / 30.0  # ms, at the paper's 30 frames a second
_AT_FRAME_RATE: Any = {"color": "0.75", "lw": 1, "ls": ":", "zorder": 0}
_SIZES, _QUICK_SIZES = (0.01, 0.0065, 0.005), (0.01, 0.0065)  # m, of the reference's elements
_DEFAULTS = ("scene", "method", "nodes", "ms", "p99 ms", "L2 %", "max mm", "force %", "volume %")


def evaluate_tissue(out: Path, quick: bool) -> int:
    """Write tissue.csv, the plots and tissue.md, as `us_sim.evaluation` says.

    A quick run has fewer scenes, meshes and settings, and a coarser reference.

    Raises:
        UsSimError: the folder cannot be used, or no reference can be computed.
    """
    folder = ReportFolder("tissue", out, quick)
    trials = plan(quick)
    references = _references({trial.scene.name: trial.scene for trial in trials}.values(), quick)
    bench = Bench(references)
    points = [p for trial in steps("errors and times", trials, "points") for p in bench.run(trial)]
    folder.write_rows("tissue", points)
    return _report(folder, points, references)


def pareto_front(points: Sequence[Point]) -> list[Point]:
    """Points than which no other is both faster and more accurate, fastest first."""
    front: list[Point] = []
    finite = [p for p in points if np.isfinite(p.ms_median * p.rel_l2_error)]
    for point in sorted(finite, key=lambda p: (p.ms_median, p.rel_l2_error)):
        if not front or point.rel_l2_error < front[-1].rel_l2_error:
            front.append(point)
    return front


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


def _report(folder: ReportFolder, points: Sequence[Point], references: dict[str, Reference]) -> int:
    """Pictures and tissue.md.

    Results on one mesh are those on the paper's finest, or else on the finest there is; those of
    one scene are of the one that is pressed on the most meshes.
    """
    sizes = {p.nodes for p in points}
    nodes = _PAPERS_FINEST if _PAPERS_FINEST in sizes else max(sizes)
    meshes = {name: len({p.nodes for p in points if p.scene == name}) for name in references}
    scene = max(meshes, key=lambda name: meshes[name])
    nonlinear, own = [p for p in points if not p.own], [p for p in points if p.own]
    by_size = [p for p in _defaults(points) if p.scene == scene]
    scenes = [name for name in references if name not in LOCKING[1:]]

    def by_scene(some: Sequence[Point]) -> dict[str, list[Point]]:
        return {name: [p for p in some if (p.scene, p.nodes) == (name, nodes)] for name in scenes}

    by_mesh = {
        f"{count:,} nodes": [p for p in nonlinear if (p.scene, p.nodes) == (scene, count)]
        for count in sorted({p.nodes for p in points if p.scene == scene})
    }
    against = "Error against run time"
    fine = "large deformation on fine quadratic elements"
    for name, title, panels in (
        ("error", f"{against}, to {fine} ({nodes:,} nodes)", by_scene(nonlinear)),
        (
            "own_error",
            f"{against}, to each method's own converged equations ({nodes:,} nodes)",
            by_scene(own),
        ),
        ("meshes", f"{against}, by mesh, {SCENES[scene].words}", by_mesh),
    ):
        _plot_errors({k: v for k, v in panels.items() if v}, title, folder.picture(name))
    _plot_sizes(by_size, f"Cost against size, {SCENES[scene].words}", folder.picture("size"))
    defaults = [(*_default_cells(p), _number(p.smallest_volume_ratio)) for p in _defaults(points)]
    return folder.finish(
        markdown_table(_DEFAULTS, [_default_cells(p) for p in _defaults(points)]),
        failures(points),
        ("numpy", "scipy", "numba", "scikit-fem"),
        references=_reference_table(references),
        defaults=markdown_table((*_DEFAULTS, "smallest volume ratio"), defaults),
        nodes=f"{nodes:,}",
        fronts="\n\n".join(
            _front(name, [p for p in nonlinear if (p.scene, p.nodes) == (name, nodes)])
            for name in scenes
        ),
        own=_own_table([p for p in own if (p.scene, p.nodes) == (scene, nodes)]),
        locking=_locking(points),
        estimates=_estimates(points),
        sizes=_size_table(by_size),
    )


def _plot_errors(panels: dict[str, list[Point]], title: str, file: Path) -> None:
    """A panel each: relative error against ms a frame, both logarithmic.

    Full marks are defaults; a line joins a method's settings that solve the same equations.
    """
    columns, rows = min(3, len(panels)), -(-len(panels) // 3)
    labels = ("ms a frame (median)", "relative L2 error of the nodes")
    with picture(file, 4.6 * columns + 0.4, 4.0 * rows + 0.7, title) as figure:
        keys: dict[str, Any] = {}
        for axes, points in zip(panel_grid(figure, panels, *labels), panels.values(), strict=True):
            _draw_errors(axes, [p for p in points if np.isfinite(p.ms_median * p.rel_l2_error)])
            handles, names = axes.get_legend_handles_labels()
            keys |= dict(zip(names, handles, strict=True))
        keys["filled: its defaults"] = Line2D([], [], color="0.3", marker="o", ms=7, ls="")
        keys["30 frames a second"] = Line2D([], [], **_AT_FRAME_RATE)
        look: Any = {"loc": "outside right upper", "fontsize": 8, "frameon": False}
        figure.legend(keys.values(), keys, handlelength=4.5, **look)  # a dash and a dot are seen


def _draw_errors(axes: Axes, points: Sequence[Point]) -> None:
    for name, method in TISSUE_METHODS.items():
        families: dict[str, list[Point]] = {}
        for point in sorted(points, key=lambda p: p.ms_median):
            if point.method == name:
                families.setdefault(method.family(point.setting), []).append(point)
        for line, (family, chain) in zip(
            ("-", "--", "-.", ":"), sorted(families.items()), strict=False
        ):
            x, y = [p.ms_median for p in chain], [p.rel_l2_error for p in chain]
            look: Any = {"color": method.colour, "label": f"{name}, {family}" if family else name}
            axes.plot(x, y, line + method.mark, mfc="white", ms=5, lw=1.2, **look)
            for p in (p for p in chain if p.default):
                axes.plot(p.ms_median, p.rel_l2_error, method.mark, color=method.colour, ms=7)
    axes.set(xscale="log", yscale="log")
    axes.axvline(_FRAME, **_AT_FRAME_RATE)
    plain(axes)
    axes.yaxis.set_major_formatter(FuncFormatter(_percent))
    axes.margins(0.12)


def _percent(value: float, _: int) -> str:
    if value >= 1e-5:
        return f"{100 * value:g} %"
    return f"$10^{{{np.log10(100 * value):.0f}}}$ %"


def _plot_sizes(points: Sequence[Point], title: str, file: Path) -> None:
    """Time a frame, and memory, against the number of nodes; with the fitted exponents."""
    with picture(file, 11.0, 4.8, title) as figure:
        time_panel, memory_panel = figure.subplots(1, 2)
        _draw_sizes(time_panel, points, lambda p: p.ms_median, "ms a frame (median)")
        _draw_sizes(memory_panel, points, lambda p: p.memory / 1e6, "MB held")
        time_panel.axhline(_FRAME, **_AT_FRAME_RATE)


def _draw_sizes(
    axes: Axes, points: Sequence[Point], value: Callable[[Point], float], label: str
) -> None:
    for name, method in TISSUE_METHODS.items():
        mine = sorted((p for p in points if p.method == name), key=lambda p: p.nodes)
        costs: dict[float, float] = {
            p.nodes: value(p) for p in mine if np.isfinite(value(p)) and value(p) > 0
        }
        if costs:
            power = exponent(costs)
            words = name + (f"  ~ n$^{{{power:.2f}}}$" if np.isfinite(power) else "")
            look: Any = {"color": method.colour, "label": words, "ms": 6, "lw": 1.4}
            axes.plot(list(costs), list(costs.values()), method.mark + "-", **look)
    axes.set(xscale="log", yscale="log", xlabel="nodes", ylabel=label)
    plain(axes)
    sizes = sorted({p.nodes for p in points})
    axes.set_xticks(sizes, [f"{n:,}" for n in sizes])
    axes.tick_params(labelsize=7.5)
    axes.xaxis.set_minor_formatter(NullFormatter())
    key_beside(axes)


def _defaults(points: Sequence[Point]) -> list[Point]:
    return [p for p in points if p.default and not p.own]


def _default_cells(p: Point) -> tuple[str, ...]:
    """The cells of the columns `_DEFAULTS`."""
    errors = (100 * p.rel_l2_error, p.max_error_mm, 100 * p.force_error, 100 * p.volume_error)
    return (p.scene, p.method, f"{p.nodes:,}", *map(_number, (p.ms_median, p.ms_p99, *errors)))


def _number(value: float) -> str:
    return number(value, unknown="failed")


def _locking(points: Sequence[Point]) -> str:
    """Growth of the reaction as tissue becomes incompressible; nothing without those scenes."""
    found = [p for p in _defaults(points) if not p.failure and p.nodes == _PAPERS_FINEST]
    ratios = [name for name in LOCKING if any(p.scene == name for p in found)]
    if len(ratios) < 2:
        return ""
    errors = {(p.scene, p.method): f"{100 * p.force_error:.2g} %" for p in found}
    methods = dict.fromkeys(p.method for p in found)
    table = markdown_table(
        ["method", *(f"ν = {SCENES[name].poisson_ratio}" for name in ratios)],
        [[method, *(errors.get((name, method), "") for name in ratios)] for method in methods],
    )
    return filled("tissue", "locking", nodes=f"{_PAPERS_FINEST:,}", table=table)


def _estimates(points: Sequence[Point]) -> str:
    """Errors that methods estimate by themselves beside the true ones; nothing without any."""
    found = [p for p in _defaults(points) if np.isfinite(p.estimated_error * p.rel_l2_error)]
    if not found:
        return ""
    ratios = [p.estimated_error / p.rel_l2_error for p in found]
    rows = [
        (
            *(p.scene, p.method, f"{p.nodes:,}"),
            *map(_number, (100 * p.rel_l2_error, 100 * p.estimated_error, ratio)),
        )
        for p, ratio in zip(found, ratios, strict=True)
    ]
    return filled(
        "tissue",
        "estimates",
        right=str(sum(0.5 <= ratio <= 2.0 for ratio in ratios)),
        cases=str(len(found)),
        table=markdown_table(("scene", "method", "nodes", "L2 %", "estimated %", "ratio"), rows),
    )


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


def _own_table(points: Sequence[Point]) -> str:
    rows = []
    for p in points:
        numbers = (p.ms_median, 100 * p.rel_l2_error, p.max_error_mm, 100 * p.force_error)
        rows.append((p.method, p.setting, f"{p.threads}", *map(_number, numbers), p.reference))
    head = ("method", "setting", "threads", "ms", "L2 %", "max mm", "force %", "reference")
    return markdown_table(head, rows)


def _size_table(sizes: Sequence[Point]) -> str:
    counts = sorted({p.nodes for p in sizes})
    rows = []
    for method in dict.fromkeys(p.method for p in sizes):
        mine = {p.nodes: p for p in sizes if p.method == method}
        for cost, value in (
            ("ms a frame", lambda p: p.ms_median),
            ("MB held", lambda p: p.memory / 1e6),
            ("s to set up", lambda p: p.setup),
        ):
            costs: dict[float, float] = {n: value(p) for n, p in mine.items()}
            numbers = [_number(costs[n]) if n in costs else "" for n in counts]
            rows.append((method, cost, *numbers, _number(exponent(costs))))
    return markdown_table(("method", "cost", *(f"{n:,} nodes" for n in counts), "exponent"), rows)


def _front(scene: str, points: Sequence[Point]) -> str:
    steps = [
        f"`{p.method}` ({p.setting}) leaves {100 * p.rel_l2_error:.2g} % in {p.ms_median:.3g} ms"
        for p in pareto_front(points)
    ]
    return f"- **{scene}** ({SCENES[scene].words}): {'; '.join(steps) or 'nothing was measured'}."
