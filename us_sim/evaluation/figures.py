"""The three kinds of figure of the reports, each over a pandas DataFrame.

`draw_error_over_time` and `draw_error_over_parameter` have a panel for each value of one column, a
line for each value of another (its colour and mark are those of `LineLook`, or the next free ones), and
the rows' points on it, in the order of x. `draw_image_grid` has a row and a column for each name.

>>> import pandas as pd
>>> from us_sim.evaluation.figures import draw_error_over_time
>>> table = pd.DataFrame({"method": ["fem", "msds"], "ms": [1.0, 10.0], "error": [0.1, 0.5]})
>>> draw_error_over_time(table, "ms", "error", "By method", lines="method").get_label()
'By method'
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#999999")
"""Okabe and Ito's, which are told apart in every common colour blindness."""
_MARKS = "oDs^vP*"
_LIMIT: Mapping[str, Any] = {"color": "0.6", "lw": 1, "ls": ":", "zorder": 0}


@dataclass(frozen=True)
class LineLook:
    """Colour and mark of a line; as Matplotlib names them."""

    colour: str
    mark: str = "o"
    style: str = "-"


def draw_error_over_time(
    table: pd.DataFrame, time: str, error: str, title: str, **options: Any
) -> Figure:
    """Draw an error over a run time, both logarithmic; the arguments are `draw_lines`'."""
    return draw_lines(table, time, error, title, **{"log": "xy", **options})


def draw_error_over_parameter(
    table: pd.DataFrame, parameter: str, error: str, title: str, **options: Any
) -> Figure:
    """Draw an error over a parameter, an axis each; the arguments are `draw_lines`'."""
    return draw_lines(table, parameter, error, title, **{"log": "y", **options})


def draw_lines(
    table: pd.DataFrame,
    x: str,
    y: str,
    title: str,
    *,
    panels: str = "",
    lines: str = "",
    log: str = "",
    labels: Mapping[str, str] | None = None,
    looks: Mapping[str, LineLook] | None = None,
    filled: str = "",
    join: bool = True,
    limits: Mapping[str, float] | None = None,
    floor: float = -math.inf,
    share_y: bool = True,
) -> Figure:
    """Draw one column of a table over another.

    Args:
        table: a row a point; points that are not finite are left out.
        x, y: columns.
        title: of the figure.
        panels: column with a panel for each of its values; one panel where it is not named.
        lines: column with a line for each of its values.
        log: the axes that are logarithmic, of "xy".
        labels: words at the axes, by column.
        looks: by value of ``lines``.
        filled: column of bools: which marks are full.
        join: whether a line joins a line's points.
        limits: dotted lines across x by their words in the key; with ``y:`` before, across y.
        floor: smaller y are drawn there.
        share_y: whether all panels have one axis y.
    """
    labels, limits, looks = labels or {}, limits or {}, dict(looks or {})
    table = table[np.isfinite(table[x].astype(float)) & np.isfinite(table[y].astype(float))]
    names = list(dict.fromkeys(table[lines])) if lines else [""]
    free = itertools.cycle(
        (colour, mark)
        for colour, mark in zip(_COLOURS, _MARKS, strict=True)
        if colour not in {look.colour for look in looks.values()}
    )
    for name in names:
        looks.setdefault(name, LineLook(*next(free)))
    groups = dict(list(table.groupby(panels, sort=False))) if panels else {"": table}
    figure, axes = _make_panels(title, len(groups) or 1, 4.2, 3.6, share_y)
    for panel, (name, points) in zip(axes, groups.items(), strict=False):
        panel.set_title(str(name), fontsize=11, loc="left")
        for line in names:
            some = (points[points[lines] == line] if lines else points).sort_values(x)
            look = looks[line]
            at = some[x].to_numpy(float), np.maximum(some[y].to_numpy(float), floor)
            if join:
                panel.plot(*at, look.style, color=look.colour, lw=1.2, alpha=0.8)
            full = some[filled].to_numpy(bool) if filled else np.ones(len(some), dtype=bool)
            for chosen, face in ((full, look.colour), (~full, "white")):
                points_of = [values[chosen] for values in at]
                panel.plot(*points_of, look.mark, mec=look.colour, mfc=face, ms=5.5)
        for limit, value in limits.items():
            draw = panel.axhline if limit.startswith("y:") else panel.axvline
            draw(value, **_LIMIT)
        panel.set(xlabel=labels.get(x, x), ylabel=labels.get(y, y))
        for letter, axis in (("x", panel.xaxis), ("y", panel.yaxis)):
            if letter in log:
                panel.set(**{f"{letter}scale": "log"})
                axis.set_major_locator(LogLocator(numticks=6))
                axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
                axis.set_minor_formatter(NullFormatter())
        panel.grid(True, color="0.93")
        panel.set_axisbelow(True)
        panel.spines[["top", "right"]].set_visible(False)
        panel.tick_params(labelsize=8.5)
    shown = names if lines else []
    keys = [
        Line2D([], [], color=look.colour, marker=look.mark, ls=look.style if join else "", label=n)
        for n, look in ((name, looks[name]) for name in shown)
    ]
    keys += [Line2D([], [], **_LIMIT, label=name.removeprefix("y:")) for name in limits]
    if keys:
        beside: Any = {"loc": "upper left", "bbox_to_anchor": (1.01, 1.0)}
        axes[_count_columns(len(axes)) - 1].legend(
            handles=keys, fontsize=8, frameon=False, **beside
        )
    return figure


def draw_image_grid(grid: Mapping[str, Mapping[str, NDArray[Any]]], title: str) -> Figure:
    """Draw images (2-D) of 0 (black) to 255 in rows and columns.

    Args:
        grid: rows by name, and in each the images by the name of their column.
        title: of the figure.
    """
    columns = list(dict.fromkeys(name for row in grid.values() for name in row))
    figure = _make_figure(title, 2.7 * len(columns) + 0.9, 2.9 * len(grid) + 0.6)
    axes = figure.subplots(len(grid), len(columns), squeeze=False)
    for panel, column in zip(axes[0], columns, strict=True):
        panel.set_title(column, fontsize=9)
    for line, (name, row) in zip(axes, grid.items(), strict=True):
        line[0].set_ylabel(name, fontsize=9)
        for panel, column in zip(line, columns, strict=True):
            panel.set(xticks=[], yticks=[], facecolor="0.85")
            if column in row:
                panel.imshow(row[column], "gray", interpolation="nearest", vmin=0.0, vmax=255.0)
    return figure


def _make_panels(
    title: str, count: int, width: float, height: float, share_y: bool
) -> tuple[Figure, list[Axes]]:
    """A figure with so many panels of a size (inches)."""
    columns = _count_columns(count)
    rows = -(-count // columns)
    figure = _make_figure(title, width * columns + 2.0, height * rows + 0.7)
    axes = figure.subplots(rows, columns, squeeze=False, sharey=share_y)
    for panel in axes.flat[count:]:
        panel.set_visible(False)
    return figure, list(axes.flat[:count])


def _count_columns(count: int) -> int:
    """Panels in a row, of so many."""
    return 2 if count == 4 else min(3, count)


def _make_figure(title: str, width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    figure.set_label(title)
    figure.suptitle(title, fontsize=12, x=0.01, ha="left")
    return figure
