"""Pictures of error against distance, angle and run time, and of filters' lag against jitter."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, NullFormatter

from us_sim.evaluation.figure import key_beside, new_figure, plain, save
from us_sim.evaluation.tracking.cases import CONDITIONS, LARGE, MARKERS, SMALL
from us_sim.evaluation.tracking.filters import FILTER_METHODS, FilterPoint
from us_sim.evaluation.tracking.points import Point, those

_DISTANCE = 0.4  # m


def plot_views(points: Sequence[Point], file: Path) -> None:
    """Errors of position and rotation over the distance, and over the angle at 0.4 m."""
    figure = new_figure(
        10.5, 7.4, "Error of plain views, 640 × 480 (line: median; dashed: 95th percentile)"
    )
    plain = those(points, condition="plain", image_size=SMALL)
    panels = figure.subplots(2, 2, sharey="row")
    at = {
        "distance, m (30°)": (those(plain, angle=30), lambda p: p.case.distance),
        f"angle, degrees ({_DISTANCE:g} m)": (
            those(plain, distance=_DISTANCE),
            lambda p: p.case.angle,
        ),
    }
    for column, (label, (mine, across)) in enumerate(at.items()):
        _errors(panels[0, column], mine, across, Point.error)
        _errors(panels[1, column], mine, across, Point.turned)
        panels[1, column].set_xlabel(label)
    panels[0, 0].set_ylabel("position, mm")
    panels[1, 0].set_ylabel("rotation, degrees")
    distances = sorted({p.case.distance for p in plain})
    for panel in panels[:, 0]:
        panel.set_xscale("log")
        panel.set_xticks(distances, [f"{value:g}" for value in distances])
        panel.xaxis.set_minor_formatter(NullFormatter())
    key_beside(panels[0, 1])
    save(figure, file)


def plot_run_time(points: Sequence[Point], file: Path) -> None:
    """Median error against processor time: every body at 0.4 m, in images of both sizes."""
    figure = new_figure(
        10.5, 4.6, "Error against run time at 0.4 m (full: 640 × 480; hollow: 1920 × 1080)"
    )
    panels = figure.subplots(1, 2, sharex=True)
    mine = those(points, condition="plain", distance=_DISTANCE)
    for panel, value, label in (
        (panels[0], Point.error, "position, mm (median)"),
        (panels[1], Point.turned, "rotation, degrees (median)"),
    ):
        for name, kind in MARKERS.items():
            for size in (SMALL, LARGE):
                some = those(mine, marker=name, image_size=size)
                fill = kind.colour if size == SMALL else "white"
                panel.plot(
                    [p.cpu_ms for p in some],
                    [value(p, 50) for p in some],
                    kind.mark,
                    mfc=fill,
                    mec=kind.colour,
                    ms=7,
                    label=name if size == SMALL else None,
                )
        panel.set(xlabel="processor time of an image, ms (median)", ylabel=label)
        panel.set(xscale="log", yscale="log")
        _plain(panel)
    key_beside(panels[1])
    save(figure, file)


def plot_conditions(points: Sequence[Point], file: Path) -> None:
    """Error, and how many views in a hundred show the body to the tracker, in every condition."""
    figure = new_figure(10.5, 6.6, "Conditions at 0.4 m and 30°, 640 × 480")
    panels = figure.subplots(3, 1, sharex=True)
    mine = those(points, image_size=SMALL, distance=_DISTANCE, angle=30)
    places = np.arange(len(CONDITIONS))
    width = 0.8 / len(MARKERS)
    for number, (name, kind) in enumerate(MARKERS.items()):
        columns: list[tuple[float, float, float]] = []
        for condition in CONDITIONS:
            columns.append((np.nan,) * 3)
            for p in those(mine, marker=name, condition=condition)[:1]:
                percent = 100 * len(p.found) / max(1, len(p.views))
                columns[-1] = (p.error(95), p.turned(95), percent)
        for panel, values in zip(panels, zip(*columns, strict=True), strict=True):
            at = places + (number - 0.5 * (len(MARKERS) - 1)) * width
            panel.bar(at, values, 0.9 * width, color=kind.colour, label=name)
    for panel, label in zip(panels, ("mm, 95 %", "degrees, 95 %", "found, %"), strict=True):
        panel.set_ylabel(label)
        if panel is not panels[2]:
            panel.set_yscale("log")
        _plain(panel)
    panels[2].set_xticks(places, list(CONDITIONS))
    key_beside(panels[0])
    save(figure, file)


def plot_filters(points: Sequence[FilterPoint], file: Path) -> None:
    """Lag in motion against what trembles at rest, and what is off at the very moment."""
    figure = new_figure(
        10.5, 4.6, "Filters at 60 poses a second (large and full: the default settings)"
    )
    panels = figure.subplots(1, 2)
    values: tuple[tuple[str, Callable[[FilterPoint], float]], ...] = (
        ("trembling at rest, mm (root mean square)", lambda p: 1e3 * p.jitter),
        ("error in motion at the very moment, mm", lambda p: 1e3 * p.error),
    )
    for panel, (label, value) in zip(panels, values, strict=True):
        for method, (colour, mark) in FILTER_METHODS.items():
            mine = [p for p in points if p.method == method]
            for p in mine:
                panel.plot(
                    max(1e3 * p.lag, 0.0),
                    value(p),
                    mark,
                    mec=colour,
                    mfc=colour if p.default else "white",
                    ms=11 if p.default else 5,
                    label=method if p is mine[0] else None,
                )
        panel.set_xscale("symlog", linthresh=1.0)
        panel.set(xlabel="lag in motion, ms", ylabel=label, yscale="log")
        _plain(panel)
    panels[1].legend(fontsize=8, frameon=False)
    save(figure, file)


def _errors(
    panel: Axes,
    points: Sequence[Point],
    across: Callable[[Point], float],
    value: Callable[[Point, float], float],
) -> None:
    for name, kind in MARKERS.items():
        mine = sorted((p for p in points if p.case.marker == name and p.found), key=across)
        x, colour = [across(p) for p in mine], kind.colour
        panel.plot(x, [value(p, 50) for p in mine], kind.mark + "-", color=colour, ms=5, label=name)
        panel.plot(x, [value(p, 95) for p in mine], "--", color=colour, lw=1, alpha=0.7)
    panel.set_yscale("log")
    _plain(panel)


def _plain(panel: Axes) -> None:
    plain(panel)
    for axis in (panel.xaxis, panel.yaxis):
        if axis.get_scale() == "log":
            axis.set_minor_formatter(FuncFormatter(_between_decades))
    panel.tick_params(which="minor", labelsize=7)


def _between_decades(value: float, _: object) -> str:
    """Twos and fives of a decade are named, so that a panel within one has numbers too."""
    return f"{value:g}" if f"{value:e}"[0] in "25" else ""
