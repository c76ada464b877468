"""Pictures of volumes and segmentations: slices in millimetres, outlines and surfaces."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.surfaces.label_surface import label_surface, spacing_for
from us_sim.volume.volume import LabelMap, Volume

_AXES = ("i", "j", "k")
_BARS = (1, 2, 5, 10, 20, 50, 100, 200)  # mm
_SLICES = 3  # along each axis
_MOST_TRIANGLES = 20_000  # of all surfaces; matplotlib draws them in a second or two
_LINES: tuple[Any, ...] = ("solid", "dashed", "dotted", "dashdot")
"""In turn, since several structures may have one colour."""


def draw_slices(path: Path, volume: Volume, covered: NDArray[np.bool_], title: str) -> None:
    """Write a PNG of three slices at right angles, with a scale bar.

    Args:
        path: of the new file.
        volume: its slices through the middle of the covered part are drawn.
        covered: (i, j, k) where it holds something.
        title: above the slices.

    Raises:
        VolumeError: the file cannot be written.
    """
    at = [int(np.median(np.flatnonzero(covered.any(axis=_others(axis))))) for axis in range(3)]
    spacing = 1e3 * np.linalg.norm(volume.index_to_patient[:3, :3], axis=0)  # mm
    figure = Figure(figsize=(12, 4.6), layout="constrained")
    figure.suptitle(title, fontsize=10)
    for axis, plot in enumerate(figure.subplots(1, 3)):
        across, down = _others(axis)
        grey = np.take(volume.intensities, at[axis], axis=axis)
        size = spacing[[across, down]] * grey.shape
        plot.imshow(
            grey.T, cmap="gray", vmin=0, vmax=255, extent=(0, size[0], size[1], 0), aspect="equal"
        )
        bar = max(mm for mm in _BARS if mm <= max(0.4 * size[0], _BARS[0]))
        left, low = 0.05 * size[0], 0.95 * size[1]
        plot.plot([left, left + bar], [low, low], color="w", linewidth=3)
        plot.text(left, low - 0.02 * size[1], f"{bar} mm", color="w", va="bottom", fontsize=9)
        plot.set_title(f"{_AXES[axis]} = {at[axis]}", fontsize=9)
        plot.set(xlabel=f"{_AXES[across]} (mm)", ylabel=f"{_AXES[down]} (mm)")
    try:
        with path.open("xb") as file:
            FigureCanvasAgg(figure).print_png(file)
    except OSError as error:
        raise VolumeError(f"{path}: cannot be written: {error.strerror}") from error


def draw_segmentation(volume: Volume, found: LabelMap, file: Path) -> None:
    """Write a PNG of slices with the structures' outlines, and of their surfaces.

    Each row has slices through the middle and both sides of the structures along one axis of the
    grid, in millimetres from the grid's first voxel, with their surroundings.
    """
    figure = Figure(figsize=(17, 11))
    FigureCanvasAgg(figure)
    # Its places are given: to find them out takes matplotlib as long as all the drawing.
    grid = figure.add_gridspec(
        3, 2 + _SLICES, left=0.04, right=0.97, bottom=0.05, top=0.96, wspace=0.24, hspace=0.22
    )
    for axis in range(3):
        # Slices at a sixth, a half and five sixths of the labelled voxels.
        held = np.cumsum(np.count_nonzero(found.labels, axis=_others(axis)))
        parts = (np.arange(_SLICES) + 0.5) / _SLICES * held[-1]
        for column, index in enumerate(np.searchsorted(held, parts)):
            _slice(figure.add_subplot(grid[axis, column]), volume, found, axis, int(index))
    _surfaces(figure.add_subplot(grid[:2, _SLICES:], projection="3d"), volume, found)
    voxel = abs(float(np.linalg.det(volume.index_to_patient[:3, :3])))
    keys = [
        Patch(
            edgecolor=found.colours[label],
            facecolor="none",
            linewidth=2.0,
            linestyle=_LINES[number % len(_LINES)],
            label=f"{name}: {found.voxels[name] * voxel * 1e6:.3g} ml",
        )
        for number, (label, name) in enumerate(found.names.items())
    ]
    beside = figure.add_subplot(grid[2, _SLICES:])
    beside.axis("off")
    beside.legend(handles=keys, loc="upper left", fontsize=11, frameon=False, ncols=1)
    figure.savefig(file, dpi=80)


def _others(axis: int) -> tuple[int, ...]:
    return tuple(other for other in range(3) if other != axis)


def _slice(panel: Any, volume: Volume, found: LabelMap, axis: int, index: int) -> None:
    """One slice, brightened by a square root, as vessels are in the dark."""
    sides = np.delete(np.linalg.norm(volume.index_to_patient[:3, :3], axis=0), axis) * 1e3
    grey = np.take(volume.intensities, index, axis=axis).T
    rows, columns = grey.shape
    extent = (-0.5 * sides[0], (columns - 0.5) * sides[0], (rows - 0.5) * sides[1], -0.5 * sides[1])
    panel.imshow(np.sqrt(grey / 255.0), cmap="gray", vmin=0.0, vmax=1.0, extent=extent)
    shown = np.take(found.labels, index, axis=axis).T
    x, y = np.arange(columns) * sides[0], np.arange(rows) * sides[1]
    for number, label in enumerate(found.names):
        if (shown == label).any():
            line, colour = _LINES[number % len(_LINES)], [found.colours[label]]
            panel.contour(x, y, shown == label, [0.5], colors=colour, linestyles=line)
    across, down = _others(axis)
    ends = []
    for along, side in zip((across, down), sides, strict=True):
        held = np.flatnonzero(found.labels.any(axis=_others(along)))
        ends.append((held[0] * side - 20.0, held[-1] * side + 20.0))  # mm around the labels
    panel.set_xlim(*ends[0])
    panel.set_ylim(*ends[1][::-1])
    panel.set_facecolor("black")
    panel.set_title(f"{_AXES[axis]} = {index}", fontsize=10)
    panel.set_xlabel(f"{_AXES[across]}, mm", fontsize=8)
    panel.set_ylabel(f"{_AXES[down]}, mm", fontsize=8)
    panel.tick_params(labelsize=7)


def _surfaces(panel: Any, volume: Volume, found: LabelMap) -> None:
    """Draw the surfaces on a grid so coarse that they have few triangles."""
    labelled = found.on(volume)
    there = [label for label, name in found.names.items() if label and found.voxels[name]]
    spacing = spacing_for(labelled, there, _MOST_TRIANGLES)
    points = []
    for label in there:
        try:
            vertices, triangles = label_surface(labelled, label, spacing)
        except VolumeError:  # it is too thin for this grid
            continue
        corners = 1e3 * vertices[triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        shade = 0.45 + 0.55 * np.clip(normals @ np.array([0.4, -0.5, 0.77]), 0.0, 1.0)
        colours = shade[:, None] * found.colours[label]
        panel.add_collection3d(Poly3DCollection(corners, facecolors=colours))
        points.append(1e3 * vertices)
    low, high = 1e3 * labelled.extent
    if points:
        low, high = np.concatenate(points).min(axis=0), np.concatenate(points).max(axis=0)
    reach = (high - low).max() / 2.0
    middle = (high + low) / 2.0
    panel.set_xlim(middle[0] - reach, middle[0] + reach)
    panel.set_ylim(middle[1] + reach, middle[1] - reach)
    panel.set_zlim(middle[2] - reach, middle[2] + reach)
    panel.set_box_aspect((1, 1, 1))
    labels = panel.set_xlabel, panel.set_ylabel, panel.set_zlabel
    for name, set_label in zip("LPS", labels, strict=True):
        set_label(f"{name}, mm", fontsize=8)
    panel.tick_params(labelsize=7)
