"""Loss along beams and edges of shadows in images, against closed forms.

>>> from us_sim.evaluation.image.acoustics import compute_loss
>>> down = np.array([0.0, 0.0, 1.0])
>>> float(compute_loss(np.zeros(3), down, np.array([0.01]), 5e6)[0].round(3))  # 1 cm of liver
-4.5
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from us_sim.evaluation.image.measure import make_row, make_tilted_pose
from us_sim.geometry.pose import Pose
from us_sim.slicing.acoustics.settings import Acoustics, TissueAcoustics
from us_sim.slicing.b_mode import BMode
from us_sim.slicing.formation.image_formation import GREYS_PER_DECIBEL
from us_sim.slicing.probe.probe import ConvexProbe, LinearProbe, Probe, SectorProbe
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
from us_sim.volume.volume import Volume

Array = NDArray[np.float64]

GREY = 170  # of all voxels
LAYERS = {
    "liver": (-np.inf, 0.45, 1.657e6),
    "fat": (0.0124, 0.6, 1.327e6),
    "blood": (0.0213, 0.14, 1.679e6),
    "muscle": (0.0301, 0.9, 1.645e6),
}
"""Of each tissue: z (m) in ``patient`` of its top, attenuation (dB/cm/MHz), impedance (Rayl)."""

_live = partial(Acoustics, artefacts="live", surfaces=False)


def measure_attenuation(quick: bool) -> Iterator[dict[str, Any]]:
    """Measure loss through layers: the worst depth of images of voxels of one grey."""
    begins = [begin for begin, *_ in LAYERS.values()]
    volume = _make_volume(
        LAYERS,
        (4e-3, 4e-3, 0.1e-3),
        ((-0.16, 0.16), (-0.16, 0.16), (-0.06, 0.11)),
        lambda _, z: np.searchsorted(begins, z),
    )
    tissues = {
        name: TissueAcoustics(attenuation=attenuation, impedance=impedance)
        for name, (_, attenuation, impedance) in LAYERS.items()
    }
    probes: Mapping[str, tuple[Probe, float]] = {
        "linear": (LinearProbe(aperture=0.04, depth=0.045), 7e6),
        "convex": (ConvexProbe(radius=0.05, opening_angle=np.radians(60), depth=0.07), 3.5e6),
        "sector": (SectorProbe(aperture=0.02, opening_angle=np.radians(80), depth=0.07), 3e6),
    }
    for name, (probe, frequency) in probes.items():
        acoustics = _live(frequency=frequency, compensation=0.5, tissues=tissues)
        scanner = BMode(volume, probe, acoustics=acoustics)
        for degrees in (0.0, 40.0) if quick else (0.0, 10.0, 20.0, 30.0, 40.0):
            for elevational in (False, True) if degrees else (False,):
                pose = make_tilted_pose(degrees, elevational=elevational)
                expected = _compute_expected_levels(probe, pose, acoustics)
                depth, known, shown = _find_worst_depth(probe, scanner.render_image(pose), expected)
                artefact = "attenuation" + ("_elevational" if elevational else "")
                yield make_row(artefact, name, degrees, depth, known, shown, "dB")


def compute_loss(start: Array, direction: Array, distance: Array, frequency: float) -> Array:
    """Compute the gain (dB) of echoes at distances along beams (Beer and Lambert).

    Args:
        start: (…, 3) m, in ``patient``.
        direction: (…, 3) unit vector, in ``patient``.
        distance: (…,) m.
        frequency: Hz.
    """
    z = start[..., 2]
    end = z + direction[..., 2] * distance
    upper, lower = np.minimum(z, end), np.maximum(z, end)
    # A beam along the layers is all in one of them.
    per_depth = np.abs(np.divide(distance, end - z, out=np.zeros_like(end), where=end != z))
    level = np.zeros_like(end)
    begins, attenuations, impedances = np.array(list(LAYERS.values())).T
    for top, bottom, attenuation in zip(begins, [*begins[1:], np.inf], attenuations, strict=True):
        within = np.clip(np.minimum(lower, bottom) - np.maximum(upper, top), 0, None)
        level -= 2.0 * 100.0 * attenuation * frequency * 1e-6 * within * per_depth
    for begin, above, below in zip(begins[1:], impedances, impedances[1:], strict=False):
        passed = (upper < begin) & (lower >= begin)
        level += 20.0 * np.log10(1.0 - ((below - above) / (below + above)) ** 2) * passed
    return level


def _compute_expected_levels(probe: Probe, pose: Pose, acoustics: Acoustics) -> Array:
    """Compute the gain (rows, columns) dB of each pixel; NaN if no beam reaches it."""
    assert acoustics.frequency is not None
    line, distance = probe.pixel_beams.astype(np.float64)
    starts, directions = probe.compute_rays(((line + 0.5) / probe.lines).reshape(-1))
    start = pose.transform_points(np.insert(starts, 1, 0.0, axis=1))
    direction = np.insert(directions, 1, 0.0, axis=1) @ pose.rotation.T
    away = distance.reshape(-1)
    level = compute_loss(start, direction, away, acoustics.frequency)
    level += 2.0 * 100.0 * acoustics.compensation * acoustics.frequency * 1e-6 * away
    return np.asarray(level.reshape(line.shape))


def _find_worst_depth(
    probe: Probe, image: NDArray[np.uint8], expected: Array
) -> tuple[float, float, float]:
    """Find the depth (m) whose mean is most wrong, and that mean: expected and shown, dB."""
    grey = GREY + GREYS_PER_DECIBEL * expected
    usable = (grey > 4.0) & (grey < 250.0)  # between which a mean is not clipped
    shown = expected + (image - grey) / GREYS_PER_DECIBEL
    pixels = {
        "row": (probe.pixel_beams[1] / probe.pixel_spacing[1])[usable].astype(np.intp),
        "expected": expected[usable],
        "shown": shown[usable],
    }
    rows = pd.DataFrame(pixels).groupby("row")
    means = rows.mean()[rows.size() >= 32]  # pixels of a mean
    worst = (means["shown"] - means["expected"]).abs().idxmax()
    depth = (float(worst) + 0.5) * probe.pixel_spacing[1]
    return depth, float(means["expected"][worst]), float(means["shown"][worst])


BLOCK = (-6e-3, 5.2e-3), (14e-3, 18e-3)  # m, x and z of a block of bone
STATES = {
    "rest": (np.eye(3), 0.0),
    # Pressed by 12 %, which makes it wider, and sheared.
    "pressed": (np.array([[1.06, 0.0, 0.08], [0.0, 1.07, 0.0], [0.0, 0.0, 0.88]]), 0.0),
    "slid": (np.eye(3), 3.7e-3),
}
"""Deformation gradient (3, 3) around the bone, and slide (m) of the probe along x."""


def measure_shadows(quick: bool) -> Iterator[dict[str, Any]]:
    """Measure the edges of a bone's shadow, at half of the amplitude: at rest, pressed and slid."""
    (left, right), (top, bottom) = BLOCK
    volume = _make_volume(
        ("muscle", "bone"),
        (0.2e-3, 4e-3, 0.2e-3),
        ((-0.09, 0.09), (-0.02, 0.02), (-0.05, 0.09)),
        lambda x, z: 1 + ((x > left) & (x < right) & (z > top) & (z < bottom)),
    )
    corners = np.array([[x, 0.0, z] for x in BLOCK[0] for z in BLOCK[1]])
    sides = zip(((-0.06, 0.06), (-0.015, 0.015), (-0.04, 0.08)), (9, 4, 8), strict=True)
    carrier = box_mesh(*(uniform_planes(*side, n) for side, n in sides))
    tissues = {
        "muscle": TissueAcoustics(attenuation=0.57, impedance=1.645e6),
        # Opaque: sound through the bone would move the edge.
        "bone": TissueAcoustics(attenuation=20.0, impedance=1e8),
    }
    probes: Mapping[str, tuple[Probe, float]] = {
        "linear": (LinearProbe(aperture=0.04, depth=0.04), 8e6),
        "convex": (ConvexProbe(radius=0.05, opening_angle=np.radians(50), depth=0.06), 4e6),
        "sector": (SectorProbe(aperture=0.02, opening_angle=np.radians(70), depth=0.06), 3e6),
    }
    for name, (probe, frequency) in probes.items():
        acoustics = _live(frequency=frequency, compensation=0.57, tissues=tissues)
        scanner = BMode(volume, probe, acoustics=acoustics)
        scanner.attach_mesh(carrier.nodes, carrier.tetrahedra)
        for degrees in (0.0, 15.0) if quick else (-20.0, -10.0, 0.0, 10.0, 20.0):
            for state, (gradient, slid) in STATES.items():
                pose = Pose(np.array([slid, 0.0, 0.0]), make_tilted_pose(degrees).orientation)
                image = scanner.render_image(pose, carrier.nodes @ gradient.T)
                places = _find_beams(probe, pose, corners @ gradient.T)
                for depth in (0.6 * probe.depth, 0.75 * probe.depth, 0.9 * probe.depth):
                    for edges in _find_edges(probe, image, places, depth):
                        yield make_row(f"shadow_edge_{state}", name, degrees, depth, *edges, "px")


def _find_beams(probe: Probe, pose: Pose, points: Array) -> Array:
    """Find the beams through points (n, 3) m, by bisection: places (n,) from 0 to 1."""
    x, _, z = ((points - pose.position) @ pose.rotation).T
    low, high = np.zeros(len(x)), np.ones(len(x))
    for _ in range(50):
        middle = 0.5 * (low + high)
        starts, directions = probe.compute_rays(middle)
        side = (x - starts[:, 0]) * directions[:, 1] - (z - starts[:, 1]) * directions[:, 0]
        low, high = np.where(side > 0, middle, low), np.where(side > 0, high, middle)
    return 0.5 * (low + high)


def _find_edges(
    probe: Probe, image: NDArray[np.uint8], places: Array, depth: float
) -> Iterator[tuple[float, float]]:
    """Find a shadow's edges at a depth, expected and shown: pixels on the arc from its middle."""
    line, distance = probe.pixel_beams
    near = np.abs(distance - depth) < 1.5 * probe.pixel_spacing[1]
    place = (line[near] + 0.5) / probe.lines
    amplitude = 10.0 ** ((image[near] - float(GREY)) / GREYS_PER_DECIBEL / 20.0)
    count = max(64, int(0.6 * probe.columns))
    bins = np.minimum((place * count).astype(np.intp), count - 1)
    number = np.maximum(np.bincount(bins, minlength=count), 1)
    mean = np.bincount(bins, amplitude, minlength=count) / number
    centre = np.bincount(bins, place, minlength=count) / number
    starts, directions = probe.compute_rays(np.linspace(0.0, 1.0, 129))
    chords = np.diff(starts + depth * directions, axis=0)
    pixels = float(np.linalg.norm(chords, axis=1).sum() / probe.pixel_spacing[0])
    dark = np.flatnonzero(mean < 0.5)
    for expected, inner, outer in (
        (places.min(), dark[0], dark[0] - 1),
        (places.max(), dark[-1], dark[-1] + 1),
    ):
        if 0.08 < expected < 0.92:
            part = (mean[outer] - 0.5) / (mean[outer] - mean[inner])
            found = centre[outer] + part * (centre[inner] - centre[outer])
            yield pixels * (expected - 0.5), pixels * (found - 0.5)


def _make_volume(
    names: Sequence[str] | Mapping[str, Any],
    voxel: tuple[float, float, float],
    extent: Sequence[tuple[float, float]],
    label: Callable[[Array, Array], NDArray[Any]],
) -> Volume:
    """Make voxels (m) of one grey that fill an extent (m), with labels by x and z (m)."""
    x, y, z = (
        low + step * (np.arange(round((high - low) / step), dtype=np.float64) + 0.5)
        for (low, high), step in zip(extent, voxel, strict=True)
    )
    to_patient = np.diag([*voxel, 1.0])
    to_patient[:3, 3] = x[0], y[0], z[0]
    labels = np.empty((len(x), len(y), len(z)), np.uint8)
    labels[:] = label(x[:, None, None], z)
    grey = np.full(labels.shape, GREY, np.uint8)
    return Volume(grey, to_patient, labels, dict(enumerate(names, 1)))
