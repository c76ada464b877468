"""Placing images in the volume: at rest, as if nothing pressed, or along a probe's path."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import SceneError
from us_sim.geometry.pose import Pose
from us_sim.recording.path import ProbePath
from us_sim.scene.building import (
    build_probe,
    build_tissue_model,
    load_path,
    load_tracker_poses,
    load_volume,
)
from us_sim.scene.scene import Scene
from us_sim.slicing.probe.probe import Probe
from us_sim.tissue.mesh.embedding import locate_points
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, signed_volumes
from us_sim.tissue.solvers.solver import TissueSolver, create_solver
from us_sim.tracking.measurement import PATIENT
from us_sim.volume.reconstruction.settings import ImagePart
from us_sim.volume.sequences.sweep import TrackedSweep
from us_sim.volume.volume import Volume

_POSES = 60  # of a path that are tried
_POINTS = 32  # along each side of an image
_LITTLE = 0.002
"""Part of the best image of a path that is of the volume, below which the path is refused."""
_MOST_FRAMES = 60
"""Frames of a solver until the tissue under one pose is at rest; inertia and creep take some."""


def build_rest_placement(scene: Scene, sweep: TrackedSweep, part: ImagePart) -> RestPlacement:
    """Build the placement at rest of a sweep's frames.

    Args:
        scene: with tissue and a collider; its frame ``patient`` is the sweep's reference frame.
        sweep: with poses.
        part: of the image; the probe's face is at its top.
    """
    if scene.tissue is None:
        raise SceneError(
            f"{scene.origin}: has no tissue, so that no pressure can be undone; name a scene with "
            f"`tissue`"
        )
    model = build_tissue_model(scene, load_volume(scene))
    name = scene.tissue.solver
    solver = create_solver(name, model, scene.solver_settings(name))
    poses = [find_probe_pose(matrix, part, sweep.columns) for matrix in sweep.image_to_reference]
    return RestPlacement(solver, poses)


def find_probe_pose(image_to_reference: NDArray[np.float64], part: ImagePart, columns: int) -> Pose:
    """Return the pose of the probe whose face is at the top middle of the image's part."""
    top = np.array([0.5 * (columns - 1), -0.5, 0.0, 1.0])  # the upper edge of the first row
    if part.fan_origin is not None and part.fan_radius is not None:
        top[:2] = part.fan_origin[0], part.fan_origin[1] + part.fan_radius[0]
    elif part.clip is not None:
        top[:2] = part.clip[0] + 0.5 * part.clip[2], part.clip[1]
    along, down = (step / np.linalg.norm(step) for step in image_to_reference[:3, :2].T)
    matrix = np.eye(4)
    matrix[:3, :3] = np.column_stack([along, np.cross(down, along), down])
    matrix[:3, 3] = (image_to_reference @ top)[:3]
    left, _, right = np.linalg.svd(matrix[:3, :3])
    matrix[:3, :3] = left @ right
    return Pose.from_matrix(matrix)


@dataclass
class RestPlacement:
    """Maps points of a frame to the places of their tissue at rest.

    Args:
        solver: of the tissue.
        poses: of the probe, by frame.
    """

    solver: TissueSolver
    poses: list[Pose]
    _frame: int = field(default=-1, init=False)
    _nodes: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)), init=False)

    def __call__(self, frame: int, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the places at rest (N, 3) m of points (N, 3) m in a frame; nan outside tissue."""
        if frame != self._frame:
            self._frame, self._nodes = frame, self._deform(self.poses[frame])
        mesh = self.solver.model.mesh
        # A linear method may turn tetrahedra inside out under a probe's edge: none is seen there.
        upright = np.flatnonzero(signed_volumes(self._nodes, mesh.tetrahedra) > 0.0)
        kept, tetrahedra = np.unique(mesh.tetrahedra[upright], return_inverse=True)
        corners_of = tetrahedra.reshape(-1, 4).astype(np.int32)
        deformed = TetrahedralMesh(self._nodes[kept], corners_of)
        where = locate_points(deformed, points)
        rest = where.interpolate(mesh.nodes[mesh.tetrahedra[upright]])
        rest[where.outside > 0.0] = np.nan
        return rest

    def _deform(self, pose: Pose) -> NDArray[np.float64]:
        """Deform the tissue until it is at rest under a held probe; return its nodes (N, 3) m."""
        for _ in range(_MOST_FRAMES):
            deformation = self.solver.deform(pose)
            if self.solver.is_settled:
                break
        return np.asarray(deformation.nodes, dtype=np.float64)


def compute_part_inside(
    probe: Probe,
    poses: Sequence[Pose],
    patient_to_index: NDArray[np.float64],
    shape: tuple[int, ...],
    intensities: NDArray[np.uint8] | None = None,
) -> NDArray[np.float64]:
    """Compute the part (N,) of the image at each pose that lies inside the volume's voxels.

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
    """Refuse a path of which no image shows any of the volume; say where both are."""
    poses, probe = _sample_poses(scene, load_path(scene, file, topic)), build_probe(scene)
    scanned = volume.intensities if volume.intensities.any() else None  # black at any pose
    shown = compute_part_inside(probe, poses, volume.patient_to_index, volume.shape, scanned)
    if shown.max() >= _LITTLE:
        return
    reaches = " × ".join(f"{1e3 * a:.0f} to {1e3 * b:.0f}" for a, b in volume.extent.T)
    pixel = [(probe.columns - 1) / 2, (probe.rows - 1) / 2, 0.0, 1.0]  # in the image's middle
    place = (probe.image_to_probe @ pixel)[None, :3]
    middle = 1e3 * np.mean([pose.transform_points(place)[0] for pose in poses], axis=0)
    raise SceneError(
        f"{scene.origin}: volume.pose: the volume, {scene.volume.name}, is seen in no image along "
        f"{file.name}: in `patient` it reaches from {reaches} mm, and the middle of the images is "
        f"at {', '.join(f'{c:.0f}' for c in middle)} mm; the pose may have been made for another "
        f"file: give the pose of this one, or a path that leads there"
    )


def _sample_poses(scene: Scene, path: ProbePath) -> list[Pose]:
    registration, calibration = load_tracker_poses(scene)
    if path.frame_id == PATIENT:  # the probe's own, or of a tracker whose frame that is
        of_tracker = scene.tracker.frame == PATIENT
        registration, calibration = (registration, calibration) if of_tracker else (Pose(), Pose())
    picked = np.unique(np.linspace(0, len(path) - 1, _POSES).round().astype(int))
    tracked = [Pose(path.positions[i], path.orientations[i]) for i in picked]
    return [registration @ pose @ calibration for pose in tracked]
