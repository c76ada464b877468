"""Pictures of cases, and of a session: six moments of the press, and areas of lumens."""

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

from us_sim.errors import BagError, UsSimError
from us_sim.geometry.pose import Pose
from us_sim.progress import Progress
from us_sim.run.session_summary import Session
from us_sim.scene.building import colour_of, probe_of, scanner_of, volume_of
from us_sim.scene.reading import load_scene
from us_sim.scene.scene import CASE_PREFIX, Scene
from us_sim.scoring.lumen import LumenAreas
from us_sim.slicing.drawing.label_outlines import label_outlines, onto_border
from us_sim.slicing.frame import Frame
from us_sim.volume.structure_names import Colour, anatomical_colour

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
    refine = partial(onto_border, frame)
    for label, colour in colours.items():
        for outline in label_outlines(frame.labels, label, refine=refine):
            x, y = ((outline + 0.5) * scale + (left, top)).T
            axes.plot(np.append(x, x[0]), np.append(y, y[0]), color=colour, lw=1)
    axes.set(xlim=(left, right), ylim=(bottom, top))


def contact_sheet(session: Session, scene: Scene, areas: LumenAreas | None, file: Path) -> None:
    """Write the picture as PNG.

    Raises:
        BagError: the session has no image.
    """
    moments = _moments(session)
    heights = [1.0, 1.0, *[0.55] * (areas is not None)]
    height = 9.0 if areas is None else 12.5
    figure = Figure(figsize=(15, height), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(len(heights), 3, height_ratios=heights)
    probe = probe_of(scene)
    corners = np.array([[-0.5, -0.5, 0, 1], [probe.columns - 0.5, probe.rows - 0.5, 0, 1]])
    (left, _, top), (right, _, bottom) = 1e3 * (corners @ probe.image_to_probe.T)[:, :3]
    first = min(session.poses)
    numbers, scanner = session.scanner_of_vessels(scene)
    images = session.images_at({stamp for _, stamp in moments})
    for i, (title, stamp) in enumerate(moments):
        axes = figure.add_subplot(grid[divmod(i, 3)])
        extent = (left, right, bottom, top)
        axes.imshow(images[stamp], cmap="gray", vmin=0, vmax=255, extent=extent)
        seen = stamp in session.nodes and session.poses[stamp].position[2] > 0.0
        if scanner is not None and seen:  # through air nothing is
            frame = scanner.frame(session.poses[stamp], session.nodes[stamp])
            lumens = {n: _colour(scene, name) for name in numbers for n in numbers[name]}
            draw_outlines(axes, frame, lumens, extent)
        where = _place(session.poses[stamp])
        axes.set_title(f"{title}: t = {(stamp - first) * 1e-9:.2f} s, {where}", fontsize=11)
        axes.set_xlabel(_caption(areas, (stamp - first) * 1e-9), fontsize=12)
        axes.tick_params(labelsize=8)
        if i % 3 == 0:
            axes.set_ylabel("depth, mm")
    if areas is not None:
        of_vessels = {name: _colour(scene, name) for name in areas.area}
        times = [(stamp - first) * 1e-9 for _, stamp in moments]
        _plot_areas(figure.add_subplot(grid[-1, :]), areas, times, of_vessels)
    figure.suptitle(f"us_sim: {scene.name} ({scene.volume.name})", fontsize=15)
    notes = [_DARK, *[_AREAS] * (areas is not None)]
    figure.supxlabel("\n".join(notes), fontsize=11)
    figure.savefig(file, dpi=80)


_DARK = "Beams of the part of the face that does not touch the skin stay dark."
_AREAS = (
    "Areas are of the tissue in the image plane, also below a probe in the air. Above 100 % the "
    "plane cuts more of the vessel than at rest."
)


def _moments(session: Session) -> list[tuple[str, int]]:
    stamps = [stamp for stamp in session.images if stamp in session.poses]
    if not stamps:
        raise BagError("the session holds no image with a pose, so there is nothing to show")
    depth = np.array([session.poses[stamp].position[2] for stamp in stamps])
    deepest = depth.max()
    full = int(np.argmax(depth >= deepest - 1e-4))
    touch, half = (int(np.argmax(depth >= part * deepest)) for part in (0.0, 0.5))
    places = np.array([session.poses[stamp].position for stamp in stamps])
    aside = np.linalg.norm((places - places[full])[:, :2], axis=1)
    slid = full + int(np.argmax(np.where(depth >= 0.5 * deepest, aside, -1.0)[full:]))
    picked = [
        ("before", 0),
        ("first touch", touch),
        ("pressing", half),
        ("full press", full),
        ("slid aside", slid),
        ("after", len(stamps) - 1),
    ]
    return [(title, stamps[i]) for title, i in picked]


def _place(pose: Pose) -> str:
    """Where the probe is over or below the skin at rest, and how far from upright."""
    tilt = float(np.degrees(np.arccos(np.clip(pose.rotation[2, 2], -1.0, 1.0))))
    tilted = f", tilted {tilt:.0f}°" if tilt >= 0.5 else ""
    depth = 1e3 * float(pose.position[2])
    place = f"pressed {depth:.1f} mm" if depth >= 0.05 else "on the skin"
    return (place if depth > -0.05 else f"in the air, {-depth:.1f} mm high") + tilted


def _caption(areas: LumenAreas | None, time: float) -> str:
    if areas is None:
        return "lateral, mm"
    sample = int(np.argmin(np.abs(areas.time - time)))
    said = []
    for name, area in areas.area.items():
        percent = 100 * areas.fraction(name)[sample]
        of_rest = f"{area[sample] * 1e6:.1f} mm² ({percent:.0f} %)"
        said.append(f"{name} {'not whole in the image' if np.isnan(percent) else of_rest}")
    return ",   ".join(said)


def _colour(scene: Scene, name: str) -> Colour:
    for structure, given in scene.structures.items():
        if (given.label or structure) == name:
            return colour_of(scene, structure)
    return anatomical_colour(name)


def _plot_areas(
    axes: Any, areas: LumenAreas, moments: list[float], colours: Mapping[str, Colour]
) -> None:
    for name in areas.area:
        percent = 100 * areas.fraction(name)
        axes.plot(areas.time, percent, color=colours[name], label=f"{name} lumen", lw=2)
    axes.set(xlabel="time, s", ylabel="area, % of the same plane at rest")
    axes.set_ylim(bottom=0)
    axes.margins(x=0.01)
    for time in moments:
        axes.axvline(time, color="0.8", lw=1, zorder=0)
    press = axes.twinx()
    press.plot(areas.time, areas.depth * 1e3, color="0.5", ls="--", label="probe depth")
    press.set_ylabel("probe depth, mm")
    lines = axes.get_lines()[: len(areas.area)] + press.get_lines()
    names = [line.get_label() for line in lines]
    place = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "ncols": len(lines)}
    axes.legend(lines, names, frameon=False, **place)
