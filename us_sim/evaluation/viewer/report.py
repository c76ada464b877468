"""`us-sim evaluate viewer`: viewer.csv, its pictures, and viewer.md."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from us_sim.evaluation.latency.measure import live_cases
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
from us_sim.evaluation.viewer.measure import Point, cases, run_case

_HEAD = (
    *("", "s", "images/s made", "poses skipped %", "age ms p50", "p99", "images/s shown"),
    *("delay ms median", "p99", "start s", "opened s", "viewer cores", "browser cores"),
)


def evaluate_viewer(out: Path, quick: bool) -> int:
    """Write viewer.csv, the plots and viewer.md, as `us_sim.evaluation` says."""
    folder = ReportFolder("viewer", out, quick)
    points = live_cases(folder, cases(quick), run_case, Point)
    table = target_table(targets(points))
    _plot_rates(points, folder.picture("rates"))
    longest = max(points, key=lambda point: (bool(point.usage), point.case.seconds))
    _plot_memory(longest, folder.picture("memory"))
    return folder.finish(
        table,
        failures(points),
        ("nicegui", "playwright"),
        targets=table,
        rows=markdown_table(_HEAD, [_cells(point) for point in points]),
        longest=str(longest.case),
    )


def targets(points: Sequence[Point]) -> list[Target]:
    """Limits against the measured numbers."""
    by_name = {point.title: point for point in points}  # of two of one name the longer, last one

    def seen(name: str, value: Callable[[Point], float]) -> float:
        point = by_name.get(name)
        return np.nan if point is None or point.failure else float(value(point))

    without = seen("no viewer, path", lambda p: p.made)
    taking = seen("1 page that takes, path", lambda p: p.made)
    browser, hand = "1 browser, path", "1 browser, hand"
    taker = "1 page that takes, hand"

    def delays(words: str, name: str) -> list[Target]:
        """Median and 99th percentile."""
        median, p99 = seen(name, lambda p: p.delay_median), seen(name, lambda p: p.delay_p99)
        return [
            Target.at_most(f"{words}, median", 60, median, "ms"),
            Target.at_most(f"{words}, 99th percentile", 120, p99, "ms"),
        ]

    def growth(name: str) -> Target:
        what = f"growth of the {name} after the first minute"
        return Target.under(what, 1, seen(browser, lambda p: p.growth(name)), "MB/min")

    return [
        Target.at_least("images a second in a browser, path", 25, seen(browser, lambda p: p.shown)),
        Target.at_least("images a second in a browser, hand", 25, seen(hand, lambda p: p.shown)),
        *delays("browser: ms from the mouse to the image", hand),
        *delays("page that takes: ms from a command to its image", taker),
        Target.at_most(
            "images a second that the simulator loses to a page that takes",
            *(10, 100.0 * (1.0 - taking / without), "%"),
        ),
        Target.at_most(
            "from `us-sim view` to the first image in a page",
            *(4, seen(taker, lambda p: p.started), "s"),
        ),
        growth("viewer"),
        growth("browser"),
    ]


def _plot_rates(points: Sequence[Point], file: Path) -> None:
    """Two bars a case: images made and shown; and beside them how long a page waits for them."""
    shown = [point for point in points if not point.failure]
    height = 1.8 + 0.42 * max(1, len(shown))
    with picture(file, 11, height, "What a page costs, and what it gets") as figure:
        rates, delays = figure.subplots(1, 2, sharey=True)
        places = np.arange(len(shown))
        rates.barh(places - 0.19, [p.made for p in shown], 0.36, color="#08519c", label="made")
        in_page = {"color": "#6baed6", "label": "in the page"}
        rates.barh(places + 0.19, [p.shown for p in shown], 0.36, **in_page)
        rates.set_yticks(places, [f"{p.case}, {p.case.seconds:g} s" for p in shown])
        rates.invert_yaxis()
        rates.set_xlabel("images a second")
        graph = [(p.age(50), p.age(99)) for p in shown]
        page = [(p.delay_median, p.delay_p99) for p in shown]
        for spans, beside, colour, name in (
            (graph, -0.19, "#08519c", "pose to image, in the graph"),
            (page, 0.19, "#6baed6", "pointer, or command, to image in the page"),
        ):
            median, p99 = np.array(spans).reshape(-1, 2).T
            delays.barh(places + beside, median, 0.36, color=colour, label=name)
            delays.plot(p99, places + beside, "o", color="#d62728", ms=4)
        delays.set_xlabel("ms: bars median, dots 99th percentile")
        for panel in (rates, delays):
            plain_bars(panel)
            above = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0)}
            panel.legend(fontsize=8, frameon=False, **above)


def _plot_memory(point: Point, file: Path) -> None:
    """Memory of every process of the longest case."""
    with picture(file, 10, 4.2, f"{point.case}, {point.case.seconds:g} s") as figure:
        panel = figure.subplots()
        for name, use in point.usage.items():
            panel.plot(use.times, [1e-6 * each.memory for each in use.uses], label=name)
        panel.set(xlabel="time, s", ylabel="memory, MB")
        panel.set_ylim(bottom=0)
        plain(panel)
        key_beside(panel)


def _cells(point: Point) -> list[str]:
    numbers = (
        *((point.case.seconds, "g"), (point.made, ".1f"), (point.skipped, ".1f")),
        *((point.age(50), ".1f"), (point.age(99), ".1f"), (point.shown, ".1f")),
        *((point.delay_median, ".0f"), (point.delay_p99, ".0f"), (point.started, ".1f")),
        *((point.opened, ".1f"), (point.cores("viewer"), ".2f")),
        (point.cores("browser"), ".2f"),
    )
    return [str(point.case), *(number(value, form) for value, form in numbers)]
