"""Whether a path's images meet the volume, found out before hundreds of black ones are made.

>>> from us_sim.geometry.pose import Pose
>>> from us_sim.scene.image_in_volume import part_inside
>>> from us_sim.scene.building import probe_of
>>> from us_sim.scene.reading import parse_scene
>>> import numpy as np
>>> scene = parse_scene({"name": "bare", "volume": {"phantom": "upper_arm"},
...                      "probe": {"aperture": "40 mm", "depth": "30 mm", "image": [400, 300]}})
>>> to_index = np.diag([1e3, 1e3, 1e3, 1.0])  # 1 mm voxels from the origin on
>>> part_inside(probe_of(scene), [Pose(), Pose([0.0, -0.05, 0.0])], to_index, (50, 50, 50)).tolist()
[0.5, 0.0]
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import SceneError
from us_sim.geometry.pose import Pose
from us_sim.recording.path import ProbePath
from us_sim.scene.building import path_of, probe_of
from us_sim.scene.scene import Scene
from us_sim.scene.tracker_building import tracker_poses_of
from us_sim.slicing.probe.probe import Probe
from us_sim.tracking.measurement import PATIENT
from us_sim.volume.volume import Volume

_POSES = 60  # of a path that are looked at
_POINTS = 32  # along each side of an image

_LITTLE = 0.002
"""Part of the best image of a path that is of the volume, below which the path is refused."""


def part_inside(
    probe: Probe,
    poses: Sequence[Pose],
    patient_to_index: NDArray[np.float64],
    shape: tuple[int, ...],
    intensities: NDArray[np.uint8] | None = None,
) -> NDArray[np.float64]:
    """(N,) how much of the image at each pose is inside of the volume's voxels.

    Args:
        probe: whose image it is.
        poses: in ``patient``.
        patient_to_index: (4, 4).
        shape: of the volume.
        intensities: (i, j, k); where they are given, only voxels that are not 0 count.
    """
    columns = np.linspace(0, probe.columns - 1, _POINTS).round().astype(int)
    rows = np.linspace(0, probe.rows - 1, _POINTS).round().astype(int)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    reached = np.isfinite(probe.pixel_beams[0, pixels[:, 1], pixels[:, 0]])
    pixels = pixels[reached]
    flat = np.column_stack([pixels, np.zeros(len(pixels)), np.ones(len(pixels))])
    in_probe = flat @ probe.image_to_probe.T
    parts = np.empty(len(poses))
    for i, pose in enumerate(poses):
        index = np.rint(in_probe @ (patient_to_index @ pose.matrix).T)[:, :3].astype(np.int64)
        inside = np.asarray(((index >= 0) & (index < np.array(shape))).all(axis=1))
        if intensities is not None:
            inside[inside] = intensities[tuple(index[inside].T)] > 0
        parts[i] = inside.mean()
    return parts


def check_path_in_volume(
    scene: Scene, file: Path, volume: Volume, topic: str | None = None
) -> None:
    """Refuse a path of which no image shows what was scanned.

    Raises:
        SceneError: with where the volume is, and where the images are.
        BagError: the path cannot be read.
    """
    poses, probe = _sampled(scene, path_of(scene, file, topic)), probe_of(scene)
    scanned = volume.intensities if volume.intensities.any() else None  # black at any pose
    shown = part_inside(probe, poses, volume.patient_to_index, volume.shape, scanned)
    if shown.max() >= _LITTLE:
        return
    inside = part_inside(probe, poses, volume.patient_to_index, volume.shape)
    reaches = " × ".join(f"{1e3 * a:.0f} to {1e3 * b:.0f}" for a, b in volume.extent.T)
    middle = 1e3 * np.mean([pose.apply(_middle(probe))[0] for pose in poses], axis=0)
    what = "is black in" if inside.max() >= _LITTLE else "lies beside"
    raise SceneError(
        f"{scene.origin}: volume.pose: the volume, {scene.volume.name}, {what} all images along "
        f"{file.name}: in `patient` it reaches from {reaches} mm, and the middle of the images is "
        f"at {', '.join(f'{c:.0f}' for c in middle)} mm; the pose may have been made for another "
        f"file: give the pose of this one, or a path that leads there"
    )


def _sampled(scene: Scene, path: ProbePath) -> list[Pose]:
    """Poses of the probe in ``patient`` along a path."""
    registration, calibration = tracker_poses_of(scene)
    if path.frame_id == PATIENT:  # the probe's own, or of a tracker whose frame that is
        of_tracker = scene.tracker.frame == PATIENT
        registration, calibration = (registration, calibration) if of_tracker else (Pose(), Pose())
    picked = np.unique(np.linspace(0, len(path) - 1, _POSES).round().astype(int))
    tracked = [Pose(path.positions[i], path.orientations[i]) for i in picked]
    return [registration @ pose @ calibration for pose in tracked]


def _middle(probe: Probe) -> NDArray[np.float64]:
    """(1, 3) m, the middle of the image in frame ``probe``."""
    pixel = [(probe.columns - 1) / 2, (probe.rows - 1) / 2, 0.0, 1.0]
    return (probe.image_to_probe @ pixel)[None, :3]
