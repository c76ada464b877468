"""A block of bone in muscle, at rest, pressed and slid over, and where its shadow's edges are.

>>> import numpy as np
>>> from us_sim.evaluation.image.bone_block import STATES, corners
>>> np.round(corners(STATES["rest"])[0] * 1e3, 3)  # mm, x and z of one
array([-6., 14.])
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.pose import Pose
from us_sim.slicing.probe.probe import Probe
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
