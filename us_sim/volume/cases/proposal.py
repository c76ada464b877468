"""Where to start and with which probe, for a case that does not say.

A case that knows where it was scanned from starts at one of these poses, so that its first image
is one that was really seen: the middle one, or the one that shows most of the structures.

Else the volume alone tells. Voxels that were never scanned are 0. The region that a spreading probe
has scanned widens with depth, so its distances along the beams are spread unevenly, with a tail
towards the probe: the skewness along the beams is least of all directions, or of those about a
corner of the region; of several corners the probe is at the one where echoes are brightest. A
region without such a direction is taken for one that a linear array has scanned along the rows of
its images, the volume's second axis.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import skew

from us_sim.errors import CaseError
from us_sim.geometry.pose import Placement, Pose
from us_sim.geometry.transducer import ProbeSettings
from us_sim.settings.choice import Chosen
from us_sim.settings.registry import COLLIDERS, PROBES
from us_sim.tissue.elasticity.material import LAYERS, kind_of
from us_sim.volume.cases.settings import SLIDE, CaseSettings, CaseStart
from us_sim.volume.volume import Volume

_MOST_POINTS = 200_000
_FEW_POINTS = 8_000
_DIRECTIONS = 2000
_WIDENS = -0.12
"""Skewness of the distances along the beams below which the region is said to widen with them: a
wedge that becomes half as wide again has -0.2, a box 0."""
_LIKELY = 0.7
"""Fraction of the least skewness, below which directions are tried: a fan of 60 degrees has three
such corners, and echoes are brightest near one of them."""
_BESIDE = 4e-3  # m, from the middle beam, within which the skin is looked for
_FARTHEST = 0.04  # m, along its elevation, that the probe is moved to see structures
_SLID, _SHOWN = 4e-3, 6e-3
"""m: the press slides 8 mm along y; its middle, and half of what it shows."""
_BETTER = 1.02  # times as much in the image, for which another pose is preferred
_ROCK = math.radians(4.0)  # to both sides, in the middle of a whole slide


def with_proposal(settings: CaseSettings, volume: Volume) -> CaseSettings:
    """The settings of a case, with a start and a probe where they say none.

    A start that was proposed is proposed anew: a pose of the sweep where these are known. Where
    the volume has labels, it is the pose whose image shows most of the structures; where no poses
    are known, the probe is moved there along its elevation, on the skin.

    Raises:
        CaseError: nothing was scanned: all voxels are 0.
    """
    start, probe, slide = settings.start, settings.probe, settings.slide
    if start is None or start.proposed:
        poses = [each.pose for each in settings.scanned]
        start = _start(poses[len(poses) // 2]) if poses else proposed_start(volume)
        probe = probe or proposed_probe(volume, start)
        ends = len(poses) // 10  # beside which nothing was seen
        candidates = poses[ends : len(poses) - ends] or _along_skin(volume, start.pose)
        start = _start(_showing_most(settings, volume, start.pose, candidates, probe))
        slide = _slide(volume, start, probe)
    probe = probe or proposed_probe(volume, start)
    if probe.collider is None:
        probe = dataclasses.replace(probe, collider=proposed_collider(probe.array))
    return dataclasses.replace(settings, start=start, probe=probe, slide=slide)


def proposed_start(volume: Volume) -> CaseStart:
    """The pose of a probe in the middle of the scanned region's near side, in the volume's frame.

    Raises:
        CaseError: nothing was scanned: all voxels are 0.
    """
    points, grey = _scanned(volume)
    middle = points.mean(axis=0)
    along, _ = _beams(volume, points, grey)
    aside = points - middle
    aside -= np.outer(aside @ along, along)
    across = np.linalg.eigh(aside.T @ aside)[1][:, -1]  # where the region is widest
    across -= (across @ along) * along
    across /= np.linalg.norm(across)
    if across[np.argmax(np.abs(across))] < 0.0:
        across = -across
    near = np.linalg.norm(aside, axis=1) <= _beside(volume)
    near = near if near.any() else np.ones(len(points), dtype=bool)
    depth = np.percentile((points[near] - middle) @ along, 1.0)
    rotation = np.column_stack([across, np.cross(along, across), along])
    return _start(Pose(middle + depth * along, Rotation.from_matrix(rotation).as_quat()))


def _start(pose: Pose) -> CaseStart:
    x, y, z = (round(float(value), 5) for value in pose.position)
    a, b, c, d = (round(float(value), 6) for value in pose.orientation)
    return CaseStart((x, y, z), (a, b, c, d), proposed=True)


def _showing_most(
    settings: CaseSettings,
    volume: Volume,
    first: Pose,
    candidates: Iterable[Pose],
    probe: ProbeSettings,
) -> Pose:
    """The pose whose image and surroundings show most of the structures; else the first."""
    labels = [
        structure.label
        for name, structure in settings.structures.items()
        if kind_of(name) not in (*LAYERS, "bone")
    ]
    if volume.labels is None or not labels:
        return first
    (structures, _), best, most = _points(volume, np.isin(volume.labels, labels)), first, 0.0
    for pose in candidates:
        seen = _in_image((structures - pose.position) @ pose.rotation, probe)
        shown = float((np.abs(seen[:, 1] - _SLID) < _SHOWN).sum())
        if shown > most * _BETTER:
            best, most = pose, shown
    return best


def _along_skin(volume: Volume, pose: Pose) -> Iterator[Pose]:
    """A pose moved along the probe's y, on the skin."""
    scanned = (_points(volume, volume.intensities)[0] - pose.position) @ pose.rotation
    beam = scanned[np.abs(scanned[:, 0]) < _beside(volume)]
    for offset in np.arange(-_FARTHEST, _FARTHEST + 1e-3, 2e-3):
        depths = beam[np.abs(beam[:, 1] - offset) < _beside(volume), 2]
        skin = float(np.percentile(depths, 1.0)) if len(depths) else np.inf
        if abs(skin) < 0.015:  # m, that the skin may be nearer or farther there
            yield pose @ Pose(np.array([0.0, offset, skin]))


def _slide(volume: Volume, start: CaseStart, probe: ProbeSettings) -> float:
    """m, how far the press may slide along the probe's y while its images show scanned tissue."""
    array: Any = probe.array.settings(PROBES)
    places = np.linspace(0.0, 1.0, 24)
    x, z = np.meshgrid(array.width * (places - 0.5), array.depth * places)
    image = _in_image(np.column_stack([x.ravel(), np.zeros(x.size), z.ravel()]), probe)

    def shown(pose: Pose) -> float:
        """Part of the image at a pose beside the start that shows something."""
        placed = (start.pose @ pose).apply(image)
        index = np.rint(placed @ volume.patient_to_index[:3, :3].T + volume.patient_to_index[:3, 3])
        inside = ((index >= 0) & (index < volume.shape)).all(axis=1)
        found = volume.intensities[tuple(index[inside].astype(np.int64).T)] > 0
        return float(found.sum() / len(image))

    least = 0.9 * shown(Pose())
    for part in np.linspace(1.0, 0.0, 8, endpoint=False):
        for slide in (part * SLIDE, -part * SLIDE):
            rocked = [Rotation.from_euler("x", sign * part * _ROCK).as_quat() for sign in (-1, 1)]
            poses = [Pose(np.array([0.0, slide / 2, 0.0]), turned) for turned in rocked]
            poses += [Pose(np.array([0.0, y, 0.0])) for y in (slide / 4, 0.75 * slide, slide)]
            if all(shown(pose) >= least for pose in poses):
                return round(float(slide), 4)
    return 0.0


def _in_image(seen: NDArray[np.float64], probe: ProbeSettings) -> NDArray[np.float64]:
    """Of points (N, 3) m in the probe's frame, those in front of and behind its image."""
    array: Any = probe.array.settings(PROBES)
    widest = array.width / 2 * np.clip(seen[:, 2] / array.depth, 0.3, 1.0)
    inside = (np.abs(seen[:, 0]) < widest) & (seen[:, 2] > 0.0) & (seen[:, 2] < array.depth)
    return seen[inside]


def proposed_probe(volume: Volume, start: Placement) -> ProbeSettings:
    """A curved array where the scanned region widens with depth, else a linear one; as deep as it.

    Raises:
        CaseError: nothing was scanned.
    """
    points, grey = _scanned(volume)
    _, widens = _beams(volume, points, grey)
    placed = (points - start.pose.position) @ start.pose.rotation
    depth = float(np.clip(np.percentile(placed[:, 2], 99.5), 0.01, 0.25))  # m
    width = 2 * float(np.percentile(np.abs(placed[:, 0]), 99.0))
    values: dict[str, float]
    if widens:
        kind, values = "convex", {"radius": 0.05, "opening_angle": math.radians(60.0)}
    else:
        kind, values = "linear", {"aperture": float(np.clip(width, 5e-3, 0.05))}
    made: Any = PROBES.settings(kind)
    array = Chosen(kind, made(**values, depth=round(depth, 4)))
    return ProbeSettings(array=array, image=512, collider=proposed_collider(array))


def proposed_collider(array: Chosen) -> Chosen:
    """The shape of a probe's head around its array, as large as the usual ones are."""
    given: Any = array.settings(PROBES)
    if array.name == "convex":
        chord = 2 * given.radius * math.sin(given.opening_angle / 2)
        name, size = "convex", {"radius": given.radius, "length": round(chord + 0.011, 4)}
        size |= {"width": 0.018, "height": 0.06, "rounding": 0.006}
    else:
        name, size = "rounded_box", {"length": getattr(given, "aperture", 0.02) + 0.006}
        size |= {"width": 0.014, "height": 0.04, "rounding": 0.004}
    kind: Any = COLLIDERS.settings(name)
    return Chosen(name, kind(**size))


def _beside(volume: Volume) -> float:
    """m, from the middle beam, within which the skin is looked for; a voxel or more."""
    return max(_BESIDE, float(np.linalg.norm(volume.index_to_patient[:3, :3], axis=0).max()))


def _points(
    volume: Volume, values: NDArray[Any], most: int = 5 * _MOST_POINTS
) -> tuple[NDArray[np.float64], NDArray[Any]]:
    """Centres (N, 3) m of voxels whose values (i, j, k) are not 0, and these values (N,).

    Only every so many voxels are looked at, so that there are few enough of them.
    """
    step = max(1, math.ceil((values.size / most) ** (1 / 3)))
    coarse = values[::step, ::step, ::step]
    matrix = volume.index_to_patient
    points = (np.argwhere(coarse) * step) @ matrix[:3, :3].T + matrix[:3, 3]
    return np.asarray(points), coarse[coarse != 0]


def _scanned(volume: Volume) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    points, grey = _points(volume, volume.intensities, _MOST_POINTS)
    if not len(points):
        raise CaseError("all voxels of the volume are 0, so there is nothing to scan")
    return points, grey


def _beams(
    volume: Volume, points: NDArray[np.float64], grey: NDArray[np.uint8]
) -> tuple[NDArray[np.float64], bool]:
    """The unit direction (3,) of the beams, and whether the region widens along them."""
    aside = points - points.mean(axis=0)
    brighter = np.average(aside, axis=0, weights=grey)  # m, from the middle to the brighter side
    # At random, since every so many would lie on a few planes.
    few = np.random.default_rng(0).permutation(aside)[:_FEW_POINTS]
    directions = _spiral(_DIRECTIONS)
    parts = np.array_split(directions, 20)
    skewness = np.concatenate([skew(few @ part.T) for part in parts])
    likely = skewness <= _LIKELY * skewness.min()
    side = np.argmin(np.where(likely, skewness + directions @ brighter / aside.std(), np.inf))
    near = directions @ directions[side] > 0.9  # cosine of directions about the same corner
    best = int(np.argmin(np.where(near, skewness, np.inf)))
    if skewness[best] < _WIDENS:
        return directions[best], True
    rows = volume.index_to_patient[:3, 1]
    return rows / np.linalg.norm(rows), False


def _spiral(count: int) -> NDArray[np.float64]:
    """(count, 3) unit vectors spread evenly over a sphere (Gonzalez, Math Geosci 42:49, 2010)."""
    height = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    turn = math.pi * (3.0 - math.sqrt(5.0)) * np.arange(count)
    ring = np.sqrt(1.0 - height**2)
    return np.column_stack([ring * np.cos(turn), ring * np.sin(turn), height])
