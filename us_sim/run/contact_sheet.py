"""The picture of a session: three moments of the press, and areas of lumens."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from us_sim.errors import BagError
from us_sim.recording.decoding import SECOND
from us_sim.run.session_summary import IMAGE, Session
from us_sim.scene.building import build_probe
from us_sim.scene.scene import Scene
from us_sim.scoring.metrics import VesselSection
from us_sim.slicing.drawing.label_outlines import snap_to_border, trace_label_outlines
from us_sim.volume.structure_names import choose_colour


def contact_sheet(
    session: Session, scene: Scene, sections: Mapping[str, VesselSection], file: Path
) -> None:
    """Write the picture as PNG.

    Raises:
        BagError: the session has no image.
    """
    moments = pick_moments(session)
    heights = [1.0, *[0.55] * bool(sections)]
    figure = Figure(figsize=(15, 9.0 if sections else 5.5), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(len(heights), 3, height_ratios=heights)
    probe, first = build_probe(scene), min(session.poses)
    corners = np.array([[-0.5, -0.5, 0, 1], [probe.columns - 0.5, probe.rows - 0.5, 0, 1]])
    (left, _, top), (right, _, bottom) = 1e3 * (corners @ probe.image_to_probe.T)[:, :3]
    numbers, scanner = session.find_vessels(scene)
    lumens = {n: choose_colour(name) for name in numbers for n in numbers[name]}
    images = session.read_images({*moments.values()})
    times = [(stamp - first) / SECOND for stamp in moments.values()]
    for i, (title, stamp) in enumerate(moments.items()):
        axes, pose = figure.add_subplot(grid[0, i]), session.poses[stamp]
        extent = (left, right, bottom, top)
        axes.imshow(images[stamp], cmap="gray", vmin=0, vmax=255, extent=extent)
        depth = 1e3 * float(pose.position[2])
        if scanner is not None and stamp in session.nodes and depth > 0.0:
            # Through air nothing is seen.
            frame = scanner.make_frame(pose, session.nodes[stamp])
            scale = np.array([right - left, bottom - top]) / frame.labels.shape[::-1]
            for label, colour in lumens.items():
                refine = partial(snap_to_border, frame)
                for outline in trace_label_outlines(frame.labels, label, refine=refine):
                    x, y = ((outline + 0.5) * scale + (left, top)).T
                    axes.fill(x, y, fill=False, ec=colour, lw=1)
            axes.set(xlim=(left, right), ylim=(bottom, top))
        axes.set_title(f"{title}: t = {times[i]:.2f} s, pressed {depth:.1f} mm", fontsize=11)
        axes.set(xlabel="lateral, mm", ylabel="depth, mm" if i == 0 else "")
    figure.suptitle(f"us_sim: {scene.name} ({scene.volume.name})", fontsize=15)
    if sections:
        _plot_areas(figure.add_subplot(grid[1, :]), sections, times)
    figure.savefig(file, dpi=80)


def pick_moments(session: Session) -> dict[str, int]:
    """Choose the stamps of three images of a press, by what they show.

    Raises:
        BagError: the session holds no image with a pose.
    """
    stamps = [stamp for stamp in session.list_stamps(IMAGE) if stamp in session.poses]
    if not stamps:
        raise BagError("the session holds no image with a pose, so there is nothing to show")
    depth = np.array([session.poses[stamp].position[2] for stamp in stamps])
    return {
        "first touch": stamps[int(np.argmax(depth >= 0.0))],
        "full press": stamps[int(np.argmax(depth >= depth.max() - 1e-4))],
        "last touch": stamps[-1 - int(np.argmax(depth[::-1] >= 0.0))],
    }


def _plot_areas(axes: Any, sections: Mapping[str, VesselSection], moments: Sequence[float]) -> None:
    for name, section in sections.items():
        colour, percent = choose_colour(name), 100 * section.fraction
        axes.plot(section.times, percent, color=colour, label=f"{name} lumen", lw=2)
    axes.set(xlabel="time, s", ylabel="area, % of the same plane at rest")
    axes.set_ylim(bottom=0)
    axes.margins(x=0.01)
    for moment in moments:
        axes.axvline(moment, color="0.8", lw=1, zorder=0)
    press = axes.twinx()
    press.plot(section.times, section.depth * 1e3, color="0.5", ls="--", label="probe depth")
    press.set_ylabel("probe depth, mm")
    lines = axes.get_lines()[: len(sections)] + press.get_lines()
    place = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "ncols": len(lines)}
    axes.legend(handles=lines, frameon=False, **place)
