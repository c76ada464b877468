"""What lies behind fluid is brighter than what lies beside it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from us_sim.evaluation.image.artefact import Artefact
from us_sim.evaluation.image.bone_block import GREY, HEIGHT, bone_volume
from us_sim.evaluation.image.layers import tilted
from us_sim.evaluation.image.points import Point
from us_sim.evaluation.markdown_table import markdown_table
from us_sim.evaluation.report_folder import ReportFolder
from us_sim.evaluation.target import Target
from us_sim.geometry.pose import Pose
from us_sim.slicing.acoustics.media import crossing_loss
from us_sim.slicing.acoustics.settings import Acoustics, TissueAcoustics
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.formation.image_formation import GREYS_PER_DECIBEL
from us_sim.slicing.probe.probe import LinearProbe

_PROBE = LinearProbe(aperture=0.03, depth=0.03)
_FREQUENCY = 8e6  # Hz
_MUSCLE, _FLUID = (0.57, 1.645e6), (0.14, 1.679e6)


class Enhancement(Artefact):
    """A block of blood in muscle, which takes less of the sound."""

    name = "enhancement"
    title = "Enhancement behind fluid"
    simplified = "sound is not focused by a round vessel."

    def points(self, quick: bool) -> list[Point]:
        del quick
        volume = dataclasses.replace(bone_volume(), label_names={1: "muscle", 2: "blood"})
        tissues = {
            name: TissueAcoustics(attenuation=attenuation, impedance=impedance)
            for name, (attenuation, impedance) in (("muscle", _MUSCLE), ("blood", _FLUID))
        }
        acoustics = Acoustics(
            artefacts="live", frequency=_FREQUENCY, compensation=0.57, surfaces=False,
            tissues=tissues,
        )  # fmt: skip
        scanner = BMode(volume, _PROBE, acoustics=acoustics)
        found = []
        for degrees in (0.0, 5.0, 10.0):
            image = scanner.image(Pose(np.zeros(3), tilted(degrees).orientation))
            behind = image[400:430, 250:262]  # of the middle beams
            shown = float(behind.mean() - GREY) / GREYS_PER_DECIBEL
            length = HEIGHT / np.cos(np.radians(degrees))
            spared = 200.0 * (_MUSCLE[0] - _FLUID[0]) * _FREQUENCY * 1e-6 * length
            expected = spared - 2.0 * crossing_loss(_MUSCLE[1], _FLUID[1])
            row = (self.name, "linear", degrees, 415 / 512 * _PROBE.depth, expected, shown)
            found.append(Point.of(*row, "dB"))
        return found

    def targets(self, points: Sequence[Point]) -> list[Target]:
        worst = max(abs(p.error_percent) for p in points)
        return [
            Target.at_most("behind 4 mm of blood in muscle: amplitude, worst tilt", 1.0, worst, "%")
        ]

    def report(self, points: Sequence[Point], folder: ReportFolder) -> list[str]:
        del folder
        rows = [(f"{p.tilt_deg:g}°", f"{p.expected:.2f}", f"{p.measured:.2f}") for p in points]
        return [
            "Behind a block of blood in muscle, against muscle beside it: what the time gain makes "
            "up for and the blood did not take, less what its two borders keep.",
            markdown_table(("tilt", "closed form, dB", "image, dB"), rows),
        ]
