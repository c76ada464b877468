"""The presses of `us-sim evaluate tissue`; the block of tissue is held at its bottom.

>>> from us_sim.evaluation.block import MESHES
>>> from us_sim.evaluation.tissue.cases import SCENES
>>> scene = SCENES["press_and_slide"]
>>> len(scene.path), scene.path[-1].position.round(4).tolist()
(18, [0.02, 0.0, 0.025])
>>> int(scene.make_model(MESHES[0]).fixed.sum())  # nodes at the bottom
200
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.block import EXTENT, make_block_mesh, make_graded_planes
from us_sim.geometry.collider import Capsule, Collider, RoundedBox, Sphere
from us_sim.geometry.pose import Pose
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import make_uniform_materials
from us_sim.tissue.model import TissueModel, face_nodes

MAIN_SCENE = "press_25mm"  # the scene that is pressed on every mesh

_STEP = 0.0025  # m, of the probe in a frame
_SPHERE = Sphere(0.03)
_AROUND = (-0.03, 0.03, 0.03)  # m, touched by a sphere that is pressed straight down


@dataclass(frozen=True)
class BlockScene:
    """A path of the probe into the block; results are compared at its end."""

    name: str
    words: str
    collider: Collider
    path: tuple[Pose, ...]  # one a frame
    touched: tuple[float, float, float]  # m: x from, x to, y to, of the reference's fine mesh
    poisson_ratio: float = 0.45

    @property
    def material(self) -> Material:
        """The material of the block, soft tissue."""
        return Material(10e3, self.poisson_ratio, 1000.0)

    def make_model(self, counts: tuple[int, int, int]) -> TissueModel:
        """Make the block on a uniform mesh with ``counts`` nodes along x, y and z."""
        mesh = make_block_mesh(counts)
        fixed = np.zeros(len(mesh.nodes), dtype=bool)
        fixed[face_nodes(mesh, "bottom")] = True
        materials = make_uniform_materials(mesh, self.material)
        return TissueModel(mesh, materials, fixed, self.collider, face_nodes(mesh, "top"))

    def make_reference_planes(self, size: float) -> tuple[NDArray[np.float64], ...]:
        """Place planes (m) of the reference's half block, ``size`` apart under the probe."""
        low, high, beside = self.touched
        return (
            make_graded_planes(*EXTENT[0], low, high, size, 1.2),
            make_graded_planes(0.0, EXTENT[1][1], 0.0, beside, size, 1.2),
            make_graded_planes(*EXTENT[2], 0.0, 0.02, size, 1.2),
        )


def _plan_press(depth: float) -> tuple[Pose, ...]:
    depths = np.append(np.arange(_STEP, depth - 1e-9, _STEP), depth)
    return tuple(Pose(np.array([0.0, 0.0, z])) for z in depths)


def _plan_slide(depth: float, distance: float) -> tuple[Pose, ...]:
    travelled = np.arange(1, round(distance / _STEP) + 1) * _STEP
    return tuple(Pose(np.array([x, 0.0, depth])) for x in travelled)


def _plan_tilt(depth: float, angle: float) -> tuple[Pose, ...]:
    turn = math.radians(2.5)  # in a frame
    halves = np.arange(1, round(angle / turn) + 1) * turn / 2
    return tuple(
        Pose(np.array([0.0, 0.0, depth]), np.array([0.0, math.sin(half), 0.0, math.cos(half)]))
        for half in halves
    )


_ALL = (
    BlockScene("press_12mm", "pressed by 12 mm", _SPHERE, _plan_press(0.012), _AROUND),
    BlockScene("press_25mm", "pressed by 25 mm", _SPHERE, _plan_press(0.025), _AROUND),
    BlockScene(
        "press_and_slide",
        "pressed by 25 mm, then slid by 20 mm",
        _SPHERE,
        _plan_press(0.025) + _plan_slide(0.025, 0.02),
        (-0.01, 0.05, 0.03),
    ),
    BlockScene(
        "tilt",
        "a capsule pressed by 12 mm, then tilted by 20°",
        Capsule(0.025, 0.04),
        _plan_press(0.012) + _plan_tilt(0.012, math.radians(20)),
        (-0.05, 0.05, 0.03),
    ),
    BlockScene(
        "flat_10mm",
        "a flat face with rounded edges pressed by 10 mm",
        RoundedBox(0.05, 0.03, 0.06, 0.006),
        _plan_press(0.01),
        (-0.04, 0.04, 0.03),
    ),
    BlockScene(
        "press_25mm_nu0.49",
        "pressed by 25 mm, Poisson's ratio 0.49",
        *(_SPHERE, _plan_press(0.025), _AROUND, 0.49),
    ),
)

SCENES = {scene.name: scene for scene in _ALL}
