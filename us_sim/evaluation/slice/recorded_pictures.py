"""Recorded frames and simulated images side by side, and how alike they are along the sweep."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from us_sim.evaluation.slice.recorded_pairs import RecordedFrame, RecordedPair
from us_sim.slicing.probe.probe import Probe

_BRIGHTEST = 99.2  # percentile that is shown white, since few pixels of a recording are bright
_DIFFERENCE = 40.0  # grey levels, at the ends of the colour scale


def draw_recorded(
    rows: Sequence[RecordedFrame],
    pairs: Sequence[RecordedPair],
    probe: Probe,
    attribution: str,
    file: Path,
) -> None:
    """A column a pair: recorded, simulated, their difference; below, all frames' correlation."""
    figure = Figure(figsize=(2.9 * len(pairs) + 0.8, 9.6), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(4, len(pairs), height_ratios=(1, 1, 1, 0.7))
    white = float(np.percentile([pair.recorded for pair in pairs], _BRIGHTEST))
    corner = 1e3 * (probe.image_to_probe @ [-0.5, -0.5, 0, 1])
    end = 1e3 * (probe.image_to_probe @ [probe.columns - 0.5, probe.rows - 0.5, 0, 1])
    extent = (corner[0], end[0], end[2], corner[2])
    by_frame = {row.frame: row for row in rows}
    for column, pair in enumerate(pairs):
        difference = pair.simulated.astype(np.float32) - pair.recorded
        difference[~pair.compared] = np.nan
        row = by_frame[pair.frame]
        for line, (name, image, colours, (low, high)) in enumerate(
            (
                ("recorded", pair.recorded, "gray", (0.0, white)),
                ("simulated", pair.simulated, "gray", (0.0, white)),
                ("simulated − recorded", difference, "RdBu_r", (-_DIFFERENCE, _DIFFERENCE)),
            )
        ):
            axes = figure.add_subplot(grid[line, column])
            shown = axes.imshow(image, cmap=colours, vmin=low, vmax=high, extent=extent)
            axes.tick_params(labelsize=7, labelbottom=line == 2, labelleft=column == 0)
            if line == 0:
                axes.set_title(f"frame {pair.frame}, t = {row.time:.2f} s", fontsize=10)
            if line == 2:
                axes.set_xlabel(f"NCC {row.ncc_raw:.3f}; smoothed {row.ncc_smoothed:.3f}")
                if column == len(pairs) - 1:
                    figure.colorbar(shown, ax=axes, shrink=0.8, label="grey levels")
            if column == 0:
                axes.set_ylabel(f"{name}\ndepth, mm")
    _plot_correlation(figure.add_subplot(grid[3, :]), rows)
    figure.suptitle(
        f"Real frames of a freehand sweep, and the volume made from it cut at their poses.  "
        f"{attribution}",
        fontsize=13,
    )
    figure.savefig(file, dpi=80)


def _plot_correlation(axes, rows: Sequence[RecordedFrame]) -> None:  # type: ignore[no-untyped-def]
    frames = [row.frame for row in rows]
    for name, words, colour, mark in (
        ("ncc_smoothed", "smoothed to the volume's resolution", "#0072B2", "s"),
        ("ncc_raw", "as recorded", "#D55E00", "o"),
        ("ncc_mirrored", "smoothed, left and right swapped", "0.6", "x"),
    ):
        values = [getattr(row, name) for row in rows]
        axes.plot(frames, values, color=colour, marker=mark, ms=3.5, lw=1, label=words)
    axes.axhline(0.8, color="0.3", ls=":", lw=1.2, label="asked: 0.8")
    axes.set_xlabel("frame")
    axes.set_ylabel("normalised\ncross-correlation")
    axes.set_ylim(0, 1.06)
    axes.margins(x=0.01)
    axes.legend(loc="lower left", fontsize=9, ncols=4)
