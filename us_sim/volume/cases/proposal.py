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
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from us_sim.errors import CaseError
from us_sim.geometry.pose import Pose
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
_BESIDE = 4e-3  # m, from the middle beam, within which the skin is looked for; a voxel or more
_FARTHEST = 0.04  # m, along its elevation, that the probe is moved to see structures
_SLID, _SHOWN = 4e-3, 6e-3
"""m: the press slides 8 mm along y; its middle, and half of what it shows."""
_BETTER = 1.02  # times as much in the image, for which another pose is preferred
_ROCK = math.radians(4.0)  # to both sides, in the middle of a whole slide


def with_proposal(settings: CaseSettings, volume: Volume) -> CaseSettings:
    """Propose a start and a probe for a case that says none.

    A start that was proposed is proposed anew: a pose of the sweep where these are known. Where
    the volume has labels, it is the pose whose image shows most of the structures; where no poses
    are known, the probe is moved there along its elevation, on the skin.

    Raises:
        CaseError: nothing was scanned: all voxels are 0.
    """
    start, probe, slide = settings.start, settings.probe, settings.slide
    region = ScannedRegion(volume)
    if start is None or start.proposed:
        poses = [each.pose for each in settings.scanned]
        first = poses[len(poses) // 2] if poses else region.middle_pose()
        probe = probe or region.probe_at(first)
        ends = len(poses) // 10  # beside which nothing was seen
        candidates = poses[ends : len(poses) - ends] or region.poses_along_skin(first)
        pose = _showing_most(settings, volume, first, candidates, probe)
        x, y, z = (round(float(value), 5) for value in pose.position)
        a, b, c, d = (round(float(value), 6) for value in pose.orientation)
        start = CaseStart((x, y, z), (a, b, c, d), proposed=True)
        slide = _slide(volume, start, probe)
    probe = probe or region.probe_at(start.pose)
    if probe.collider is None:
        probe = dataclasses.replace(probe, collider=proposed_collider(probe.array))
    return dataclasses.replace(settings, start=start, probe=probe, slide=slide)


class ScannedRegion:
    """The part of a volume that was scanned: its voxels that are not 0."""

    def __init__(self, volume: Volume) -> None:
        self._volume = volume
        voxel = np.linalg.norm(volume.index_to_patient[:3, :3], axis=0).max()
        self._beside = max(_BESIDE, float(voxel))

    @cached_property
    def _points(self) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
        """Places (N, 3) m and grey values (N,) of some voxels.

        Raises:
            CaseError: there is none.
        """
        points, grey = _places(self._volume, self._volume.intensities, _MOST_POINTS)
        if not len(points):
            raise CaseError("all voxels of the volume are 0, so there is nothing to scan")
        return points, grey

    @cached_property
    def _beams(self) -> tuple[NDArray[np.float64], bool]:
        """The unit direction (3,) of the beams, and whether the region widens along them."""
        points, grey = self._points
        aside = points - points.mean(axis=0)
        brighter = np.average(aside, axis=0, weights=grey)  # m, from the middle to the brighter
        # At random, since every so many would lie on a few planes.
        few = np.random.default_rng(0).permutation(aside)[:_FEW_POINTS]
        # Directions spread evenly over a sphere (Gonzalez, Math Geosci 42:49, 2010).
        height = 1.0 - (2.0 * np.arange(_DIRECTIONS) + 1.0) / _DIRECTIONS
        turn, ring = (
            math.pi * (3.0 - math.sqrt(5.0)) * np.arange(_DIRECTIONS),
            np.sqrt(1 - height**2),
        )
        directions = np.column_stack([ring * np.cos(turn), ring * np.sin(turn), height])
        skewness = np.concatenate([_skewness(few @ d.T) for d in np.array_split(directions, 20)])
        likely = skewness <= _LIKELY * skewness.min()
        side = np.argmin(np.where(likely, skewness + directions @ brighter / aside.std(), np.inf))
        near = directions @ directions[side] > 0.9  # cosine of directions about the same corner
        best = int(np.argmin(np.where(near, skewness, np.inf)))
        if skewness[best] < _WIDENS:
            return directions[best], True
        rows = self._volume.index_to_patient[:3, 1]
        return rows / np.linalg.norm(rows), False

    def middle_pose(self) -> Pose:
        """The pose of a probe in the middle of the region's near side, in the volume's frame.

        Raises:
            CaseError: nothing was scanned.
        """
        points, _ = self._points
        middle, (along, _) = points.mean(axis=0), self._beams
        aside = points - middle
        aside -= np.outer(aside @ along, along)
        across = np.linalg.eigh(aside.T @ aside)[1][:, -1]  # where the region is widest
        across -= (across @ along) * along
        across /= np.linalg.norm(across) * np.sign(across[np.argmax(np.abs(across))])
        near = np.linalg.norm(aside, axis=1) <= self._beside
        depth = np.percentile((points[near if near.any() else slice(None)] - middle) @ along, 1.0)
        rotation = np.column_stack([across, np.cross(along, across), along])
        return Pose(middle + depth * along, Rotation.from_matrix(rotation).as_quat())

    def probe_at(self, pose: Pose) -> ProbeSettings:
        """A curved array where the region widens with depth, else a linear one; as deep as it.

        Raises:
            CaseError: nothing was scanned.
        """
        placed = (self._points[0] - pose.position) @ pose.rotation
        depth = float(np.clip(np.percentile(placed[:, 2], 99.5), 0.01, 0.25))  # m
        width = 2 * float(np.percentile(np.abs(placed[:, 0]), 99.0))
        kind, values = "linear", {"aperture": float(np.clip(width, 5e-3, 0.05))}
        if self._beams[1]:
            kind, values = "convex", {"radius": 0.05, "opening_angle": math.radians(60.0)}
        made: Any = PROBES.settings(kind)
        array = Chosen(kind, made(**values, depth=round(depth, 4)))
        return ProbeSettings(array=array, image=512, collider=proposed_collider(array))

    def poses_along_skin(self, pose: Pose) -> Iterator[Pose]:
        """A pose moved along the probe's y, on the skin."""
        points, _ = _places(self._volume, self._volume.intensities)
        scanned = (points - pose.position) @ pose.rotation
        beam = scanned[np.abs(scanned[:, 0]) < self._beside]
        for offset in np.arange(-_FARTHEST, _FARTHEST + 1e-3, 2e-3):
            depths = beam[np.abs(beam[:, 1] - offset) < self._beside, 2]
            skin = float(np.percentile(depths, 1.0)) if len(depths) else np.inf
            if abs(skin) < 0.015:  # m, that the skin may be nearer or farther there
                yield pose @ Pose(np.array([0.0, offset, skin]))


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
    structures, _ = _places(volume, np.isin(volume.labels, labels))
    array: Any = probe.array.settings(PROBES)
    best, most = first, 0.0
    for pose in candidates:
        seen = (structures - pose.position) @ pose.rotation
        shown = float((_in_image(seen, array) & (np.abs(seen[:, 1] - _SLID) < _SHOWN)).sum())
        if shown > most * _BETTER:
            best, most = pose, shown
    return best


def _slide(volume: Volume, start: CaseStart, probe: ProbeSettings) -> float:
    """m, how far the press may slide along the probe's y while its images show scanned tissue."""
    array: Any = probe.array.settings(PROBES)
    places = np.linspace(0.0, 1.0, 24)
    x, z = np.meshgrid(array.width * (places - 0.5), array.depth * places)
    image = np.column_stack([x.ravel(), np.zeros(x.size), z.ravel()])
    image = image[_in_image(image, array)]

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


def _in_image(seen: NDArray[np.float64], array: Any) -> NDArray[np.bool_]:
    """Whether points (N, 3) m in the probe's frame are in, before or behind its image."""
    widest = array.width / 2 * np.clip(seen[:, 2] / array.depth, 0.3, 1.0)
    return (np.abs(seen[:, 0]) < widest) & (seen[:, 2] > 0.0) & (seen[:, 2] < array.depth)


def _places(
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


def _skewness(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of each column; SciPy's takes three times as long."""
    away = values - values.mean(axis=0)
    square = away * away
    return np.asarray((square * away).mean(axis=0) / square.mean(axis=0) ** 1.5)
