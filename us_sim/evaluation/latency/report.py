"""latency.md: what was asked and seen, the pictures, the table, and how it was measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from us_sim.evaluation.latency.cases import RATE
from us_sim.evaluation.latency.plots import plot_hops, plot_over_time, plot_usage
from us_sim.evaluation.latency.points import HAND, Point
from us_sim.evaluation.latency.targets import targets
from us_sim.evaluation.markdown_table import markdown_table
from us_sim.evaluation.report_folder import ReportFolder
from us_sim.evaluation.row import failures
from us_sim.evaluation.target import target_table

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
