"""Where the shadow of a block of bone ends, at rest, pressed, and as the probe slides."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.figure import key_beside, new_figure, plain, save
from us_sim.evaluation.image.artefact import Artefact
from us_sim.evaluation.image.bone_block import (
    GREY,
    STATES,
    bone_volume,
    corners,
    line_through,
    mesh,
)
from us_sim.evaluation.image.layers import tilted
from us_sim.evaluation.image.points import Point
from us_sim.evaluation.report_folder import ReportFolder
from us_sim.evaluation.target import Target
from us_sim.geometry.pose import Pose
from us_sim.slicing.acoustics.settings import Acoustics, TissueAcoustics
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.formation.image_formation import GREYS_PER_DECIBEL
from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe, Probe, SectorProbe

_PROBES: dict[str, tuple[Probe, float]] = {
    "linear": (LinearProbe(aperture=0.04, depth=0.04), 8e6),
    "convex": (ConvexProbe(radius=0.05, opening_angle=np.radians(50), depth=0.06), 4e6),
    "sector": (SectorProbe(aperture=0.02, opening_angle=np.radians(70), depth=0.06), 3e6),
}
_DEPTHS = (0.6, 0.75, 0.9)  # of the image's
_HALF = 0.5  # of the amplitude
_TISSUES = {
    "muscle": TissueAcoustics(attenuation=0.57, impedance=1.645e6),
    # Opaque: what bone lets through would move the place where half of the amplitude is left.
    "bone": TissueAcoustics(attenuation=20.0, impedance=1e8),
}


class Shadow(Artefact):
    """The shadow's edge is where half of the amplitude is left."""

    name = "shadow_edge"
    title = "The edge of a shadow"
    simplified = (
        "the sound is shut off by what lies on straight lines from the aperture to the echo; "
        "diffraction around an edge, and echoes to and fro between bone and face, are left out; "
        "of several blockers at different depths over one another the mean depth counts."
    )

    def points(self, quick: bool) -> list[Point]:
        found = []
        volume, carrier = bone_volume(), mesh()
        for name, (probe, frequency) in _PROBES.items():
            acoustics = Acoustics(
                artefacts="live",
                frequency=frequency,
                compensation=0.57,
                surfaces=False,
                tissues=_TISSUES,
            )
            scanner = BMode(volume, probe, acoustics=acoustics)
            scanner.carry(carrier.nodes, carrier.tetrahedra)
            for degrees in (0.0, 15.0) if quick else (-20.0, -10.0, 0.0, 10.0, 20.0):
                for state_name, state in STATES.items():
                    pose = Pose(np.array([state.slid, 0.0, 0.0]), tilted(degrees).orientation)
                    image = scanner.image(pose, carrier.nodes @ state.gradient.T)
                    places = line_through(probe, pose, corners(state))
                    for part in _DEPTHS:
                        found += _edges(
                            f"{self.name}_{state_name}", name, degrees, probe, image, places,
                            part * probe.depth,
                        )  # fmt: skip
        return found

    def targets(self, points: Sequence[Point]) -> list[Target]:
        targets = []
        for state in STATES:
            mine = [p for p in points if p.artefact == f"{self.name}_{state}"]
            off = max(abs(p.measured - p.expected) for p in mine)
            what = f"shadow of bone, {state}: pixels from its geometric edge, worst of {len(mine)}"
            targets.append(Target.at_most(what, 1.0, off))
        return targets

    def report(self, points: Sequence[Point], folder: ReportFolder) -> list[str]:
        figure = new_figure(10.5, 3.8, "A shadow's edge: pixels from the geometric one")
        for panel, name in zip(figure.subplots(1, 3, sharey=True), _PROBES, strict=True):
            for state, mark in zip(STATES, "osx", strict=True):
                mine = [
                    p for p in points if (p.artefact, p.probe) == (f"{self.name}_{state}", name)
                ]
                off = [p.measured - p.expected for p in mine]
                panel.plot([p.tilt_deg for p in mine], off, mark, ms=4, label=state)
            panel.set(title=name, xlabel="tilt, degrees", ylim=(-1.05, 1.05))
            plain(panel)
        figure.axes[0].set_ylabel("pixels")
        key_beside(figure.axes[-1])
        save(figure, folder.picture("shadow"))
        return [
            "![A shadow's edge](image_shadow.png)",
            "A block of bone in muscle. Behind it, at three depths, the shadow's edge is where "
            "half of the amplitude is left, and the geometric edge the beam through the block's "
            "corner: at rest, in tissue that is pressed by 12 % and sheared, and with the probe "
            "slid by 3.7 mm over tissue that stays. Had the shadow stayed with the tissue, it "
            "would be 47 pixels off after that.",
        ]


def _edges(
    artefact: str,
    name: str,
    degrees: float,
    probe: Probe,
    image: NDArray[np.uint8],
    places: NDArray[np.float64],
    depth: float,
) -> list[Point]:
    """Both edges of the shadow at a depth, in pixels from the middle beam, along the arc."""
    line, distance = probe.pixel_beams
    near = np.abs(distance - depth) < 1.5 * probe.pixel_spacing[1]
    place = (line[near] + 0.5) / probe.lines
    amplitude = 10.0 ** ((image[near] - float(GREY)) / GREYS_PER_DECIBEL / 20.0)
    count = max(64, int(0.6 * probe.columns))
    bins = np.minimum((place * count).astype(np.intp), count - 1)
    number = np.maximum(np.bincount(bins, minlength=count), 1)
    mean = np.bincount(bins, amplitude, minlength=count) / number
    centre = np.bincount(bins, place, minlength=count) / number
    starts, directions = probe.rays(np.array([0.0, 1.0]))
    ends = starts + depth * directions
    angle = np.arccos(np.clip(directions[0] @ directions[1], -1.0, 1.0))
    length = np.linalg.norm(ends[1] - ends[0])
    if angle > 1e-6:
        length *= angle / (2 * np.sin(0.5 * angle))
    pixels = float(length / probe.pixel_spacing[0])
    points = []
    for expected, sign in ((places.min(), 1), (places.max(), -1)):
        if not 0.08 < expected < 0.92:
            continue
        dark = np.flatnonzero(mean < _HALF)
        if not len(dark):
            return [Point(artefact, name, degrees, 1e3 * depth, failure="there is no shadow")]
        inner = dark[0] if sign > 0 else dark[-1]
        outer = inner - sign
        part = (mean[outer] - _HALF) / (mean[outer] - mean[inner])
        found = centre[outer] + part * (centre[inner] - centre[outer])
        row = (artefact, name, degrees, depth, pixels * (expected - 0.5), pixels * (found - 0.5))
        points.append(Point.of(*row, "px"))
    return points
