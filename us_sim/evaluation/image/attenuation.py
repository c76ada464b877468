"""Loss along the beams, in layers whose loss is known in closed form (Beer and Lambert)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.figure import key_beside, new_figure, plain, save
from us_sim.evaluation.image.artefact import Artefact
from us_sim.evaluation.image.layers import GREY, LAYERS, PROBES, layered_volume, lost, tilted
from us_sim.evaluation.image.points import Point
from us_sim.evaluation.report_folder import ReportFolder
from us_sim.evaluation.target import Target
from us_sim.geometry.pose import Pose
from us_sim.slicing.acoustics.settings import Acoustics
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.formation.image_formation import GREYS_PER_DECIBEL
from us_sim.slicing.probe.probe import Probe

_FREQUENCY = {"linear": 7e6, "convex": 3.5e6, "sector": 3e6}  # Hz
_TILTS = (0.0, 10.0, 20.0, 30.0, 40.0)  # degrees
_PARTS = 12  # of the depth; of each the depth with the greatest error is a row
_DARKEST, _BRIGHTEST = 4.0, 250.0  # grey values between which a mean is not clipped
_FEWEST = 32  # pixels of a mean
_LIMIT = 1.0  # percent of the amplitude


class Attenuation(Artefact):
    """Images of layers of one grey, whose levels are the loss alone."""

    name = "attenuation"
    title = "Loss along the beams"
    simplified = (
        "attenuation is proportional to the frequency, also of blood and bone; borders pass what "
        "they pass at a right angle; sound goes straight on, without refraction (no edge shadows "
        "of vessels), without echoes between borders, and at the same speed in all tissue."
    )

    def points(self, quick: bool) -> list[Point]:
        volume = layered_volume()
        found = []
        for name, probe in PROBES.items():
            acoustics = Acoustics(
                artefacts="live",
                frequency=_FREQUENCY[name],
                compensation=0.5,
                surfaces=False,
                tissues={layer.name: layer.tissue for layer in LAYERS},
            )
            scanner = BMode(volume, probe, acoustics=acoustics)
            for degrees in (0.0, 40.0) if quick else _TILTS:
                for direction in (False, True) if degrees else (False,):
                    pose = tilted(degrees, elevational=direction)
                    artefact = self.name + ("_elevational" if direction else "")
                    image = scanner.image(pose)
                    expected = expected_levels(probe, pose, acoustics)
                    found += _worst(artefact, name, degrees, probe, image, expected)
        return found

    def targets(self, points: Sequence[Point]) -> list[Target]:
        targets = []
        for name in PROBES:
            worst = max(abs(p.error_percent) for p in points if p.probe == name)
            what = f"loss in layers, {name} probe, tilted up to 40°: amplitude, worst depth"
            targets.append(Target.at_most(what, _LIMIT, worst, "%"))
        return targets

    def report(self, points: Sequence[Point], folder: ReportFolder) -> list[str]:
        figure = new_figure(10.5, 3.8, "Loss in layers: error of the amplitude at the worst depths")
        for panel, name in zip(figure.subplots(1, 3, sharey=True), PROBES, strict=True):
            for key in dict.fromkeys((p.artefact, p.tilt_deg) for p in points if p.probe == name):
                mine = [p for p in points if (p.artefact, p.tilt_deg, p.probe) == (*key, name)]
                label = f"{key[1]:g}°" + (", out of plane" if key[0] != self.name else "")
                panel.plot([p.depth_mm for p in mine], [p.error_percent for p in mine], label=label)
            panel.set(title=name, xlabel="depth, mm")
            plain(panel)
        figure.axes[0].set_ylabel("error, %")
        key_beside(figure.axes[-1])
        save(figure, folder.picture("attenuation"))
        return [
            "![Loss in layers](image_attenuation.png)",
            f"Layers of {', '.join(layer.name for layer in LAYERS)}, all of one grey, seen by a "
            "probe that is tilted in its image's plane and out of it. What is compared is the mean "
            "level of all pixels at one depth with the mean of their closed forms: twice the "
            "attenuation on the way to the pixel, and what each border lets through in both "
            "directions. Of each twelfth of the depth the row is where the error is greatest.",
        ]


def expected_levels(probe: Probe, pose: Pose, acoustics: Acoustics) -> NDArray[np.float64]:
    """(rows, columns) dB by which each pixel is changed; NaN where no beam reaches."""
    assert acoustics.frequency is not None
    line, distance = probe.pixel_beams.astype(np.float64)
    starts, directions = probe.rays(((line + 0.5) / probe.lines).reshape(-1))
    zero = np.zeros(len(starts))
    start = pose.apply(np.column_stack([starts[:, 0], zero, starts[:, 1]]))
    direction = np.column_stack([directions[:, 0], zero, directions[:, 1]]) @ pose.rotation.T
    away = distance.reshape(-1)
    level = lost(start, direction, away, acoustics.frequency)
    level += 2.0 * 100.0 * acoustics.compensation * acoustics.frequency * 1e-6 * away
    return np.asarray(level.reshape(line.shape))


def _worst(
    artefact: str,
    name: str,
    degrees: float,
    probe: Probe,
    image: NDArray[np.uint8],
    expected: NDArray[np.float64],
) -> list[Point]:
    """The depth with the greatest error of each part of the depth."""
    grey = GREY + GREYS_PER_DECIBEL * expected
    usable = (grey > _DARKEST) & (grey < _BRIGHTEST)
    bins = np.where(usable, probe.pixel_beams[1] / probe.pixel_spacing[1], -1.0).astype(np.intp)
    count = bins.max() + 1
    flat, shown = bins[usable], (image - grey)[usable] / GREYS_PER_DECIBEL
    number = np.bincount(flat, minlength=count)
    off = np.bincount(flat, shown, minlength=count) / np.maximum(number, 1)
    mean = np.bincount(flat, expected[usable], minlength=count) / np.maximum(number, 1)
    off[number < _FEWEST] = 0.0
    points = []
    for part in np.array_split(np.arange(count), _PARTS):
        at = part[np.argmax(np.abs(off[part]))]
        depth = (at + 0.5) * probe.pixel_spacing[1]
        row = (artefact, name, degrees, float(depth), float(mean[at]), float(mean[at] + off[at]))
        points.append(Point.of(*row, "dB"))
    return points
