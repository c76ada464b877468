"""Pictures of cases, and of a session: around the press, lumen areas, strain and colour Doppler.

A press across vessels meets their flow at right angles, where no beam sees it. So the pictures of
colour Doppler are of the recorded tissue on a plane that is tilted along the vessels, each at the
systole next to its moment.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from us_sim.errors import BagError, UsSimError
from us_sim.geometry.pose import Pose
from us_sim.progress import Progress
from us_sim.run.session_summary import Session
from us_sim.scene.building import blood_of, colour_of, probe_of, scanner_of, volume_of
from us_sim.scene.reading import load_scene
from us_sim.scene.scene import CASE_PREFIX, Scene
from us_sim.scoring.lumen import LumenAreas
from us_sim.slicing.drawing.annotation import Annotation
from us_sim.slicing.drawing.label_outlines import label_outlines, onto_border
from us_sim.slicing.drawing.overlay import Overlay
from us_sim.slicing.flow.blood import Blood
from us_sim.slicing.flow.doppler import ColourDoppler
from us_sim.slicing.frame import Frame
from us_sim.slicing.strain import AxialStrain, compression, strain_scale
from us_sim.slicing.strain_estimate import estimate_strain, require_short_windows
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


_APART = 1.5e-4
"""m, that the probe moves on at most between two images that are compared: some samples."""


class Picture(NamedTuple):
    """A picture in colours."""

    stamps: tuple[int, ...]  # ns, of the images that it shows
    pixels: NDArray[np.uint8]  # (rows, columns, 3) of red, green and blue


def strain_pictures(session: Session, scene: Scene) -> dict[str, Picture]:
    """Pictures by their titles, in order.

    None of a scene without tissue, or of a session that never presses.
    """
    if session.rest is None or session.tetrahedra is None:
        return {}
    stamps = sorted(stamp for stamp in session.nodes if stamp in session.poses)
    pair = _pressing(session, stamps)
    if pair is None:
        return {}
    scanner = scanner_of(scene, volume_of(scene))
    scanner.carry(session.rest, session.tetrahedra)
    require_short_windows(scanner.probe, scene.strain)
    before, now = (scanner.frame(session.poses[stamp], session.nodes[stamp]) for stamp in pair)
    tissue = AxialStrain.of(now, sharp=scene.strain.borders == "sharp")
    since_rest, between = tissue.image(now), tissue.image(now, before.nodes)
    estimate = estimate_strain(before.pixels, now.pixels, scanner.probe, scene.strain)
    annotation = Annotation(scanner.probe, {})
    pictures = {}
    for title, stamps_of, values, beside in (
        ("strain since rest", pair[1:], since_rest, since_rest),
        ("strain between two images", pair, between, between),
        ("estimate from these two images", pair, estimate.strain, between),
    ):
        most = max(float(f"{np.nanpercentile(np.abs(beside), 95.0):.1g}"), 1e-4)  # one digit
        pressed = compression(values)
        note = f"mean {100 * pressed.mean:.2g} %, quality {pressed.quality:.2f}"
        overlay = Overlay(values, strain_scale("strain", most), note=note)
        pixels = annotation.draw(now.pixels, overlay=overlay)
        pictures[title] = Picture(stamps_of, pixels)
    return pictures


def _pressing(session: Session, stamps: list[int]) -> tuple[int, int] | None:
    """Two images while the probe goes down below the skin, as far apart as can be compared."""
    depth = np.array([session.poses[stamp].position[2] for stamp in stamps])
    if len(depth) < 3 or depth.max() <= 0.0:
        return None
    middle = int(np.argmax(depth >= 0.6 * depth.max()))
    down = depth[middle] - depth[:middle]
    near = np.flatnonzero((down > 0.0) & (down <= _APART))
    first = int(near[0]) if len(near) else middle - 1
    return (stamps[first], stamps[middle]) if first >= 0 else None


TILT = 20.0  # degrees of the plane, about the array
_LET_GO = 0.35  # of the deepest press, from which on the vessels are open again


def colour_pictures(
    session: Session, scene: Scene, areas: LumenAreas | None = None
) -> dict[str, Picture]:
    """Pictures by their titles, in order.

    None of a scene without flows or without tissue, or whose vessels no image shows.

    Args:
        areas: of its vessels: moments are chosen among those whose images show the vessels whole.
    """
    if not scene.flows or session.rest is None or session.tetrahedra is None:
        return {}
    stamps = sorted(stamp for stamp in session.nodes if stamp in session.poses)
    if not stamps:
        return {}
    # Without a probe that really was there, whether it touches says nothing.
    plain = dataclasses.replace(scene, imaging=dataclasses.replace(scene.imaging, contact=False))
    volume = volume_of(scene)
    blood = blood_of(scene, volume)
    scanner = scanner_of(plain, volume)
    scanner.carry(session.rest, session.tetrahedra)
    settings = dataclasses.replace(scene.colour, persistence=0.0)
    colour = ColourDoppler(scanner.probe, settings)
    numbers = {name: number for number, name in volume.label_names.items()}
    outlined = {
        numbers[scene.structures[name].label or name]: (name, colour_of(scene, name))
        for name in scene.flows
    }
    annotation = Annotation(scanner.probe, outlined)
    depth = settings.depth or 0.5 * scanner.probe.depth
    seen = stamps
    if areas is not None:
        named = {scene.structures[name].label or name for name in scene.flows} & {*areas.area}
        seen = [stamp for stamp in stamps if _is_seen(areas, named, stamp - min(session.poses))]
    if not seen:
        return {}
    titles = {stamp: title for title, stamp in _flow_moments(session, seen, blood).items()}
    pictures = {}
    for stamp in stamps:  # all of them, as a closed vein fills up
        pose = _tilted(session.poses[stamp], depth)
        frame = scanner.frame(pose, session.nodes[stamp], time=1e-9 * stamp)
        blood.at(frame)
        if stamp in titles:
            velocity = colour.estimate(blood, frame)
            overlay = Overlay(velocity, colour.scale, 0.9, outline=colour.outline)
            pixels = annotation.draw(
                frame.pixels, frame.labels, overlay=overlay, refine=partial(onto_border, frame)
            )
            pictures[titles[stamp]] = Picture((stamp,), pixels)
    return pictures


def _is_seen(areas: LumenAreas, vessels: Collection[str], since: int) -> bool:
    """Whether the image so long after the first pose (ns) shows vessels whole."""
    sample = int(np.abs(areas.time - 1e-9 * since).argmin())
    return all(np.isfinite(areas.at_rest[name][sample]) for name in vessels)


def _flow_moments(session: Session, stamps: list[int], blood: Blood) -> Mapping[str, int]:
    """Stamps by the names of their moments."""
    times = 1e-9 * np.array(stamps)
    depth = np.array([session.poses[stamp].position[2] for stamp in stamps])
    deepest = max(float(depth.max()), 1e-9)
    full = int(np.argmax(depth >= deepest - 1e-4))
    held = int(np.flatnonzero(depth >= deepest - 1e-4)[-1])
    after = depth[held:] < _LET_GO * deepest
    let_go = held + int(np.argmax(after) if after.any() else np.argmin(depth[held:]))
    # The pulse of the first vessel that has the greatest peak: an artery, where there is one.
    pulses = [vessel.pulse(times) for vessel in blood.vessels]
    pulse = max(pulses, key=lambda each: float(each.max()))
    beat = 1.0 / max(flow.settings.heart_rate for flow in blood.vessels)
    found = {}
    touches = depth >= 0.0  # in the air there is no image that could show blood
    for title, begin, lasts in (
        ("touched", int(np.argmax(depth >= 0.0)), touches & (depth < 0.9 * deepest)),
        ("full press", full, depth >= 0.9 * deepest),
        ("let go", let_go, touches & (depth < 0.9 * deepest)),
    ):
        within = (times >= times[begin]) & (times < times[begin] + beat)
        over = within & ~lasts & (times > times[begin])
        if over.any():  # a quick hand does not wait for the systole
            within &= times < times[over][0]
        found[title] = stamps[int(np.argmax(np.where(within, pulse, -np.inf)))]
    return found


def _tilted(pose: Pose, depth: float) -> Pose:
    """A probe tilted about its array and about the point ``depth`` m under this one."""
    half = math.radians(0.5 * TILT)
    turned = pose @ Pose(np.zeros(3), np.array([math.sin(half), 0.0, 0.0, math.cos(half)]))
    there = pose.position + depth * pose.rotation[:, 2]
    return Pose(there - depth * turned.rotation[:, 2], turned.orientation)


def contact_sheet(session: Session, scene: Scene, areas: LumenAreas | None, file: Path) -> None:
    """Write the picture as PNG.

    Raises:
        BagError: the session has no image.
    """
    moments = _moments(session)
    strained, colours = strain_pictures(session, scene), colour_pictures(session, scene, areas)
    flowing = {f"flow, {title}": picture for title, picture in colours.items()}
    more = [each for each in (strained, flowing) if each]
    heights = [1.0, 1.0, *[1.0] * len(more), *[0.55] * (areas is not None)]
    height = 4.5 * sum(heights[:-1]) + (4.5 if areas is None else 3.5)
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
        axes.set_title(f"{title}: {_times([stamp], first)}, {where}", fontsize=11)
        axes.set_xlabel(_caption(areas, (stamp - first) * 1e-9), fontsize=12)
        axes.tick_params(labelsize=8)
        if i % 3 == 0:
            axes.set_ylabel("depth, mm")
    for row, pictures in enumerate(more, 2):
        for i, (title, picture) in enumerate(pictures.items()):
            axes = figure.add_subplot(grid[row, i])
            axes.imshow(picture.pixels)
            axes.set_title(f"{title}: {_times(picture.stamps, first)}", fontsize=11)
            axes.axis("off")
    if areas is not None:
        of_vessels = {name: _colour(scene, name) for name in areas.area}
        times = [(stamp - first) * 1e-9 for _, stamp in moments]
        _plot_areas(figure.add_subplot(grid[-1, :]), areas, times, of_vessels)
    figure.suptitle(f"us_sim: {scene.name} ({scene.volume.name})", fontsize=15)
    notes = [_DARK, *[_AREAS] * (areas is not None), *[_STRAIN] * bool(strained)]
    notes += [_FLOW] * bool(flowing)
    figure.supxlabel("\n".join(notes), fontsize=11)
    figure.savefig(file, dpi=80)


_DARK = "Beams of the part of the face that does not touch the skin stay dark."
_AREAS = (
    "Areas are of the tissue in the image plane, also below a probe in the air. Above 100 % the "
    "plane cuts more of the vessel than at rest."
)
_STRAIN = (
    "Strain: red is pressed together. The first two are the tissue's own, the third is what a "
    "scanner finds in two images:\nit needs speckle, and has no colour where it finds nothing, as "
    "in a bone's shadow."
)
_FLOW = (
    f"Flow: in the systole that follows the moment, on a plane tilted {TILT:g}° along the vessels; "
    f"colours change with the heart's phase."
)


def _times(stamps: Sequence[int], first: int) -> str:
    """Times since the first pose (ns), as titles say them."""
    return f"t = {' and '.join(f'{(stamp - first) * 1e-9:.2f}' for stamp in stamps)} s"


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
