"""The two kinds of figure of the reports, each over a pandas DataFrame.

`draw_lines` draws a panel for each value of one column, and in it a line for each value of another,
through the rows' points in the order of x. `draw_image_grid` has a row and a column for each name.

>>> import pandas as pd
>>> from us_sim.evaluation.figures import draw_lines
>>> table = pd.DataFrame({"method": ["fem", "msds"], "ms": [1.0, 10.0], "error": [0.1, 0.5]})
>>> draw_lines(table, "ms", "error", "By method", lines="method", log="xy").get_label()
'By method'
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
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
"""Okabe and Ito's, distinct in every common colour blindness."""
_MARKS = "oDs^vP*"
_LIMIT: Mapping[str, Any] = {"color": "0.6", "lw": 1, "ls": ":", "zorder": 0}


@dataclass(frozen=True)
class LineLook:
    """Colour, mark and style of a line, as Matplotlib names them."""

    colour: str
    mark: str = "o"
    style: str = "-"


@dataclass(frozen=True)
class PlotOptions:
    """Options of `draw_lines`; columns by their names in the table."""

    panels: str = ""  # column with a panel for each of its values; empty: one panel
    lines: str = ""  # column with a line for each of its values; empty: one line
    log: str = ""  # the axes that are logarithmic, of "xy"
    labels: Mapping[str, str] = field(default_factory=dict)  # words at the axes, by column
    looks: Mapping[str, LineLook] = field(default_factory=dict)  # by line; else the next free one
    filled: str = ""  # column of bools: True for full marks
    join: bool = True  # join a line's points
    limits: Mapping[str, float] = field(default_factory=dict)
    """Dotted lines across x by their words in the key; with ``y:`` before, across y."""
    floor: float = -math.inf  # smaller y are drawn there
    share_y: bool = True  # one axis y for all panels


def draw_lines(table: pd.DataFrame, x: str, y: str, title: str, **keywords: Any) -> Figure:
    """Draw column ``y`` of a table over ``x``, a point a row if finite; `PlotOptions` by name."""
    options = PlotOptions(**keywords)
    table = table[np.isfinite(table[x].astype(float)) & np.isfinite(table[y].astype(float))]
    looks = _choose_looks(table, options)
    groups: dict[Any, pd.DataFrame] = {"": table}
    if options.panels:
        groups = dict(list(table.groupby(options.panels, sort=False)))
    figure, axes = _make_panels(title, len(groups) or 1, 4.2, 3.6, options.share_y)
    for panel, (name, points) in zip(axes, groups.items(), strict=False):
        panel.set_title(str(name), fontsize=11, loc="left")
        for line, look in looks.items():
            some = points[points[options.lines] == line] if options.lines else points
            _draw_line(panel, some.sort_values(x), x, y, look, options)
        for limit, value in options.limits.items():
            draw = panel.axhline if limit.startswith("y:") else panel.axvline
            draw(value, **_LIMIT)
        panel.set(xlabel=options.labels.get(x, x), ylabel=options.labels.get(y, y))
        for letter, axis in (("x", panel.xaxis), ("y", panel.yaxis)):
            if letter in options.log:
                panel.set(**{f"{letter}scale": "log"})
                axis.set_major_locator(LogLocator(numticks=6))
                axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
                axis.set_minor_formatter(NullFormatter())
        panel.grid(True, color="0.93")
        panel.set_axisbelow(True)
        panel.spines[["top", "right"]].set_visible(False)
        panel.tick_params(labelsize=8.5)
    _draw_key(axes, looks, options)
    return figure


def _choose_looks(table: pd.DataFrame, options: PlotOptions) -> dict[str, LineLook]:
    """Return the look of each line of the table, in order: the given one, or the next free one."""
    taken = {look.colour for look in options.looks.values()}
    looks = zip(_COLOURS, _MARKS, strict=True)
    free = itertools.cycle(LineLook(*look) for look in looks if look[0] not in taken)
    names = dict.fromkeys(table[options.lines]) if options.lines else [""]
    return {name: options.looks.get(name) or next(free) for name in names}


def _draw_line(
    panel: Axes, points: pd.DataFrame, x: str, y: str, look: LineLook, options: PlotOptions
) -> None:
    places = points[x].to_numpy(float), np.maximum(points[y].to_numpy(float), options.floor)
    if options.join:
        panel.plot(*places, look.style, color=look.colour, lw=1.2, alpha=0.8)
    full = np.ones(len(points), dtype=bool)
    if options.filled:
        full = points[options.filled].to_numpy(bool)
    for chosen, face in ((full, look.colour), (~full, "white")):
        marks = [values[chosen] for values in places]
        panel.plot(*marks, look.mark, mec=look.colour, mfc=face, ms=5.5)


def _draw_key(axes: Sequence[Axes], looks: Mapping[str, LineLook], options: PlotOptions) -> None:
    """Draw the key of lines and limits beside the first row of panels."""
    keys = []
    for name, look in (looks if options.lines else {}).items():
        style = look.style if options.join else ""
        keys.append(Line2D([], [], color=look.colour, marker=look.mark, ls=style, label=name))
    keys += [Line2D([], [], **_LIMIT, label=name.removeprefix("y:")) for name in options.limits]
    if keys:
        last = axes[_count_columns(len(axes)) - 1]
        place: Any = {"loc": "upper left", "bbox_to_anchor": (1.01, 1.0)}
        last.legend(handles=keys, fontsize=8, frameon=False, **place)


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
    """Make a figure with ``count`` panels of a size (inches)."""
    columns = _count_columns(count)
    rows = -(-count // columns)
    figure = _make_figure(title, width * columns + 2.0, height * rows + 0.7)
    axes = figure.subplots(rows, columns, squeeze=False, sharey=share_y)
    for panel in axes.flat[count:]:
        panel.set_visible(False)
    return figure, list(axes.flat[:count])


def _count_columns(count: int) -> int:
    """Return the number of panels in a row, of ``count`` panels."""
    return 2 if count == 4 else min(3, count)


def _make_figure(title: str, width: float, height: float) -> Figure:
    figure = Figure(figsize=(width, height), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    figure.set_label(title)
    figure.suptitle(title, fontsize=12, x=0.01, ha="left")
    return figure
