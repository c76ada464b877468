"""`us-sim evaluate latency`: latency.csv, its pictures, and latency.md."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from us_sim.evaluation.latency.measure import (
    DEMO,
    HAND,
    LIVE,
    RATE,
    Case,
    Point,
    cases,
    live_cases,
    run_case,
)
from us_sim.evaluation.report import (
    ReportFolder,
    Target,
    failures,
    key_beside,
    markdown_table,
    number,
    picture,
    plain,
    plain_bars,
    target_table,
)

_IMAGE = "ultrasound/image"
_HEAD = (
    *("", "scheduling", "images/s", "dropped", "pose ms p50", "nodes ms p50", "p99"),
    *("image ms p50", "p99", "worst", "mm p50", "p99", "cores", "MB", "not recorded"),
)
_NODES = {
    "path_player": "0.75",
    "probe_tracker": "#c6dbef",
    "tissue_deformer": "#6baed6",
    "skin_deformer": "#fdae6b",
    "slice_interpolator": "#08519c",
    "session_recorder": "#74c476",
    "one process": "#9e9ac8",
}


def evaluate_latency(out: Path, quick: bool) -> int:
    """Write latency.csv, the plots and latency.md, as `us_sim.evaluation` says."""
    folder = ReportFolder("latency", out, quick)
    points = live_cases(folder, cases(quick), run_case, Point)
    table = target_table(targets(points))
    _plot_hops(points, folder.picture("hops"))
    _plot_usage(points, folder.picture("usage"))
    longest = max(points, key=lambda point: (bool(point.images), point.case.seconds))
    _plot_over_time(longest, folder.picture("time"))
    return folder.finish(
        table,
        failures(points),
        ("numpy", "numba"),
        targets=table,
        rows=markdown_table(_HEAD, [_cells(point) for point in points]),
        hand=f"{1e3 * HAND:.0f}",
        longest=str(longest.case),
        rate=f"{RATE:.0f}",
    )


def targets(points: Sequence[Point]) -> list[Target]:
    """Limits against the measured numbers."""
    live, demo = _alike(points, LIVE, busy=False), _alike(points, DEMO, busy=True)
    name, busy = str(LIVE), "demo's method, cores busy"

    def age(words: str, limit: float, where: str, point: Point | None, percent: float) -> Target:
        seen = _seen(point, lambda p: p.latency(_IMAGE, percent))
        return Target.at_most(f"{where}: ms from a pose to its image, {words}", limit, seen, "ms")

    return [
        Target.at_most(f"{name}: poses without an image", 0, _seen(live, lambda p: p.dropped)),
        age("median", 12, name, live, 50),
        age("99th percentile", 25, name, live, 99),
        Target.at_most(f"{name}: images not recorded", 0, _seen(live, lambda p: p.lost)),
        Target.under(
            f"{name}: growth of the fastest growing process after the first minute",
            *(1, _seen(live, lambda p: p.growth), "MB/min"),
        ),
        Target.at_least(f"{busy}: images a second", 50, _seen(demo, lambda p: p.rate)),
        age("99th percentile", 50, busy, demo, 99),
    ]


def _seen(point: Point | None, value: Callable[[Point], float]) -> float:
    return np.nan if point is None or not point.images else float(value(point))


def _alike(points: Sequence[Point], wanted: Case, *, busy: bool) -> Point | None:
    """The point of the wanted case, however long it was."""
    same = (wanted.solver, wanted.mesh, wanted.image, wanted.placed, True, False, busy, True)
    for point in points:
        case = point.case
        placed = (case.solver, case.mesh, case.image, case.placed)
        if same == (*placed, case.recorder, case.viewer, case.busy, case.realtime):
            return point
    return None


@contextmanager
def _bars(points: Sequence[Point], title: str, file: Path) -> Iterator[Axes]:
    """A panel of horizontal bars, one a case."""
    with picture(file, 11, 1.6 + 0.34 * max(1, len(points)), title) as figure:
        panel: Axes = figure.subplots()
        panel.set_yticks(range(len(points)), [str(point.case) for point in points])
        panel.invert_yaxis()
        yield panel
        plain_bars(panel)
        key_beside(panel)


def _plot_hops(points: Sequence[Point], file: Path) -> None:
    """A bar a case: each hop's part of the median, and the 99th percentile of the whole."""
    shown = [point for point in points if len(point.images)]
    hops = {"probe/pose": "#c6dbef", "tissue/nodes": "#6baed6", _IMAGE: "#08519c"}
    title = "From the tracker's pose to its image: bars median, dots p99"
    with _bars(shown, title, file) as panel:
        for place, point in enumerate(shown):
            left = 0.0
            for topic, colour in hops.items():
                right = point.latency(topic, 50)
                label = topic if place == 0 else None
                panel.barh(place, right - left, left=left, color=colour, height=0.7, label=label)
                left = right
            panel.plot(point.latency(_IMAGE, 99), place, "o", color="#d62728", ms=5)
        panel.axvline(1e3 / RATE, color="0.5", lw=1, ls=":", label="16.7 ms: 60 Hz")
        panel.set_xlabel("ms from the pose")
        panel.set_xlim(left=0)
        way = (lambda ms: HAND * np.asarray(ms), lambda mm: np.asarray(mm) / HAND)
        ways = panel.secondary_xaxis("top", functions=way)
        ways.set_xlabel("mm that a hand moves meanwhile, at 100 mm/s", fontsize=9)
        ways.tick_params(labelsize=8.5)


def _plot_usage(points: Sequence[Point], file: Path) -> None:
    """A bar a case: cores that each node keeps busy."""
    shown = [point for point in points if point.usage]
    seen: set[str] = set()
    with _bars(shown, "Cores kept busy, by node", file) as panel:
        for place, point in enumerate(shown):
            left = 0.0
            for node, use in point.usage.items():
                width = use.processor if np.isfinite(use.processor) else 0.0
                label = None if node in seen else node
                seen.add(node)
                colour = _NODES.get(node, "0.4")
                panel.barh(place, width, left=left, color=colour, height=0.7, label=label)
                left += width
        panel.set_xlabel("cores")


def _plot_over_time(point: Point, file: Path) -> None:
    """The age of every image of one case, and the memory of its processes."""
    with picture(file, 10, 5.6, str(point.case)) as figure:
        above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
        came = np.array([arrival for _, arrival in point.images], dtype=float)
        time = 1e-9 * (came - came[0]) if len(came) else came
        above.plot(time, point.ages(_IMAGE), ".", color="#08519c", ms=2)
        above.set_ylabel("ms from a pose to its image")
        for node, use in point.usage.items():
            memory = [1e-6 * each.memory for each in use.uses]
            below.plot(use.times, memory, color=_NODES.get(node, "0.4"), label=node)
        below.set(ylabel="memory, MB", xlabel="time, s")
        for panel in (above, below):
            panel.set_ylim(bottom=0)
            plain(panel)
        key_beside(below)


def _cells(point: Point) -> tuple[str, ...]:
    numbers = (
        point.latency("probe/pose", 50),
        *(point.latency("tissue/nodes", percent) for percent in (50, 99)),
        *(point.latency(_IMAGE, percent) for percent in (50, 99, 100)),
        *(HAND * point.latency(_IMAGE, percent) for percent in (50, 99)),
        *(point.values[name] for name in ("cores_all", "memory_mb_all", "not_recorded")),
    )
    opening = (str(point.case), point.scheduling, number(point.rate), str(point.dropped))
    return (*opening, *map(number, numbers))
