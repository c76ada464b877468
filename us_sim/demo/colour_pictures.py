"""Colour Doppler of a session's vessels: touched, under the full press, and let go.

A press across vessels meets their flow at right angles, where no beam sees it. So these pictures
are of the tissue as it was recorded, on a plane that is tilted along the vessels, as a sonographer
tilts the probe; and each is of the systole next to its moment.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Mapping
from functools import partial

import numpy as np
from numpy.typing import NDArray

from us_sim.demo.session import LumenAreas, Session
from us_sim.geometry.pose import Pose
from us_sim.scene.building import blood_of, colour_of, scanner_of, volume_of
from us_sim.scene.scene import Scene
from us_sim.slicing.drawing.annotation import Annotation
from us_sim.slicing.drawing.label_border import onto_border
from us_sim.slicing.drawing.overlay import Overlay
from us_sim.slicing.flow.blood import Blood
from us_sim.slicing.flow.colour_doppler import ColourDoppler

TILT = 20.0
"""Degrees of the plane, about the array."""

_LET_GO = 0.35  # of the deepest press, from which on the vessels are open again


def colour_pictures(
    session: Session, scene: Scene, areas: LumenAreas | None = None
) -> dict[str, NDArray[np.uint8]]:
    """Pictures (rows, columns, 3) of red, green and blue, by their titles, in order.

    None of a scene without flows or without tissue, or whose vessels no image shows.

    Args:
        session: that was recorded.
        scene: of the session.
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
    aim = settings.depth or 0.5 * scanner.probe.depth
    seen = stamps
    if areas is not None:
        named = {scene.structures[name].label or name for name in scene.flows} & {*areas.area}
        seen = [stamp for stamp in stamps if _is_seen(areas, named, stamp - min(session.poses))]
    if not seen:
        return {}
    titles = {stamp: title for title, stamp in _moments(session, seen, blood).items()}
    pictures = {}
    for stamp in stamps:  # all of them, as a closed vein fills up
        pose = _tilted(session.poses[stamp], aim)
        frame = scanner.frame(pose, session.nodes[stamp], time=1e-9 * stamp)
        blood.at(frame)
        if stamp in titles:
            velocity = colour.estimate(blood, frame)
            overlay = Overlay(velocity, colour.scale, 0.9, outline=colour.outline)
            pictures[titles[stamp]] = annotation.draw(
                frame.pixels, frame.labels, overlay=overlay, settle=partial(onto_border, frame)
            )
    return pictures


def _is_seen(areas: LumenAreas, vessels: Collection[str], since: int) -> bool:
    """Whether the image so long after the first pose (ns) shows vessels whole."""
    sample = int(np.abs(areas.time - 1e-9 * since).argmin())
    return all(np.isfinite(areas.at_rest[name][sample]) for name in vessels)


def _moments(session: Session, stamps: list[int], blood: Blood) -> Mapping[str, int]:
    """Stamps by what happens then."""
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
    for title, begin, lasts in (
        ("touched", int(np.argmax(depth >= 0.0)), depth < 0.9 * deepest),
        ("full press", full, depth >= 0.9 * deepest),
        ("let go", let_go, depth < 0.9 * deepest),
    ):
        within = (times >= times[begin]) & (times < times[begin] + beat)
        over = within & ~lasts & (times > times[begin])
        if over.any():  # a quick hand does not wait for the systole
            within &= times < times[over][0]
        found[title] = stamps[int(np.argmax(np.where(within, pulse, -np.inf)))]
    return found


def _tilted(pose: Pose, aim: float) -> Pose:
    """A probe that looks at what lies ``aim`` m under this one, tilted about its array."""
    half = math.radians(0.5 * TILT)
    turned = pose @ Pose(np.zeros(3), np.array([math.sin(half), 0.0, 0.0, math.cos(half)]))
    there = pose.position + aim * pose.rotation[:, 2]
    return Pose(there - aim * turned.rotation[:, 2], turned.orientation)
