"""Strain in a session while it is pressed fastest: of the tissue itself, and as it is estimated."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.demo.session import Session
from us_sim.scene.building import scanner_of, volume_of
from us_sim.scene.scene import Scene
from us_sim.slicing.drawing.annotation import Annotation
from us_sim.slicing.drawing.overlay import Overlay
from us_sim.slicing.strain.axial_strain import AxialStrain
from us_sim.slicing.strain.colours import strain_scale
from us_sim.slicing.strain.compression import compression
from us_sim.slicing.strain.estimate import estimate_strain, require_short_windows

_APART = 1.5e-4
"""m, that the probe moves on at most between two images that are compared: some samples."""


def strain_pictures(session: Session, scene: Scene) -> dict[str, NDArray[np.uint8]]:
    """Pictures (rows, columns, 3) of red, green and blue, by their titles, in order.

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
    for title, values, beside in (
        ("strain since rest", since_rest, since_rest),
        ("strain between two images", between, between),
        ("estimate from these two images", estimate.strain, between),
    ):
        most = max(float(f"{np.nanpercentile(np.abs(beside), 95.0):.1g}"), 1e-4)  # one digit
        pressed = compression(values)
        note = f"mean {100 * pressed.mean:.2g} %, quality {pressed.quality:.2f}"
        overlay = Overlay(values, strain_scale("strain", most), note=note)
        pictures[title] = annotation.draw(now.pixels, overlay=overlay)
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
