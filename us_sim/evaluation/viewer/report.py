"""viewer.md: what was asked and seen, the pictures, the table, and how it was measured.

What is asked of the viewer, against what was seen in one run.

Pictures of what is left to the simulator, of delays, and of memory over time.

`us-sim evaluate viewer`: what the viewer costs the simulator, and how long a page waits.

The scene `upper_arm` is run without a viewer, with one that nobody looks at, with pages that take
what streams without drawing it, and with pages in a real browser.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

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
from us_sim.evaluation.viewer.measure import Point, cases, run_case
from us_sim.run.live import prepare_volume
from us_sim.run.processes import keep_on_this_host
from us_sim.scene.reading import load_scene

_HEAD = (
    *("", "s", "images/s made", "poses skipped %", "age ms p50", "p99", "images/s shown"),
    *("delay ms median", "p99", "start s", "opened s", "viewer cores", "browser cores"),
)


def table(points: Sequence[Point]) -> str:
    """What the command prints: every measure that is asked for, and what was seen."""
    return target_table(targets(points))


def write_report(folder: ReportFolder, points: Sequence[Point]) -> None:
    """Draw the plots and write viewer.md."""
    plot_rates(points, folder.picture("rates"))
    longest = max(points, key=lambda point: (bool(point.usage), point.case.seconds))
    plot_memory(longest, folder.picture("memory"))
    parts = [
        "# The viewer: what it costs, and how soon a page shows what one does",
        folder.opening("nicegui", "playwright"),
        "## What is asked",
        table(points),
        "## Case by case",
        "![What a page costs, and what it gets](viewer_rates.png)",
        markdown_table(_HEAD, [_cells(point) for point in points]),
        "The scene is the arm, 512 × 512 pixels, its own method; every process of it, of the "
        "viewer and of the browser shares the cores. A path is played again and again at 60 Hz, "
        "or a page moves the probe: by hand means that a mouse drags it in the browser, and that "
        "a page without a browser sends 60 commands a second. An age is counted from a pose's "
        "stamp to the arrival of its image in a process that listens in the graph. A delay is "
        "counted from the pointer's movement, or the command, to the moment at which the first "
        "image that contains it has been drawn in the page, or has come. A page that takes gets "
        "everything that the opened page shows, image and meshes, and draws nothing. The browser "
        "is Chromium without a window and without a graphics card: it draws the 3D scene with the "
        "same cores (SwiftShader).",
        "Start is from the command to the first image in the page, opened from opening the page "
        "in the browser to its first image.",
        f"## Memory: {longest.case}",
        "![Memory over time](viewer_memory.png)",
        "Memory is what is resident; what several processes share is divided among them. The "
        "browser's is that of all its processes; growth is fitted by least squares.",
    ]
    folder.write_report(parts, failures(points))


def _cells(point: Point) -> list[str]:
    numbers = (
        *((point.case.seconds, "g"), (point.made, ".1f"), (point.skipped, ".1f")),
        *((point.age(50), ".1f"), (point.age(99), ".1f"), (point.shown, ".1f")),
        *((point.delay_median, ".0f"), (point.delay_p99, ".0f"), (point.started, ".1f")),
        *((point.opened, ".1f"), (point.cores("viewer"), ".2f")),
        (point.cores("browser"), ".2f"),
    )
    return [str(point.case), *(f"{n:{form}}" if np.isfinite(n) else "" for n, form in numbers)]


def targets(points: Sequence[Point]) -> list[Target]:
    """Every measure that is asked for."""
    by_name: dict[str, Point] = {}
    for point in points:  # of two of one name the longer one, which comes last
        by_name[point.title] = point

    def seen(name: str, value: Callable[[Point], float]) -> float:
        point = by_name.get(name)
        return np.nan if point is None or point.failure else float(value(point))

    without = seen("no viewer, path", lambda p: p.made)
    taking = seen("1 page that takes, path", lambda p: p.made)
    browser, hand = "1 browser, path", "1 browser, hand"
    taker = "1 page that takes, hand"
    return [
        Target.at_least("images a second in a browser, path", 25, seen(browser, lambda p: p.shown)),
        Target.at_least("images a second in a browser, hand", 25, seen(hand, lambda p: p.shown)),
        Target.at_most(
            "browser: ms from the mouse to the image, median",
            *(60, seen(hand, lambda p: p.delay_median), "ms"),
        ),
        Target.at_most(
            "browser: ms from the mouse to the image, 99th percentile",
            *(120, seen(hand, lambda p: p.delay_p99), "ms"),
        ),
        Target.at_most(
            "page that takes: ms from a command to its image, median",
            *(60, seen(taker, lambda p: p.delay_median), "ms"),
        ),
        Target.at_most(
            "page that takes: ms from a command to its image, 99th percentile",
            *(120, seen(taker, lambda p: p.delay_p99), "ms"),
        ),
        Target.at_most(
            "images a second that the simulator loses to a page that takes",
            *(10, 100.0 * (1.0 - taking / without), "%"),
        ),
        Target.at_most(
            "from `us-sim view` to the first image in a page",
            *(4, seen(taker, lambda p: p.started), "s"),
        ),
        Target.under(
            "growth of the viewer after the first minute",
            *(1, seen(browser, lambda p: p.growth("viewer")), "MB/min"),
        ),
        Target.under(
            "growth of the browser after the first minute",
            *(1, seen(browser, lambda p: p.growth("browser")), "MB/min"),
        ),
    ]


def plot_rates(points: Sequence[Point], file: Path) -> None:
    """Two bars a case: images made and shown; and beside them how long a page waits for them."""
    shown = [point for point in points if not point.failure]
    figure = new_figure(11, 1.8 + 0.42 * max(1, len(shown)), "What a page costs, and what it gets")
    rates, delays = figure.subplots(1, 2, sharey=True)
    places = np.arange(len(shown))
    rates.barh(places - 0.19, [p.made for p in shown], 0.36, color="#08519c", label="made")
    rates.barh(places + 0.19, [p.shown for p in shown], 0.36, color="#6baed6", label="in the page")
    rates.set_yticks(places, [f"{p.case}, {p.case.seconds:g} s" for p in shown])
    rates.invert_yaxis()
    rates.set_xlabel("images a second")
    graph = [(p.age(50), p.age(99)) for p in shown]
    page = [(p.delay_median, p.delay_p99) for p in shown]
    for spans, height, colour, name in (
        (graph, -0.19, "#08519c", "pose to image, in the graph"),
        (page, 0.19, "#6baed6", "pointer, or command, to image in the page"),
    ):
        median, p99 = np.array(spans).reshape(-1, 2).T
        delays.barh(places + height, median, 0.36, color=colour, label=name)
        delays.plot(p99, places + height, "o", color="#d62728", ms=4)
    delays.set_xlabel("ms: bars median, dots 99th percentile")
    for panel in (rates, delays):
        panel.grid(True, axis="x", color="0.93")
        panel.set_axisbelow(True)
        panel.spines[["top", "right"]].set_visible(False)
        panel.tick_params(labelsize=8.5)
        panel.legend(fontsize=8, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    save(figure, file)


def plot_memory(point: Point, file: Path) -> None:
    """Memory of every process of the longest case."""
    figure = new_figure(10, 4.2, f"{point.case}, {point.case.seconds:g} s")
    panel = figure.subplots()
    for name, use in point.usage.items():
        panel.plot(use.times, [1e-6 * each.memory for each in use.uses], label=name)
    panel.set_xlabel("time, s")
    panel.set_ylabel("memory, MB")
    panel.set_ylim(bottom=0)
    plain(panel)
    key_beside(panel)
    save(figure, file)


def evaluate_viewer(out: Path, quick: bool) -> int:
    """Write viewer.csv, the plots and viewer.md, as `us_sim.evaluation` says."""
    folder = ReportFolder("viewer", out, quick)
    keep_on_this_host(network=False)
    planned = cases(quick)
    prepare_volume(load_scene("upper_arm"))
    points = timed_cases(
        "viewer",
        {case: case.seconds for case in planned},
        run_case,
        lambda case, words: Point(case, failure=words),
    )
    folder.write_rows("viewer", points)
    write_report(folder, points)
    return folder.finish(table(points), failures(points))
