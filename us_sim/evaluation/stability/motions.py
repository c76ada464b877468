"""What a probe does to a tissue to break its solver: pressing, jumping, trembling, and worse.

>>> from us_sim.evaluation.stability.motions import poses_of
>>> from us_sim.evaluation.stability.meshes import mesh_named
>>> [round(float(pose.position[2]), 3) for pose in poses_of("press", mesh_named("box"), 0.5)]
[0.008, 0.016, 0.024, 0.032, 0.04, 0.04, 0.04]
"""

from __future__ import annotations

import numpy as np

from us_sim.geometry.pose import Pose
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh

_TREMOR = 1000.0  # Hz
_FRAME_RATE = 2718.0  # Hz; no small multiple of the tremor's, so that no phase repeats

LIFTED = Pose(position=np.array([0.0, 0.0, -100.0]))  # far from any tissue


def poses_of(motion: str, mesh: TetrahedralMesh, depth: float) -> list[Pose | None]:
    """The probe's pose in every frame until it is released.

    Args:
        motion: one of `us_sim.evaluation.stability.cases.MOTIONS`.
        mesh: whose top is z = 0. The probe is put above the node of the top that is nearest to the
            middle, so that a needle hits one.
        depth: reached, as a fraction of the mesh's thickness.
    """
    top = mesh.nodes[mesh.nodes[:, 2] == mesh.nodes[:, 2].min()]
    middle = mesh.nodes[:, :2].min(axis=0) + np.ptp(mesh.nodes[:, :2], axis=0) / 2
    nearest = top[np.argmin(np.linalg.norm(top[:, :2] - middle, axis=1))]
    above = np.array([nearest[0], nearest[1], 0.0])
    return [
        pose if pose is None or pose is LIFTED else Pose(pose.position + above, pose.orientation)
        for pose in _centred(motion, mesh, depth)
    ]


def _centred(motion: str, mesh: TetrahedralMesh, depth: float) -> list[Pose | None]:
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    thick = high[2] - low[2]
    wide = high[0] - low[0]
    deep = depth * thick
    if motion == "press":
        return [_at(z=part * deep) for part in (0.2, 0.4, 0.6, 0.8, 1, 1, 1)]
    if motion == "jump":
        return [_at(z=deep), _at(z=deep), _at(x=0.2 * wide, z=deep), _at(z=0.3 * deep)]
    if motion == "through":
        stops = (-0.2 * thick, deep, 2.5 * thick, deep, -0.2 * thick, deep)
        return [_at(z=z) for z in stops]
    if motion == "tremor":
        phase = 2 * np.pi * _TREMOR / _FRAME_RATE * np.arange(14)
        return [_at(z=deep + 0.02 * thick * shake) for shake in np.sin(phase)]
    if motion == "slide":
        aside = (0.0, 0.0, 0.1, 0.25, 0.45, 0.7, 0.2)
        return [_at(x=x * wide, y=0.3 * x * wide, z=deep) for x in aside]
    if motion == "tilt":
        angles = (0.0, 0.2, 0.5, 0.9, 1.4, 1.4, -0.8)
        return [_at(z=deep, angle=angle, about=(0.4, 1.0, 0.1)) for angle in angles]
    if motion == "sideways":
        reached = (0.2, 0.5, 1.0, 1.0, -0.5, 0.6)
        return [
            _at(x=low[0] + part * depth * wide, z=0.4 * thick, angle=np.pi / 2, about=(0, 1, 0))
            for part in reached
        ]
    if motion == "upside down":
        depths = (1.2 * thick, thick - deep, -0.5 * deep, -0.2 * deep)
        return [_at(z=z, angle=np.pi, about=(1.0, 0.0, 0.0)) for z in depths]
    if motion == "scribble":
        random = np.random.default_rng(11)
        reach = np.array([wide, high[1] - low[1], 2 * deep])
        places = random.uniform(-0.5, 0.5, (8, 3)) * reach + [0.0, 0.0, deep]
        return [Pose(place, random.standard_normal(4)) for place in places]
    frames = [_at(z=deep), None, _at(z=0.5 * deep), LIFTED, _at(x=0.1 * wide, z=deep), None]
    return [*frames, _at(z=deep)]  # flicker


def _at(
    x: float = 0.0,
    y: float = 0.0,
    z: float = 0.0,
    angle: float = 0.0,
    about: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> Pose:
    axis = np.array(about) / np.linalg.norm(about)
    turn = np.append(np.sin(angle / 2) * axis, np.cos(angle / 2))
    return Pose(np.array([x, y, z]), turn)
