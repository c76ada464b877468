"""Pictures of volumes and segmentations: slices in millimetres, with outlines."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.volume import LabelMap, Volume

_AXES = ("i", "j", "k")
_SLICES = 3  # along each axis
_LINES: tuple[Any, ...] = ("solid", "dashed", "dotted", "dashdot")
"""Line styles of structures, in turn, as several structures may have one colour."""


def draw_slices(path: Path, volume: Volume, covered: NDArray[np.bool_], title: str) -> None:
    """Write a PNG of three slices at right angles, through the middle of the covered part.

    Args:
        path: of the new file.
        volume: the volume to draw.
        covered: (i, j, k), True for voxels with data.
        title: above the slices.

    Raises:
        VolumeError: the file cannot be written.
    """
    figure = Figure(figsize=(12, 4.6), layout="constrained")
    figure.suptitle(title, fontsize=10)
    for axis, panel in enumerate(figure.subplots(1, 3)):
        middle = int(np.median(np.flatnonzero(covered.any(axis=_others(axis)))))
        _draw_slice(panel, volume, axis, middle, volume.intensities)
    try:
        with path.open("xb") as file:
            figure.savefig(file, format="png", dpi=100)
    except OSError as error:
        raise VolumeError(f"{path}: cannot be written: {error.strerror}") from error


def draw_segmentation(volume: Volume, found: LabelMap, file: Path) -> None:
    """Write a PNG of slices with the structures' outlines.

    Each row has slices through the middle and both sides of the structures along one axis of the
    grid, in millimetres from the grid's first voxel, with their surroundings.
    """
    figure = Figure(figsize=(13, 11))
    # The places are given: matplotlib takes as long to find them as to draw.
    panels = figure.subplots(
        *(3, _SLICES),
        gridspec_kw={"left": 0.05, "right": 0.8, "bottom": 0.05, "top": 0.96, "hspace": 0.3},
    )
    bright = np.sqrt(255.0 * np.arange(256)).astype(np.uint8)[volume.intensities]  # for vessels
    lines = {label: _LINES[k % len(_LINES)] for k, label in enumerate(found.names)}
    for axis, row in enumerate(panels):
        # Slices at a sixth, a half and five sixths of the labelled voxels.
        held = np.cumsum(np.count_nonzero(found.labels, axis=_others(axis)))
        parts = (np.arange(_SLICES) + 0.5) / _SLICES * held[-1]
        for panel, index in zip(row, np.searchsorted(held, parts), strict=True):
            sides = _draw_slice(panel, volume, axis, int(index), bright)
            shown = np.take(found.labels, index, axis=axis).T
            x, y = (np.arange(n) * side for n, side in zip(shown.shape[::-1], sides, strict=True))
            for label, line in lines.items():
                if (shown == label).any():
                    colour = [found.colours[label]]
                    panel.contour(x, y, shown == label, [0.5], colors=colour, linestyles=line)
            ends = []
            for along, side in zip(_others(axis), sides, strict=True):
                there = np.flatnonzero(found.labels.any(axis=_others(along)))
                ends.append((there[0] * side - 20.0, there[-1] * side + 20.0))  # mm around them
            panel.set(xlim=ends[0], ylim=ends[1][::-1], facecolor="black")
    voxel = abs(float(np.linalg.det(volume.index_to_patient[:3, :3])))
    keys = [
        Patch(
            edgecolor=found.colours[label],
            facecolor="none",
            linewidth=2.0,
            linestyle=lines[label],
            label=f"{name}: {found.voxels[name] * voxel * 1e6:.3g} ml",
        )
        for label, name in found.names.items()
    ]
    figure.legend(handles=keys, loc="upper left", bbox_to_anchor=(0.81, 0.96), frameon=False)
    figure.savefig(file, dpi=80)


def _others(axis: int) -> tuple[int, ...]:
    return tuple(other for other in range(3) if other != axis)


def _draw_slice(
    panel: Any, volume: Volume, axis: int, index: int, grey: NDArray[Any]
) -> NDArray[np.float64]:
    """Draw one slice of grey values of the volume's grid; return the sides of its pixels, mm."""
    across, down = _others(axis)
    sides = 1e3 * np.linalg.norm(volume.index_to_patient[:3, [across, down]], axis=0)
    shown = np.take(grey, index, axis=axis).T
    right, low = (np.array(shown.shape[::-1]) - 0.5) * sides
    extent = (-0.5 * sides[0], right, low, -0.5 * sides[1])
    panel.imshow(shown, cmap="gray", vmin=0, vmax=255, extent=extent)
    panel.set_title(f"{_AXES[axis]} = {index}", fontsize=9)
    panel.set(xlabel=f"{_AXES[across]} (mm)", ylabel=f"{_AXES[down]} (mm)")
    panel.tick_params(labelsize=7)
    return np.asarray(sides)
