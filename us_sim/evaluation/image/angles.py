"""Brightness that depends on the angle of the beam: of surfaces and of fibres, in closed form."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from us_sim.evaluation.figure import key_beside, new_figure, plain, save
from us_sim.evaluation.image.artefact import Artefact
from us_sim.evaluation.image.layers import tilted
from us_sim.evaluation.image.points import Point
from us_sim.evaluation.report_folder import ReportFolder
from us_sim.evaluation.target import Target
from us_sim.geometry.pose import Pose
from us_sim.slicing.acoustics.settings import Acoustics, TissueAcoustics
from us_sim.slicing.acoustics.surface_echo import MIRROR, ROUGHNESS
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.formation.image_formation import GREYS_PER_DECIBEL
from us_sim.slicing.probe.probe import LinearProbe
from us_sim.slicing.settings import ECHO_RANGE
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.volume.volume import Volume

_PROBE = LinearProbe(aperture=0.03, depth=0.03)
_TILTS = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0)
_BORDER = 0.0152  # m, along z
_ABOVE, _BELOW = 1.5e6, 1.8e6  # Rayl
_SHEAR = 0.15  # m along z a metre along y
_MUSCLE = TissueAcoustics(
    attenuation=0.57, impedance=1.645e6, fibres=(0.0, 1.0, 0.0), anisotropy=14.0, half_angle=0.3
)


class Surfaces(Artefact):
    """The echo of a flat border, by the angle between beam and normal, in the plane and out."""

    name = "surface"
    title = "Surfaces by their angle"
    simplified = (
        "borders between labels alone echo, as if rough by the same measure everywhere; walls of "
        "vessels have no label of their own, so the scene gives what their border reflects; "
        "nothing is seen in a border's mirror."
    )

    def points(self, quick: bool) -> list[Point]:
        volume = _halves()
        media = {
            "above": TissueAcoustics(attenuation=0.5, impedance=_ABOVE),
            "below": TissueAcoustics(attenuation=0.5, impedance=_BELOW),
        }
        acoustics = Acoustics(
            artefacts="live", frequency=6e6, compensation=0.5, anisotropy=False, tissues=media
        )
        scanner = BMode(volume, _PROBE, acoustics=acoustics)
        found = []
        for degrees in _TILTS[::2] if quick else _TILTS:
            for elevational in (False, True):
                pose = tilted(degrees, elevational=elevational)
                shown = [
                    scanner.image(Pose(np.array([0.0, y, 0.0]), pose.orientation)).max(axis=0)
                    for y in np.arange(0.0, 8e-3, 0.5e-3)  # a voxel each, along the grain
                ]
                level = float(np.mean(shown)) / GREYS_PER_DECIBEL - ECHO_RANGE
                name = self.name + ("_elevational" if elevational else "")
                found.append(
                    Point.of(name, "linear", degrees, _BORDER, _echo(degrees), level, "dB")
                )
        return found

    def targets(self, points: Sequence[Point]) -> list[Target]:
        worst = max(abs(p.measured - p.expected) for p in points)
        return [Target.at_most("echo of a border by its angle: dB off, worst", 1.0, worst)]

    def report(self, points: Sequence[Point], folder: ReportFolder) -> list[str]:
        _plot(points, self.name, "Echo of a border", folder)
        return [
            f"![Echo of a border](image_{self.name}.png)",
            "A flat border between two impedances, of which an ideal mirror would be "
            f"{MIRROR:g} dB above the strongest echo shown, with facets whose slopes have a "
            f"standard deviation of {ROUGHNESS:g} (Beckmann). The mean over the border, in dB, of "
            "the brightest pixel of each column; tilted in the image's plane and out of it. The "
            "border is patchy, so its mean has an offset of its own that no angle changes.",
        ]


class Fibres(Artefact):
    """Echoes of muscle by the angle between beam and fibres, at rest and sheared."""

    name = "anisotropy"
    title = "Fibres off the perpendicular"
    simplified = (
        "a label's fibres have one direction at rest; how echoes fall with the angle is a curve of "
        "two numbers, not scattering by cylinders."
    )

    def points(self, quick: bool) -> list[Point]:
        volume = _muscle()
        acoustics = Acoustics(
            artefacts="live",
            frequency=6e6,
            compensation=0.57,
            surfaces=False,
            tissues={"muscle": _MUSCLE},
        )
        scanner = BMode(volume, _PROBE, acoustics=acoustics)
        sides = ((-0.05, 0.05), (-0.04, 0.04), (-0.03, 0.06))
        carrier = box_mesh(*(uniform_planes(*side, 6) for side in sides))
        scanner.carry(carrier.nodes, carrier.tetrahedra)
        sheared = carrier.nodes.copy()
        sheared[:, 2] += _SHEAR * sheared[:, 1]
        found = []
        for degrees in _TILTS[::2] if quick else _TILTS:
            for name, nodes, lean in (
                (self.name, carrier.nodes, 0.0),
                (f"{self.name}_sheared", sheared, np.arctan(_SHEAR)),
            ):
                pose = Pose(np.zeros(3), tilted(degrees, elevational=True).orientation)
                image = scanner.image(pose, nodes)[100:400, 100:400]
                shown = float(image.mean() - _GREY) / GREYS_PER_DECIBEL
                square = np.sin(np.radians(degrees) - lean) ** 2
                half = np.sin(_MUSCLE.half_angle) ** 2
                expected = -_MUSCLE.anisotropy * square / (square + half)
                found.append(Point.of(name, "linear", degrees, 0.015, expected, shown, "dB"))
        return found

    def targets(self, points: Sequence[Point]) -> list[Target]:
        worst = max(abs(p.measured - p.expected) for p in points)
        return [Target.at_most("echo of fibres by their angle: dB off, worst", 0.1, worst)]

    def report(self, points: Sequence[Point], folder: ReportFolder) -> list[str]:
        _plot(points, self.name, "Echo of fibres", folder)
        return [
            f"![Echo of fibres](image_{self.name}.png)",
            "Muscle whose fibres run across the image, and the same sheared so that they lean by "
            f"{np.degrees(np.arctan(_SHEAR)):.1f}°: then the probe has to be tilted by as much to "
            "see them at their brightest.",
        ]


def _echo(degrees: float) -> float:
    """dB of the border at an angle, where the strongest echo shown is 0."""
    ratio = (_BELOW - _ABOVE) / (_BELOW + _ABOVE)
    facing = np.exp(-(np.tan(np.radians(degrees)) ** 2) / (2 * ROUGHNESS**2))
    return float(MIRROR + 20.0 * np.log10(ratio * facing))


_GREY = 150


def _halves() -> Volume:
    """Two tissues that scatter little, one below the other."""
    labels = _box()
    z = -0.03 + 0.2e-3 * (np.arange(labels.shape[2]) + 0.5)
    labels[:, :, z > _BORDER] = 2
    return Volume(_like(labels, 40), _placed(), labels, {1: "above", 2: "below"})


def _muscle() -> Volume:
    labels = _box()
    return Volume(_like(labels, _GREY), _placed(), labels, {1: "muscle"})


def _box() -> np.ndarray:
    return np.ones((200, 160, 450), dtype=np.uint8)


def _like(labels: np.ndarray, grey: int) -> np.ndarray:
    return np.full(labels.shape, grey, dtype=np.uint8)


def _placed() -> np.ndarray:
    placed = np.diag([0.5e-3, 0.5e-3, 0.2e-3, 1.0])
    placed[:3, 3] = (-0.05 + 0.25e-3, -0.04 + 0.25e-3, -0.03 + 0.1e-3)
    return placed


def _plot(points: Sequence[Point], name: str, title: str, folder: ReportFolder) -> None:
    figure = new_figure(7.5, 3.8, f"{title}, closed form (lines) and image (marks)")
    panel = figure.subplots()
    for colour, artefact in zip(
        ("C0", "C1"), dict.fromkeys(p.artefact for p in points), strict=True
    ):
        mine = [p for p in points if p.artefact == artefact]
        tilt = [p.tilt_deg for p in mine]
        panel.plot(tilt, [p.expected for p in mine], "-", color=colour)
        panel.plot(tilt, [p.measured for p in mine], "o", color=colour, label=artefact)
    panel.set(xlabel="tilt, degrees", ylabel="dB")
    plain(panel)
    key_beside(panel)
    save(figure, folder.picture(name))
