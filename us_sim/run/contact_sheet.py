"""The picture of a session: six moments of the press, and areas of lumens."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from us_sim.errors import BagError
from us_sim.run.session_summary import IMAGE, Session
from us_sim.run.session_tables import SECOND
from us_sim.scene.building import colour_of, probe_of
from us_sim.scene.scene import Scene
from us_sim.scoring.lumen import LumenAreas
from us_sim.slicing.drawing.label_outlines import label_outlines, onto_border
from us_sim.volume.structure_names import Colour, anatomical_colour


def contact_sheet(session: Session, scene: Scene, areas: LumenAreas | None, file: Path) -> None:
    """Write the picture as PNG.

    Raises:
        BagError: the session has no image.
    """
    moments = pick_moments(session)
    heights = [1.0, 1.0, *[0.55] * (areas is not None)]
    figure = Figure(figsize=(15, 9.0 if areas is None else 12.5), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(len(heights), 3, height_ratios=heights)
    probe, first = probe_of(scene), min(session.poses)
    corners = np.array([[-0.5, -0.5, 0, 1], [probe.columns - 0.5, probe.rows - 0.5, 0, 1]])
    (left, _, top), (right, _, bottom) = 1e3 * (corners @ probe.image_to_probe.T)[:, :3]
    numbers, scanner = session.scanner_of_vessels(scene)
    lumens = {n: _colour(scene, name) for name in numbers for n in numbers[name]}
    images = session.images_at({*moments.values()})
    times = [(stamp - first) / SECOND for stamp in moments.values()]
    for i, (title, stamp) in enumerate(moments.items()):
        axes, pose = figure.add_subplot(grid[divmod(i, 3)]), session.poses[stamp]
        extent = (left, right, bottom, top)
        axes.imshow(images[stamp], cmap="gray", vmin=0, vmax=255, extent=extent)
        axes.tick_params(labelsize=8)
        depth = 1e3 * float(pose.position[2])
        if scanner is not None and stamp in session.nodes and depth > 0.0:
            # Through air nothing is seen.
            frame = scanner.frame(pose, session.nodes[stamp])
            scale = np.array([right - left, bottom - top]) / frame.labels.shape[::-1]
            for label, colour in lumens.items():
                refine = partial(onto_border, frame)
                for outline in label_outlines(frame.labels, label, refine=refine):
                    x, y = ((outline + 0.5) * scale + (left, top)).T
                    axes.fill(x, y, fill=False, ec=colour, lw=1)
            axes.set(xlim=(left, right), ylim=(bottom, top))
        place = f"pressed {depth:.1f} mm" if depth > -0.05 else f"in the air, {-depth:.1f} mm high"
        axes.set_title(f"{title}: t = {times[i]:.2f} s, {place}", fontsize=11)
        axes.set_xlabel("lateral, mm" if areas is None else _caption(areas, times[i]), fontsize=12)
        if i % 3 == 0:
            axes.set_ylabel("depth, mm")
    figure.suptitle(f"us_sim: {scene.name} ({scene.volume.name})", fontsize=15)
    if areas is not None:
        colours = {name: _colour(scene, name) for name in areas.area}
        _plot_areas(figure.add_subplot(grid[-1, :]), areas, times, colours)
    dark = "Beams of the part of the face that does not touch the skin stay dark."
    figure.supxlabel(dark, fontsize=11)
    figure.savefig(file, dpi=80)


def pick_moments(session: Session) -> dict[str, int]:
    """Choose the stamps of six images of a press, by what they show.

    Raises:
        BagError: the session holds no image with a pose.
    """
    stamps = [stamp for stamp in session.stamps(IMAGE) if stamp in session.poses]
    if not stamps:
        raise BagError("the session holds no image with a pose, so there is nothing to show")
    places = np.array([session.poses[stamp].position for stamp in stamps])
    depth = places[:, 2]
    deepest = depth.max()
    full = int(np.argmax(depth >= deepest - 1e-4))
    aside = np.linalg.norm((places - places[full])[:, :2], axis=1)
    slid = np.where(depth >= 0.5 * deepest, aside, -1.0)[full:]
    picked = {
        "before": 0,
        "first touch": int(np.argmax(depth >= 0.0)),
        "pressing": int(np.argmax(depth >= 0.5 * deepest)),
        "full press": full,
        "slid aside": full + int(np.argmax(slid)),
        "after": -1,
    }
    return {title: stamps[i] for title, i in picked.items()}


def _caption(areas: LumenAreas, time: float) -> str:
    sample = int(np.argmin(np.abs(areas.time - time)))
    percents = {name: 100 * areas.fraction(name)[sample] for name in areas.area}
    return ",   ".join(
        f"{name} {'not whole in the image' if np.isnan(percent) else f'{percent:.0f} % of rest'}"
        for name, percent in percents.items()
    )


def _colour(scene: Scene, name: str) -> Colour:
    for structure, given in scene.structures.items():
        if (given.label or structure) == name:
            return colour_of(scene, structure)
    return anatomical_colour(name)


def _plot_areas(
    axes: Any, areas: LumenAreas, moments: Sequence[float], colours: Mapping[str, Colour]
) -> None:
    for name, colour in colours.items():
        percent = 100 * areas.fraction(name)
        axes.plot(areas.time, percent, color=colour, label=f"{name} lumen", lw=2)
    axes.set(xlabel="time, s", ylabel="area, % of the same plane at rest")
    axes.set_ylim(bottom=0)
    axes.margins(x=0.01)
    for moment in moments:
        axes.axvline(moment, color="0.8", lw=1, zorder=0)
    press = axes.twinx()
    press.plot(areas.time, areas.depth * 1e3, color="0.5", ls="--", label="probe depth")
    press.set_ylabel("probe depth, mm")
    lines = axes.get_lines()[: len(colours)] + press.get_lines()
    place = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "ncols": len(lines)}
    axes.legend(handles=lines, frameon=False, **place)
