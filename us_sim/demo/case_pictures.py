"""Outlines in a figure, and one picture of several cases: the first image of each."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from us_sim.errors import UsSimError
from us_sim.geometry.pose import Pose
from us_sim.progress import Progress
from us_sim.scene.building import colour_of, scanner_of, volume_of
from us_sim.scene.reading import load_scene
from us_sim.scene.scene import CASE_PREFIX, Scene
from us_sim.slicing.drawing.label_outlines import label_outlines, onto_border
from us_sim.slicing.frame import Frame
from us_sim.volume.structure_names import Colour

_COLUMNS = 4
_INCHES = 3.2  # of a picture's side


def picture_cases(folders: Sequence[Path], file: Path) -> None:
    """Write the picture of the cases in these folders, as PNG.

    Raises:
        UsSimError: a case cannot be read, or the file cannot be written.
    """
    columns = min(_COLUMNS, len(folders))
    rows = math.ceil(len(folders) / columns)
    figure = Figure(figsize=(_INCHES * columns, (_INCHES + 0.4) * rows), layout="constrained")
    FigureCanvasAgg(figure)
    with Progress("drawing", len(folders), "cases") as bar:
        for number, folder in enumerate(folders):
            axes = figure.add_subplot(rows, columns, number + 1)
            _draw(axes, load_scene(f"{CASE_PREFIX}{folder}"), folder.name)
            bar.update(number + 1)
    try:
        figure.savefig(file, dpi=100)
    except OSError as error:
        raise UsSimError(f"--picture {file}: cannot be written: {error.strerror}") from error


def _draw(axes: Any, scene: Scene, name: str) -> None:
    touching = dataclasses.replace(scene.imaging, contact=False)
    scene = dataclasses.replace(scene, imaging=touching)
    volume = volume_of(scene)
    scanner = scanner_of(scene, volume)
    width, height = 1e3 * scanner.probe.width, 1e3 * scanner.probe.height
    top = 1e3 * float(scanner.probe.image_to_probe[2, 3]) - height / scanner.probe.rows / 2
    extent = (-width / 2, width / 2, top + height, top)
    axes.imshow(scanner.image(Pose()), cmap="gray", vmin=0, vmax=255, extent=extent)
    if volume.labels is not None:
        numbers = {label: number for number, label in volume.label_names.items()}
        colours = {
            numbers[given.label or name]: colour_of(scene, name)
            for name, given in scene.structures.items()
        }
        draw_outlines(axes, scanner.frame(Pose()), colours, extent)
    axes.set_title(name, fontsize=10)
    axes.set_xlabel("mm", fontsize=8)
    axes.tick_params(labelsize=7)


def draw_outlines(
    axes: Any,
    frame: Frame,
    colours: Mapping[int, Colour],
    extent: tuple[float, float, float, float],
) -> None:
    """Draw the outlines of labels over a frame's image whose extent is in mm."""
    left, right, bottom, top = extent
    scale = np.array([right - left, bottom - top]) / frame.labels.shape[::-1]
    settle = partial(onto_border, frame)
    for label, colour in colours.items():
        for outline in label_outlines(frame.labels, label, settle=settle):
            x, y = ((outline + 0.5) * scale + (left, top)).T
            axes.plot(np.append(x, x[0]), np.append(y, y[0]), color=colour, lw=1)
    axes.set(xlim=(left, right), ylim=(bottom, top))
