"""A picture of a volume: three slices at right angles, with a scale bar."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.volume import Volume

_NAMES = ("i", "j", "k")
_BARS = (1, 2, 5, 10, 20, 50, 100, 200)  # mm


def draw_slices(path: Path, volume: Volume, covered: NDArray[np.bool_], title: str) -> None:
    """Write a PNG of the three slices through the middle of what is covered.

    Args:
        path: of the new file.
        volume: what is drawn.
        covered: (i, j, k) where it holds something.
        title: above the slices.

    Raises:
        VolumeError: the file cannot be written.
    """
    at = [int(np.median(np.flatnonzero(_any_along(covered, axis)))) for axis in range(3)]
    spacing = 1e3 * np.linalg.norm(volume.index_to_patient[:3, :3], axis=0)  # mm
    figure = Figure(figsize=(12, 4.6), layout="constrained")
    figure.suptitle(title, fontsize=10)
    for axis, plot in enumerate(figure.subplots(1, 3)):
        across, down = (other for other in range(3) if other != axis)
        grey = np.take(volume.intensities, at[axis], axis=axis)
        size = spacing[[across, down]] * grey.shape
        plot.imshow(
            grey.T, cmap="gray", vmin=0, vmax=255, extent=(0, size[0], size[1], 0), aspect="equal"
        )
        bar = max(mm for mm in _BARS if mm <= max(0.4 * size[0], _BARS[0]))
        left, low = 0.05 * size[0], 0.95 * size[1]
        plot.plot([left, left + bar], [low, low], color="w", linewidth=3)
        plot.text(left, low - 0.02 * size[1], f"{bar} mm", color="w", va="bottom", fontsize=9)
        plot.set_title(f"{_NAMES[axis]} = {at[axis]}", fontsize=9)
        plot.set(xlabel=f"{_NAMES[across]} (mm)", ylabel=f"{_NAMES[down]} (mm)")
    try:
        with path.open("xb") as file:
            FigureCanvasAgg(figure).print_png(file)
    except OSError as error:
        raise VolumeError(f"{path}: cannot be written: {error.strerror}") from error


def _any_along(covered: NDArray[np.bool_], axis: int) -> NDArray[np.bool_]:
    others = tuple(other for other in range(3) if other != axis)
    return np.asarray(covered.any(axis=others), dtype=np.bool_)
