"""Loss, shadows, and echoes by the angle of the beam, against closed forms.

>>> from us_sim.evaluation.image.acoustics import corners
>>> np.round(corners(np.eye(3))[0] * 1e3, 3)  # mm, x and z of one
array([-6., 14.])
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.image.measure import (
    GREY,
    LAYERS,
    PROBES,
    layered_volume,
    lost,
    row_of,
    tilted,
    voxel_grid,
)
from us_sim.geometry.pose import Pose
from us_sim.slicing.acoustics.settings import Acoustics, TissueAcoustics
from us_sim.slicing.acoustics.surface_echo import MIRROR, ROUGHNESS
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.formation.image_formation import GREYS_PER_DECIBEL
from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe, Probe, SectorProbe
from us_sim.slicing.settings import ECHO_RANGE
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.volume.volume import Volume

Array = NDArray[np.float64]
Row: TypeAlias = "dict[str, Any]"

_LOW, _HIGH = (-6e-3, 14e-3), (5.2e-3, 18e-3)  # m, x and z of a block of bone
_PROBE = LinearProbe(aperture=0.03, depth=0.03)
_live = partial(Acoustics, artefacts="live", surfaces=False)


def attenuation_rows(quick: bool) -> Iterator[Row]:
    """Images of layers of one grey, whose levels are the loss alone (Beer and Lambert)."""
    volume = layered_volume()
    tissues = {
        layer.name: TissueAcoustics(attenuation=layer.attenuation, impedance=layer.impedance)
        for layer in LAYERS
    }
    for name, frequency in (("linear", 7e6), ("convex", 3.5e6), ("sector", 3e6)):
        acoustics = _live(frequency=frequency, compensation=0.5, tissues=tissues)
        probe = PROBES[name]
        scanner = BMode(volume, probe, acoustics=acoustics)
        for degrees in (0.0, 40.0) if quick else (0.0, 10.0, 20.0, 30.0, 40.0):
            for direction in (False, True) if degrees else (False,):
                pose = tilted(degrees, elevational=direction)
                artefact = "attenuation" + ("_elevational" if direction else "")
                image = scanner.image(pose)
                expected = _expected_levels(probe, pose, acoustics)
                yield from _worst_depths(artefact, name, degrees, probe, image, expected)


def _expected_levels(probe: Probe, pose: Pose, acoustics: Acoustics) -> Array:
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


def _worst_depths(
    artefact: str,
    name: str,
    degrees: float,
    probe: Probe,
    image: NDArray[np.uint8],
    expected: Array,
) -> Iterator[Row]:
    """The depth with the greatest error in each twelfth of the depth."""
    grey = GREY + GREYS_PER_DECIBEL * expected
    usable = (grey > 4.0) & (grey < 250.0)  # between which a mean is not clipped
    bins = np.where(usable, probe.pixel_beams[1] / probe.pixel_spacing[1], -1.0).astype(np.intp)
    count = bins.max() + 1
    flat, shown = bins[usable], (image - grey)[usable] / GREYS_PER_DECIBEL
    number = np.bincount(flat, minlength=count)
    off = np.bincount(flat, shown, minlength=count) / np.maximum(number, 1)
    mean = np.bincount(flat, expected[usable], minlength=count) / np.maximum(number, 1)
    off[number < 32] = 0.0  # pixels of a mean
    for part in np.array_split(np.arange(count), 12):
        at = part[np.argmax(np.abs(off[part]))]
        depth = (at + 0.5) * probe.pixel_spacing[1]
        shown_level = float(mean[at] + off[at])
        yield row_of(artefact, name, degrees, float(depth), float(mean[at]), shown_level, "dB")


STATES = {
    "rest": (np.eye(3), 0.0),
    # Pressed by 12 %, which makes it wider, and sheared.
    "pressed": (np.array([[1.06, 0.0, 0.08], [0.0, 1.07, 0.0], [0.0, 0.0, 0.88]]), 0.0),
    "slid": (np.eye(3), 3.7e-3),
}
"""Gradients (3, 3) of the deformation around the bone, and m by which the probe is slid along x."""


def _bone_volume() -> Volume:
    """Muscle with a block of bone through all of it along y; borders are those of voxels."""
    voxel = (0.2e-3, 4e-3, 0.2e-3)  # m
    counts, to_patient = voxel_grid(((-0.09, 0.09), (-0.02, 0.02), (-0.05, 0.09)), voxel)
    x, z = (to_patient[axis, 3] + voxel[axis] * np.arange(counts[axis]) for axis in (0, 2))
    inside = ((x > _LOW[0]) & (x < _HIGH[0]))[:, None] & ((z > _LOW[1]) & (z < _HIGH[1]))
    labels = np.ones(counts, dtype=np.uint8)
    labels[np.broadcast_to(inside[:, None], labels.shape)] = 2
    grey = np.full(counts, GREY, dtype=np.uint8)
    return Volume(grey, to_patient, labels, {1: "muscle", 2: "bone"})


def corners(gradient: Array) -> Array:
    """(4, 2) m: x and z of the block's corners, in the plane y = 0."""
    rest = np.array([[x, 0.0, z] for x in (_LOW[0], _HIGH[0]) for z in (_LOW[1], _HIGH[1])])
    return (rest @ gradient.T)[:, [0, 2]]


def _line_through(probe: Probe, pose: Pose, points: Array) -> Array:
    """(n,) place among all beams, 0 to 1, of those through points (n, 2), x and z, by bisection."""
    at = np.column_stack([points[:, 0], np.zeros(len(points)), points[:, 1]]) - pose.position
    x, _, z = (at @ pose.rotation).T
    low, high = np.zeros(len(x)), np.ones(len(x))
    for _ in range(50):
        middle = 0.5 * (low + high)
        starts, directions = probe.rays(middle)
        side = (x - starts[:, 0]) * directions[:, 1] - (z - starts[:, 1]) * directions[:, 0]
        low, high = np.where(side > 0, middle, low), np.where(side > 0, high, middle)
    return 0.5 * (low + high)


def shadow_rows(quick: bool) -> Iterator[Row]:
    """A shadow of bone at rest, pressed, and as the probe slides: half of the amplitude is left."""
    volume = _bone_volume()
    sides = zip(((-0.06, 0.06), (-0.015, 0.015), (-0.04, 0.08)), (9, 4, 8), strict=True)
    carrier = box_mesh(*(uniform_planes(*side, n) for side, n in sides))
    tissues = {
        "muscle": TissueAcoustics(attenuation=0.57, impedance=1.645e6),
        # Opaque: sound that bone lets through would move the place of half of the amplitude.
        "bone": TissueAcoustics(attenuation=20.0, impedance=1e8),
    }
    probes: dict[str, tuple[Probe, float]] = {
        "linear": (LinearProbe(aperture=0.04, depth=0.04), 8e6),
        "convex": (ConvexProbe(radius=0.05, opening_angle=np.radians(50), depth=0.06), 4e6),
        "sector": (SectorProbe(aperture=0.02, opening_angle=np.radians(70), depth=0.06), 3e6),
    }
    for name, (probe, frequency) in probes.items():
        scanner = BMode(
            volume, probe, acoustics=_live(frequency=frequency, compensation=0.57, tissues=tissues)
        )
        scanner.carry(carrier.nodes, carrier.tetrahedra)
        for degrees in (0.0, 15.0) if quick else (-20.0, -10.0, 0.0, 10.0, 20.0):
            for state, (gradient, slid) in STATES.items():
                pose = Pose(np.array([slid, 0.0, 0.0]), tilted(degrees).orientation)
                image = scanner.image(pose, carrier.nodes @ gradient.T)
                places = _line_through(probe, pose, corners(gradient))
                artefact = f"shadow_edge_{state}"
                for part in (0.6, 0.75, 0.9):
                    depth = part * probe.depth
                    yield from _edges(artefact, name, degrees, probe, image, places, depth)


def _edges(
    artefact: str,
    name: str,
    degrees: float,
    probe: Probe,
    image: NDArray[np.uint8],
    places: Array,
    depth: float,
) -> Iterator[Row]:
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
    for expected, sign in ((places.min(), 1), (places.max(), -1)):
        if not 0.08 < expected < 0.92:
            continue
        dark = np.flatnonzero(mean < 0.5)
        if not len(dark):
            raise ArithmeticError(f"{artefact}, {name}, {degrees:g}°: there is no shadow")
        inner = dark[0] if sign > 0 else dark[-1]
        outer = inner - sign
        part = (mean[outer] - 0.5) / (mean[outer] - mean[inner])
        found = centre[outer] + part * (centre[inner] - centre[outer])
        row = (artefact, name, degrees, depth, pixels * (expected - 0.5), pixels * (found - 0.5))
        yield row_of(*row, "px")


def surface_rows(quick: bool) -> Iterator[Row]:
    """The echo of a flat border, by the angle between beam and normal, in the plane and out."""
    border, above, below = 0.0152, 1.5e6, 1.8e6  # m along z, and Rayl
    labels = np.ones(_BOX, dtype=np.uint8)
    z = -0.03 + 0.2e-3 * (np.arange(labels.shape[2]) + 0.5)
    labels[:, :, z > border] = 2
    # Two tissues that scatter little, one below the other.
    grey = np.full(labels.shape, 40, dtype=np.uint8)
    volume = Volume(grey, _box_placed(), labels, {1: "above", 2: "below"})
    media = {
        "above": TissueAcoustics(attenuation=0.5, impedance=above),
        "below": TissueAcoustics(attenuation=0.5, impedance=below),
    }
    acoustics = _live(
        frequency=6e6, compensation=0.5, tissues=media, surfaces=True, anisotropy=False
    )
    scanner = BMode(volume, _PROBE, acoustics=acoustics)
    ratio = (below - above) / (below + above)
    for degrees in _ANGLES[::2] if quick else _ANGLES:
        facing = np.exp(-(np.tan(np.radians(degrees)) ** 2) / (2 * ROUGHNESS**2))
        expected = float(MIRROR + 20.0 * np.log10(ratio * facing))  # dB; 0 is the strongest
        for elevational in (False, True):
            pose = tilted(degrees, elevational=elevational)
            shown = [
                scanner.image(Pose(np.array([0.0, y, 0.0]), pose.orientation)).max(axis=0)
                for y in np.arange(0.0, 8e-3, 0.5e-3)  # a voxel each, along the grain
            ]
            level = float(np.mean(shown)) / GREYS_PER_DECIBEL - ECHO_RANGE
            name = "surface" + ("_elevational" if elevational else "")
            yield row_of(name, "linear", degrees, border, expected, level, "dB")


def fibre_rows(quick: bool) -> Iterator[Row]:
    """Echoes of muscle by the angle between beam and fibres, at rest and sheared."""
    grey = 150
    muscle = TissueAcoustics(
        attenuation=0.57,
        impedance=1.645e6,
        fibres=(0.0, 1.0, 0.0),
        anisotropy=14.0,
        half_angle=0.3,
    )
    labels = np.ones(_BOX, dtype=np.uint8)
    acoustics = _live(frequency=6e6, compensation=0.57, tissues={"muscle": muscle})
    volume = Volume(np.full(_BOX, grey, np.uint8), _box_placed(), labels, {1: "muscle"})
    scanner = BMode(volume, _PROBE, acoustics=acoustics)
    sides = ((-0.05, 0.05), (-0.04, 0.04), (-0.03, 0.06))
    carrier = box_mesh(*(uniform_planes(*side, 6) for side in sides))
    scanner.carry(carrier.nodes, carrier.tetrahedra)
    sheared = carrier.nodes.copy()
    sheared[:, 2] += SHEAR * sheared[:, 1]
    for degrees in _ANGLES[::2] if quick else _ANGLES:
        for name, nodes, lean in (
            ("anisotropy", carrier.nodes, 0.0),
            ("anisotropy_sheared", sheared, np.arctan(SHEAR)),
        ):
            pose = Pose(np.zeros(3), tilted(degrees, elevational=True).orientation)
            image = scanner.image(pose, nodes)[100:400, 100:400]
            shown = float(image.mean() - grey) / GREYS_PER_DECIBEL
            square = np.sin(np.radians(degrees) - lean) ** 2
            half = np.sin(muscle.half_angle) ** 2
            expected = -muscle.anisotropy * square / (square + half)
            yield row_of(name, "linear", degrees, 0.015, expected, shown, "dB")


SHEAR = 0.15  # m along z a metre along y
_ANGLES = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0)
_BOX = (200, 160, 450)  # voxels


def _box_placed() -> Array:
    placed = np.diag([0.5e-3, 0.5e-3, 0.2e-3, 1.0])
    placed[:3, 3] = (-0.05 + 0.25e-3, -0.04 + 0.25e-3, -0.03 + 0.1e-3)
    return placed
