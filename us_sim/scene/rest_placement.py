"""Where the tissue in an image lies while nothing presses it, by a scene's tissue model.

A probe that scans presses, and what it presses aside is seen where it was pressed to. The scene's
solver says how each pose of a sweep deforms the tissue; each point of the image is then taken
back, within its deformed tetrahedron, to where the same piece of tissue lies at rest.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import SceneError
from us_sim.geometry.pose import Pose
from us_sim.scene.building import tissue_model_of, volume_of
from us_sim.scene.scene import Scene
from us_sim.tissue.mesh.embedding import locate
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, signed_volumes
from us_sim.tissue.solvers.solver import TissueSolver, create_solver
from us_sim.volume.reconstruction.settings import ImagePart
from us_sim.volume.sequences.sweep import Sweep

_MOST_FRAMES = 60
"""Frames of a solver until the tissue under one pose is at rest; inertia and creep take some."""


def rest_placement(scene: Scene, sweep: Sweep, part: ImagePart) -> RestPlacement:
    """The placement at rest of a sweep's frames.

    Args:
        scene: with tissue and a collider; its frame ``patient`` is the sweep's reference frame.
        sweep: with poses.
        part: of the image; the probe's face is at its top.

    Raises:
        SceneError: the scene has no tissue.
        UsSimError: its parts cannot be made.
    """
    if scene.tissue is None:
        raise SceneError(
            f"{scene.origin}: has no tissue, so that no pressure can be undone; name a scene with "
            f"`tissue`"
        )
    model = tissue_model_of(scene, volume_of(scene))
    name = scene.tissue.solver
    solver = create_solver(name, model, scene.solver_settings(name))
    poses = [probe_pose(matrix, part, sweep.columns) for matrix in sweep.image_to_reference]
    return RestPlacement(solver, poses)


def probe_pose(image_to_reference: NDArray[np.float64], part: ImagePart, columns: int) -> Pose:
    """Of the probe whose image this is: its face is at the top middle of the image's part."""
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
    """Takes points of a frame to where their tissue lies at rest.

    Args:
        solver: of the tissue.
        poses: of the probe, by frame.
    """

    solver: TissueSolver
    poses: list[Pose]
    _frame: int = field(default=-1, init=False)
    _nodes: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)), init=False)

    def __call__(self, frame: int, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 3) m at rest, of points (N, 3) m seen in a frame; nan outside the tissue."""
        if frame != self._frame:
            self._frame, self._nodes = frame, self._deformed(self.poses[frame])
        mesh = self.solver.model.mesh
        # A linear method may turn tetrahedra inside out under a probe's edge: none is seen there.
        upright = np.flatnonzero(signed_volumes(self._nodes, mesh.tetrahedra) > 0.0)
        kept, tetrahedra = np.unique(mesh.tetrahedra[upright], return_inverse=True)
        corners_of = tetrahedra.reshape(-1, 4).astype(np.int32)
        deformed = TetrahedralMesh(self._nodes[kept], corners_of)
        where = locate(deformed, points)
        corners = mesh.nodes[mesh.tetrahedra[upright[where.tetrahedra]]]
        rest = np.einsum("pa,pax->px", where.weights, corners)
        rest[where.outside > 0.0] = np.nan
        return np.asarray(rest, dtype=np.float64)

    def _deformed(self, pose: Pose) -> NDArray[np.float64]:
        """The nodes (N, 3) m under a held probe."""
        for _ in range(_MOST_FRAMES):
            deformation = self.solver.deform(pose)
            if self.solver.is_settled:
                break
        return np.asarray(deformation.nodes, dtype=np.float64)
