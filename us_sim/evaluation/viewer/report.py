"""viewer.md: what was asked and seen, the pictures, the table, and how it was measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from us_sim.evaluation.markdown_table import markdown_table
from us_sim.evaluation.report_folder import ReportFolder
from us_sim.evaluation.row import failures
from us_sim.evaluation.target import target_table
from us_sim.evaluation.viewer.plots import plot_memory, plot_rates
from us_sim.evaluation.viewer.points import Point
from us_sim.evaluation.viewer.targets import targets

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
