"""Pictures of what is left to the simulator, of delays, and of memory over time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from us_sim.evaluation.figure import key_beside, new_figure, plain, save
from us_sim.evaluation.viewer.points import Point


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
