"""A start and a probe for a case that does not say them.

A case that knows where it was scanned from starts at one of these poses, so that its first image
is one that was really seen: the middle one, or the one that shows most of the structures. Any
other volume is taken for one that a linear array has scanned: its first axis lies along the array,
and its second one, along the columns of its images, goes into the body. There the face touches
what was scanned, wherever that begins below it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from us_sim.errors import CaseError
from us_sim.geometry.pose import Placement, Pose
from us_sim.geometry.transducer import ProbeSettings
from us_sim.settings.choice import ChosenOption
from us_sim.settings.registry import COLLIDERS, PROBES
from us_sim.tissue.elasticity.material import LAYERS, guess_tissue_kind
from us_sim.volume.cases.settings import CaseSettings, CaseStart
from us_sim.volume.volume import Volume, compute_grid_extent

_MOST_POINTS = 1_000_000
_SLID, _SHOWN = 4e-3, 6e-3
"""m: the press slides 8 mm along y; its middle, and half of what it shows."""
_FLAT = 0.01  # m, in the middle of a curved face, that counts as flat
_BETTER = 1.02  # times as much in the image, for which another pose is preferred


def complete_settings(settings: CaseSettings, volume: Volume) -> CaseSettings:
    """Propose a start, a probe and its collider for a case that says none.

    A start that was proposed is proposed anew.

    Raises:
        CaseError: nothing was scanned: all voxels are 0.
    """
    start, probe = settings.start, settings.probe
    points = _places(volume, volume.intensities > 0)
    if not len(points):
        raise CaseError("all voxels of the volume are 0, so there is nothing to scan")
    if start is None or start.proposed:
        poses = [each.pose for each in settings.scanned] or [_pose_above(points, volume)]
        seen_by = probe or _probe_at(poses[len(poses) // 2], points)
        pose = _showing_most(settings, volume, poses, seen_by)
        at = round_pose(pose)
        at = at if settings.scanned else move_to_skin(at, volume, seen_by)
        start = CaseStart(at.position, at.orientation, proposed=True)
    probe = probe or _probe_at(start.pose, points)
    if probe.collider is None:
        probe = replace(probe, collider=propose_collider(probe.array))
    return replace(settings, start=start, probe=probe)


def round_pose(pose: Pose) -> Placement:
    """Return a pose to 0.01 mm and a millionth, as a person reads it."""
    x, y, z = (round(float(value), 5) for value in pose.position)
    a, b, c, d = (round(float(value), 6) for value in pose.orientation)
    return Placement((x, y, z), (a, b, c, d))


def propose_collider(array: ChosenOption) -> ChosenOption:
    """Propose the shape of a probe's head around its array, as large as the usual ones are."""
    given: Any = array.resolve_settings(PROBES)
    if array.name == "convex":
        chord = 2 * given.radius * math.sin(given.opening_angle / 2)
        name, size = "convex", {"radius": given.radius, "length": round(chord + 0.011, 4)}
        size |= {"width": 0.018, "height": 0.06, "rounding": 0.006}
    else:
        name, size = "rounded_box", {"length": getattr(given, "aperture", 0.02) + 0.006}
        size |= {"width": 0.014, "height": 0.04, "rounding": 0.004}
    kind: Any = COLLIDERS.load_settings(name)
    return ChosenOption(name, kind(**size))


def _pose_above(points: NDArray[np.float64], volume: Volume) -> Pose:
    """Return the pose of a linear array above the middle of what was scanned (N, 3) m."""
    axes = volume.index_to_patient[:3, :2] / np.linalg.norm(volume.index_to_patient[:3, :2], axis=0)
    across, along = axes.T
    middle = points.mean(axis=0)
    face = middle + np.percentile((points - middle) @ along, 1.0) * along
    rotation = np.column_stack([across, np.cross(along, across), along])
    return Pose(face, Rotation.from_matrix(rotation).as_quat())


def _probe_at(pose: Pose, points: NDArray[np.float64]) -> ProbeSettings:
    """Return a linear array as wide and deep as what was scanned, up to 50 mm and 110 mm."""
    x, _, z = np.abs((points - pose.position) @ pose.rotation).T
    depth = float(np.clip(np.percentile(z, 99.5), 0.01, 0.11))
    aperture = float(np.clip(2 * np.percentile(x, 99.0), 5e-3, 0.05))
    made: Any = PROBES.load_settings("linear")
    array = ChosenOption("linear", made(aperture=aperture, depth=round(depth, 4)))
    return ProbeSettings(array=array, image=512)


def move_to_skin(start: Placement, volume: Volume, probe: ProbeSettings | None) -> Placement:
    """Move a probe along its z to where its face touches what was scanned, and presses nothing.

    Specks, below which there is mostly nothing within 2 mm, do not hold it off.
    """
    array: Any = probe and probe.array.resolve_settings(PROBES)
    half, pose = getattr(array, "aperture", _FLAT) / 2, start.pose
    matrix = pose.inverse().matrix @ volume.index_to_patient
    step = 0.5 * float(np.linalg.norm(matrix[:3, :3], axis=0).min())
    shallowest, deepest = compute_grid_extent(matrix, volume.shape)[:, 2].tolist()
    depths = np.arange(shallowest, deepest, step)
    rays = np.meshgrid(np.linspace(-half, half, 21), [-2e-3, 0.0, 2e-3], depths, indexing="ij")
    places = pose.transform_points(np.stack(rays, axis=-1).reshape(-1, 3))
    to_index = volume.patient_to_index
    index = np.rint(places @ to_index[:3, :3].T + to_index[:3, 3]).astype(np.int64)
    scanned = np.asarray(((index >= 0) & (index < volume.shape)).all(axis=1))
    scanned[scanned] = volume.intensities[tuple(index[scanned].T)] > 0
    lines = scanned.reshape(-1, len(depths))
    behind = sliding_window_view(lines, min(math.ceil(2e-3 / step), len(depths)), axis=1)
    is_skin = lines[:, : behind.shape[1]] & (behind.mean(axis=2) > 0.5)
    touched = np.flatnonzero(is_skin.any(axis=0))
    depth = depths[touched[0]] if len(touched) else 0.0
    face = pose.transform_points(np.array([[0.0, 0.0, depth]]))[0]
    return replace(start, position=round_pose(Pose(face, pose.orientation)).position)


def _showing_most(
    settings: CaseSettings, volume: Volume, poses: Sequence[Pose], probe: ProbeSettings
) -> Pose:
    """Find the pose whose image and surroundings show most structures; else the middle one."""
    labels = [
        structure.label
        for name, structure in settings.structures.items()
        if guess_tissue_kind(name) not in (*LAYERS, "bone")
    ]
    best, most = poses[len(poses) // 2], 0.0
    if volume.labels is None or not labels:
        return best
    array: Any = probe.array.resolve_settings(PROBES)
    structures = _places(volume, np.isin(volume.labels, labels))
    ends = len(poses) // 10  # beside which nothing was seen
    for pose in poses[ends : len(poses) - ends]:
        x, y, z = ((structures - pose.position) @ pose.rotation).T
        widest = array.width / 2 * np.clip(z / array.depth, 0.3, 1.0)
        in_image = (np.abs(x) < widest) & (z > 0.0) & (z < array.depth)
        shown = float(np.count_nonzero(in_image & (np.abs(y - _SLID) < _SHOWN)))
        if shown > most * _BETTER:
            best, most = pose, shown
    return best


def _places(volume: Volume, there: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return centres (N, 3) m of voxels (i, j, k); of many every so many along each axis."""
    step = max(1, math.ceil((there.size / _MOST_POINTS) ** (1 / 3)))
    matrix = volume.index_to_patient
    indices = np.argwhere(there[::step, ::step, ::step]) * step
    return np.asarray(indices @ matrix[:3, :3].T + matrix[:3, 3])
