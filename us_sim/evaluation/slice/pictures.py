"""Pictures of what is cut, and of where each method goes wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.colors import LogNorm
from numpy.typing import NDArray

from us_sim.evaluation.figure import new_figure, save
from us_sim.evaluation.slice.cases import MAIN, PLANES, Case
from us_sim.evaluation.slice.methods import SLICING_METHODS, contender
from us_sim.evaluation.slice.points import wrong_pixels
from us_sim.evaluation.slice.reference import ExactSlice, exact_slice, voxel_distance
from us_sim.volume.volume import Volume

SHOWN = (
    MAIN,
    replace(MAIN, deformation="pressed_30mm", plane="oblique"),
    replace(MAIN, deformation="pressed_30mm", plane="corner"),
)
"""The cases that the picture has, a row each."""
_LEAST, _MOST = 1e-13, 1e-2  # voxels, at the ends of the colours
_RIGHT = 1e-14  # voxels, drawn for what is exact to the last bit
_WRONG = "#00e5ff"


def draw_differences(volume: Volume, methods: Sequence[str], file: Path) -> None:
    """A row a case: the image, then for every method how far each pixel is from its true place."""
    columns = 1 + len(methods)
    figure = new_figure(
        2.7 * columns + 0.9,
        3.75 * len(SHOWN) + 0.5,
        "What is cut, and where each pixel's tissue is taken from (grey: nothing there; "
        "cyan: wrong coverage)",
    )
    axes = figure.subplots(len(SHOWN), columns, squeeze=False)
    norm = LogNorm(_LEAST, _MOST, clip=True)
    colours = None
    for panel, title in zip(axes[0], ("reference, float64", *methods), strict=True):
        panel.set_title(title, fontsize=10)
    for line, case in zip(axes, SHOWN, strict=True):
        mesh, frame = case.mesh(), case.frames(1)[0]
        exact = exact_slice(volume, mesh.nodes, mesh.tetrahedra, frame.nodes, frame.plane)
        line[0].imshow(np.rint(exact.grey), cmap="gray", vmin=0, vmax=255)
        line[0].set_ylabel(f"{case.deformation}\n{PLANES[case.plane].words}", fontsize=8)
        for panel, method in zip(line[1:], methods, strict=True):
            distance, wrong = _compared(volume, case, method, exact)
            shown = np.maximum(distance, _RIGHT)
            colours = panel.imshow(shown, norm=norm, cmap="magma", interpolation="nearest")
            row, column = np.nonzero(wrong)
            panel.plot(column, row, "s", ms=3, color=_WRONG, mec="none")
            worst = np.nanmax(distance, initial=0.0)
            panel.set_xlabel(f"worst {worst:.1e} voxels, {wrong.sum()} px wrong", fontsize=8)
        step, down = (np.linalg.norm(v) for v in (frame.plane.column_step, frame.plane.row_step))
        for panel in line:
            panel.set(aspect=down / step, xticks=[], yticks=[], facecolor="0.85")
    if colours is not None:
        bar = figure.colorbar(colours, ax=axes[:, 1:], shrink=0.6, pad=0.01)
        bar.set_label("distance from the true place at rest, voxels", fontsize=9)
    save(figure, file)


def _compared(
    volume: Volume, case: Case, method: str, exact: ExactSlice
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(rows, columns) voxels, NaN where nothing is compared; and where the coverage is wrong."""
    frame = case.frames(1)[0]
    rest = contender(volume, case, method, 1).rest_coordinates(frame)
    tissue_only = SLICING_METHODS[method].tissue_only
    right, wrong, expected = wrong_pixels(volume, frame, exact, rest, tissue_only)
    return np.where(right, voxel_distance(volume, rest, expected), np.nan), wrong
