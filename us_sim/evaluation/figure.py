"""Figures of the reports: one size of letters, one kind of grid, one place for keys."""

from __future__ import annotations

from pathlib import Path

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter


def new_figure(width: float, height: float, title: str) -> Figure:
    """An empty figure (inches) with its title at the left."""
    figure = Figure(figsize=(width, height), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title, fontsize=12, x=0.01, ha="left")
    return figure


def save(figure: Figure, file: Path) -> None:
    """Write it as PNG, as many pixels as it has been laid out for."""
    figure.savefig(file, dpi=figure.dpi)


def plain(panel: Axes) -> None:
    """Numbers without powers of ten, a faint grid, and no frame at the top and the right."""
    for axis in (panel.xaxis, panel.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    panel.grid(True, which="major", color="0.93")
    panel.set_axisbelow(True)
    panel.spines[["top", "right"]].set_visible(False)
    panel.tick_params(labelsize=8.5)


def key_beside(panel: Axes, handles: list | None = None) -> None:  # type: ignore[type-arg]
    """What colours and marks mean, to the right of a panel; nothing where it has none."""
    if handles is None and not panel.get_legend_handles_labels()[0]:
        return
    panel.legend(
        handles=handles, fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1.01, 0.5)
    )
