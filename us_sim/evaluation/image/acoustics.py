"""A block of bone in muscle, at rest, pressed and slid over, and where its shadow's edges are.

>>> import numpy as np
>>> from us_sim.evaluation.image.acoustics import STATES, corners
>>> np.round(corners(STATES["rest"])[0] * 1e3, 3)  # mm, x and z of one
array([-6., 14.])

Loss along the beams, in layers whose loss is known in closed form (Beer and Lambert).

What lies behind fluid is brighter than what lies beside it.

Where the shadow of a block of bone ends, at rest, pressed, and as the probe slides.

Brightness that depends on the angle of the beam: of surfaces and of fibres, in closed form.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.image.measure import (
    LAYER_GREY,
    LAYERS,
    PROBES,
    Artefact,
    Point,
    layered_volume,
    lost,
    tilted,
)
from us_sim.evaluation.report import (
    ReportFolder,
    Target,
    key_beside,
    markdown_table,
    new_figure,
    plain,
    save,
)
from us_sim.geometry.pose import Pose
from us_sim.slicing.acoustics.media import crossing_loss
from us_sim.slicing.acoustics.settings import Acoustics, TissueAcoustics
from us_sim.slicing.acoustics.surface_echo import MIRROR, ROUGHNESS
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.formation.image_formation import GREYS_PER_DECIBEL
from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe, Probe, SectorProbe
from us_sim.slicing.settings import ECHO_RANGE
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, box_mesh, uniform_planes
from us_sim.volume.volume import Volume

GREY = 170
_LOW, _HIGH = (-6e-3, 14e-3), (5.2e-3, 18e-3)  # m, x and z of the block
HEIGHT = _HIGH[1] - _LOW[1]
"""m, of the block."""
_EXTENT = ((-0.09, 0.09), (-0.02, 0.02), (-0.05, 0.09))  # m
_VOXEL = (0.2e-3, 4e-3, 0.2e-3)  # m


@dataclass(frozen=True, eq=False)
class State:
    """What has happened to tissue and probe."""

    gradient: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    """(3, 3) of the deformation, the same everywhere."""
    slid: float = 0.0  # m, of the probe along x


STATES = {
    "rest": State(),
    # Pressed by 12 %, which makes it wider, and sheared.
    "pressed": State(np.array([[1.06, 0.0, 0.08], [0.0, 1.07, 0.0], [0.0, 0.0, 0.88]])),
    "slid": State(slid=3.7e-3),
}


def bone_volume() -> Volume:
    """Muscle with a block of bone through all of it along y; borders are those of voxels."""
    counts = [round((high - low) / step) for (low, high), step in zip(_EXTENT, _VOXEL, strict=True)]
    to_patient = np.diag([*_VOXEL, 1.0])
    to_patient[:3, 3] = [low + 0.5 * step for (low, _), step in zip(_EXTENT, _VOXEL, strict=True)]
    x, z = (to_patient[axis, 3] + _VOXEL[axis] * np.arange(counts[axis]) for axis in (0, 2))
    inside = ((x > _LOW[0]) & (x < _HIGH[0]))[:, None] & ((z > _LOW[1]) & (z < _HIGH[1]))
    labels = np.ones(counts, dtype=np.uint8)
    labels[np.broadcast_to(inside[:, None], labels.shape)] = 2
    grey = np.full(counts, GREY, dtype=np.uint8)
    return Volume(grey, to_patient, labels, {1: "muscle", 2: "bone"})


def mesh() -> TetrahedralMesh:
    """That carries the volume, some of it."""
    sides = ((-0.06, 0.06), (-0.015, 0.015), (-0.04, 0.08))
    return box_mesh(*(uniform_planes(*side, n) for side, n in zip(sides, (9, 4, 8), strict=True)))


def corners(state: State) -> NDArray[np.float64]:
    """(4, 2) m: x and z of the block's corners, in the plane y = 0."""
    rest = np.array([[x, 0.0, z] for x in (_LOW[0], _HIGH[0]) for z in (_LOW[1], _HIGH[1])])
    return (rest @ state.gradient.T)[:, [0, 2]]


def line_through(probe: Probe, pose: Pose, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) the place among all beams, 0 to 1, of those through points (n, 2), x and z.

    Found by halving: a beam has the point on its left or on its right.
    """
    at = np.column_stack([points[:, 0], np.zeros(len(points)), points[:, 1]]) - pose.position
    x, _, z = (at @ pose.rotation).T
    low, high = np.zeros(len(x)), np.ones(len(x))
    for _ in range(50):
        middle = 0.5 * (low + high)
        starts, directions = probe.rays(middle)
        side = (x - starts[:, 0]) * directions[:, 1] - (z - starts[:, 1]) * directions[:, 0]
        low, high = np.where(side > 0, middle, low), np.where(side > 0, high, middle)
    return 0.5 * (low + high)


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
    grey = LAYER_GREY + GREYS_PER_DECIBEL * expected
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


_PROBE = LinearProbe(aperture=0.03, depth=0.03)
_FLUID_FREQUENCY = 8e6  # Hz
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
            artefacts="live", frequency=_FLUID_FREQUENCY, compensation=0.57, surfaces=False,
            tissues=tissues,
        )  # fmt: skip
        scanner = BMode(volume, _PROBE, acoustics=acoustics)
        found = []
        for degrees in (0.0, 5.0, 10.0):
            image = scanner.image(Pose(np.zeros(3), tilted(degrees).orientation))
            behind = image[400:430, 250:262]  # of the middle beams
            shown = float(behind.mean() - GREY) / GREYS_PER_DECIBEL
            length = HEIGHT / np.cos(np.radians(degrees))
            spared = 200.0 * (_MUSCLE[0] - _FLUID[0]) * _FLUID_FREQUENCY * 1e-6 * length
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


_ANGLES = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0)
_BORDER = 0.0152  # m, along z
_ABOVE, _BELOW = 1.5e6, 1.8e6  # Rayl
_SHEAR = 0.15  # m along z a metre along y
_STRIPED = TissueAcoustics(
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
        for degrees in _ANGLES[::2] if quick else _ANGLES:
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
            tissues={"muscle": _STRIPED},
        )
        scanner = BMode(volume, _PROBE, acoustics=acoustics)
        sides = ((-0.05, 0.05), (-0.04, 0.04), (-0.03, 0.06))
        carrier = box_mesh(*(uniform_planes(*side, 6) for side in sides))
        scanner.carry(carrier.nodes, carrier.tetrahedra)
        sheared = carrier.nodes.copy()
        sheared[:, 2] += _SHEAR * sheared[:, 1]
        found = []
        for degrees in _ANGLES[::2] if quick else _ANGLES:
            for name, nodes, lean in (
                (self.name, carrier.nodes, 0.0),
                (f"{self.name}_sheared", sheared, np.arctan(_SHEAR)),
            ):
                pose = Pose(np.zeros(3), tilted(degrees, elevational=True).orientation)
                image = scanner.image(pose, nodes)[100:400, 100:400]
                shown = float(image.mean() - _GREY) / GREYS_PER_DECIBEL
                square = np.sin(np.radians(degrees) - lean) ** 2
                half = np.sin(_STRIPED.half_angle) ** 2
                expected = -_STRIPED.anisotropy * square / (square + half)
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
