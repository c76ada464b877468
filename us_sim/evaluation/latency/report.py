"""latency.md: what was asked and seen, the pictures, the table, and how it was measured.

What is asked of a live simulation, against what was seen in one run.

Pictures of latency hop by hop, of where processor time goes, and of latency over time.

`us-sim evaluate latency`: how old the pose is when its image has come.

The scene `upper_arm` is run in many ways, with its path played again and again at 60 Hz: as the
separate processes of a live run, in one process, in lockstep; with meshes, methods and images of
several sizes; recorded or not, looked at or not, and with every core kept busy by something else.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

from us_sim.evaluation.latency.measure import DEMO, HAND, LIVE, RATE, Case, Point, cases, run_case
from us_sim.evaluation.report import (
    ReportFolder,
    Target,
    failures,
    key_beside,
    markdown_table,
    new_figure,
    plain,
    save,
    target_table,
)
from us_sim.evaluation.timing import timed_cases
from us_sim.run.live import prepare_volume
from us_sim.run.processes import keep_on_this_host
from us_sim.scene.reading import load_scene

_HEAD = (
    *("", "scheduling", "images/s", "dropped", "pose ms p50", "nodes ms p50", "p99"),
    *("image ms p50", "p99", "worst", "mm p50", "p99", "cores", "MB", "not recorded"),
)


def table(points: Sequence[Point]) -> str:
    """What the command prints: every measure that is asked for, and what was seen."""
    return target_table(targets(points))


def write_report(folder: ReportFolder, points: Sequence[Point]) -> None:
    """Draw the plots and write latency.md."""
    plot_hops(points, folder.picture("hops"))
    plot_usage(points, folder.picture("usage"))
    longest = max(points, key=lambda point: (bool(point.images), point.case.seconds))
    plot_over_time(longest, folder.picture("time"))
    parts = [
        "# Latency: from the tracker's pose to its image",
        folder.opening("numpy", "numba"),
        "## What is asked",
        table(points),
        "## Hop by hop",
        "![Hop by hop](latency_hops.png)",
        _rows(points),
        f"An age is counted from the pose's own stamp to the arrival in a process that subscribes "
        f"to every topic above, and goes before ordinary programs where it may, as the nodes do; "
        f"mm is how far a hand moves meanwhile at {1e3 * HAND:.0f} mm/s. A pose without an image "
        f"was skipped since a newer one had come, "
        f"or lost. In lockstep each pose waits for the image of the one before, and images a "
        f"second are what the machine can do.",
        "## Where the processor's time goes",
        "![Cores by node](latency_usage.png)",
        "The process that listens is not in it, nor what keeps the cores busy.",
        f"## Over time: {longest.case}",
        "![Over time](latency_time.png)",
        "## How it was measured",
        f"The arm's path is played again and again at {RATE:.0f} Hz; what comes in the first "
        f"seconds does not count. Memory is what is resident at the end; what several processes "
        f"share is divided among them. Cores are kept busy by as many endless loops as there are "
        f"cores, at the same priority. Methods run as their "
        f"settings say by default, one thread a node. Scheduling is what the nodes got: realtime "
        f"where they may go before ordinary programs, see their parameter `realtime`.",
    ]
    folder.write_report(parts, failures(points))


def _rows(points: Sequence[Point]) -> str:
    rows = []
    for point in points:
        image, values = "ultrasound/image", point.values
        rows.append(
            (
                *(str(point.case), point.scheduling, _number(point.rate), str(point.dropped)),
                _number(point.latency("probe/pose", 50)),
                *(_number(point.latency("tissue/nodes", percent)) for percent in (50, 99)),
                *(_number(point.latency(image, percent)) for percent in (50, 99, 100)),
                *(_number(HAND * point.latency(image, percent)) for percent in (50, 99)),
                *(_number(values[name]) for name in ("cores_all", "memory_mb_all", "not_recorded")),
            )
        )
    return markdown_table(_HEAD, rows)


def _number(value: object) -> str:
    assert isinstance(value, int | float)
    return f"{value:.3g}" if np.isfinite(value) else ""


_IMAGE = "ultrasound/image"


def targets(points: Sequence[Point]) -> list[Target]:
    """Every measure that is asked for."""
    live, demo = _alike(points, LIVE, busy=False), _alike(points, DEMO, busy=True)
    name, busy = str(LIVE), "demo's method, cores busy"
    return [
        Target.at_most(f"{name}: poses without an image", 0, _seen(live, lambda p: p.dropped)),
        *_ages(name, live, 12, 25),
        Target.at_most(f"{name}: images not recorded", 0, _seen(live, lambda p: p.lost)),
        Target.under(
            f"{name}: growth of the fastest growing process after the first minute",
            *(1, _seen(live, lambda p: p.growth), "MB/min"),
        ),
        Target.at_least(f"{busy}: images a second", 50, _seen(demo, lambda p: p.rate)),
        _ages(busy, demo, np.nan, 50)[1],
    ]


def _ages(name: str, point: Point | None, median: float, most: float) -> list[Target]:
    what = f"{name}: ms from a pose to its image"
    return [
        Target.at_most(f"{what}, {words}", limit, _age(point, percent), "ms")
        for words, limit, percent in (("median", median, 50), ("99th percentile", most, 99))
    ]


def _age(point: Point | None, percent: float) -> float:
    return _seen(point, lambda p: p.latency(_IMAGE, percent))


def _seen(point: Point | None, value: Callable[[Point], float]) -> float:
    return np.nan if point is None or not point.images else float(value(point))


def _alike(points: Sequence[Point], wanted: Case, *, busy: bool) -> Point | None:
    """The point of the wanted case, however long it was."""
    same = (wanted.solver, wanted.mesh, wanted.image, wanted.placed, True, False, busy, True)
    for point in points:
        case = point.case
        if same == (
            *(case.solver, case.mesh, case.image, case.placed),
            *(case.recorder, case.viewer, case.busy, case.realtime),
        ):
            return point
    return None


_WAY = {"probe/pose": "#c6dbef", "tissue/nodes": "#6baed6", "ultrasound/image": "#08519c"}
"""The hops that an image waits for, one after another."""
_NODES = {
    "path_player": "0.75",
    "probe_tracker": "#c6dbef",
    "tissue_deformer": "#6baed6",
    "skin_deformer": "#fdae6b",
    "slice_interpolator": "#08519c",
    "session_recorder": "#74c476",
    "one process": "#9e9ac8",
}


def plot_hops(points: Sequence[Point], file: Path) -> None:
    """A bar a case: what each hop adds to the median, and the 99th percentile of the whole."""
    shown = [point for point in points if len(point.images)]
    figure, panel = _bars(shown, "From the tracker's pose to its image: bars median, dots p99")
    for place, point in enumerate(shown):
        left = 0.0
        for topic, colour in _WAY.items():
            right = point.latency(topic, 50)
            label = topic if place == 0 else None
            panel.barh(place, right - left, left=left, color=colour, height=0.7, label=label)
            left = right
        panel.plot(point.latency("ultrasound/image", 99), place, "o", color="#d62728", ms=5)
    panel.axvline(1e3 / RATE, color="0.5", lw=1, ls=":", label="16.7 ms: 60 Hz")
    panel.set_xlabel("ms from the pose")
    panel.set_xlim(left=0)
    ways = panel.secondary_xaxis("top", functions=(_as_way, _as_time))
    ways.set_xlabel("mm that a hand moves meanwhile, at 100 mm/s", fontsize=9)
    ways.tick_params(labelsize=8.5)
    _finish(figure, panel, file)


def plot_usage(points: Sequence[Point], file: Path) -> None:
    """A bar a case: cores that each node keeps busy."""
    shown = [point for point in points if point.usage]
    figure, panel = _bars(shown, "Cores kept busy, by node")
    seen: set[str] = set()
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
    _finish(figure, panel, file)


def plot_over_time(point: Point, file: Path) -> None:
    """The age of every image of one case, and the memory of its processes."""
    figure = new_figure(10, 5.6, str(point.case))
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    came = np.array([arrival for _, arrival in point.images], dtype=float)
    time = 1e-9 * (came - came[0]) if len(came) else came
    above.plot(time, point.ages("ultrasound/image"), ".", color="#08519c", ms=2)
    above.set_ylabel("ms from a pose to its image")
    above.set_ylim(bottom=0)
    for node, use in point.usage.items():
        memory = [1e-6 * each.memory for each in use.uses]
        below.plot(use.times, memory, color=_NODES.get(node, "0.4"), label=node)
    below.set_ylabel("memory, MB")
    below.set_ylim(bottom=0)
    below.set_xlabel("time, s")
    for panel in (above, below):
        plain(panel)
    key_beside(below)
    save(figure, file)


def _bars(points: Sequence[Point], title: str) -> tuple[Figure, Axes]:
    figure = new_figure(11, 1.6 + 0.34 * max(1, len(points)), title)
    panel: Axes = figure.subplots()
    panel.set_yticks(range(len(points)), [str(point.case) for point in points])
    panel.invert_yaxis()
    return figure, panel


def _finish(figure: Figure, panel: Axes, file: Path) -> None:
    names = panel.get_yticklabels()
    panel.grid(True, axis="x", color="0.93")
    panel.set_axisbelow(True)
    panel.spines[["top", "right"]].set_visible(False)
    panel.tick_params(labelsize=8.5)
    panel.set_yticks(panel.get_yticks(), [name.get_text() for name in names])
    key_beside(panel)
    save(figure, file)


def _as_way(milliseconds: ArrayLike) -> NDArray[np.float64]:
    """mm of a hand."""
    return HAND * np.asarray(milliseconds, dtype=np.float64)


def _as_time(millimetres: ArrayLike) -> NDArray[np.float64]:
    return np.asarray(millimetres, dtype=np.float64) / HAND


def evaluate_latency(out: Path, quick: bool) -> int:
    """Write latency.csv, the plots and latency.md, as `us_sim.evaluation` says."""
    folder = ReportFolder("latency", out, quick)
    keep_on_this_host(network=False)
    planned = cases(quick)
    prepare_volume(load_scene("upper_arm"))
    points = timed_cases(
        "latency",
        {case: case.seconds for case in planned},
        run_case,
        lambda case, words: Point(case, failure=words),
    )
    folder.write_rows("latency", points)
    write_report(folder, points)
    return folder.finish(table(points), failures(points))
