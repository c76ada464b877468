"""Reference solutions on two meshes, kept in the user's cache folder by what decides them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.cache import Form, kept
from us_sim.evaluation.tissue import neo_hookean_hexahedra, reference, two_level
from us_sim.evaluation.tissue.cases import Scene
from us_sim.evaluation.tissue.neo_hookean_hexahedra import NeoHookeanHexahedra
from us_sim.evaluation.tissue.reference import Solution, solve_contact
from us_sim.geometry.pose import Pose

_STRIDE = 0.005  # m, the least distance between the poses through which the last is approached

_ARRAYS, _NUMBERS = ("displacement", "pressure", "force"), ("volume", "penetration")
"""What is kept of a solution."""


@dataclass(frozen=True, eq=False)
class Reference:
    """The solution at the end of a scene's path, and how much a coarser mesh differs."""

    solution: Solution
    size: float  # m, of the elements under the probe
    coarser: float  # m, likewise, of the mesh compared with
    difference: float  # relative L2, between the two
    force_difference: float  # relative

    @property
    def unknowns(self) -> int:
        """Displacement components of the whole block's half that was solved."""
        return self.solution.displacement.size


def kept_reference(
    scene: Scene, sizes: Sequence[float], progress: Callable[[float, str], None] | None = None
) -> Reference:
    """The reference of a scene, computed first if it is not kept.

    Args:
        scene: pressed as its path's end says.
        sizes: m, of the elements under the probe, at least two: each mesh starts from the one
            before, the last is the reference, and the one before it shows how far it has converged.
        progress: called with the fraction that is done, and a word.

    Raises:
        SolverError: no equilibrium was found.
    """
    fine: Solution | None = None
    for number, size in enumerate(sizes):

        def tell(done: float, text: str, number: int = number) -> None:
            if progress is not None:
                progress((number + done) / len(sizes), text)

        coarse, fine = fine, _kept(scene, size, fine, tell)
    assert coarse is not None
    assert fine is not None
    points = fine.block.corners
    here, there = fine.at(points), coarse.at(points)
    difference = float(np.linalg.norm(there - here) / np.linalg.norm(here))
    forces = float(np.linalg.norm(coarse.force - fine.force) / np.linalg.norm(fine.force))
    return Reference(fine, sizes[-1], sizes[-2], difference, forces)


def _kept(
    scene: Scene, size: float, start: Solution | None, progress: Callable[[float, str], None]
) -> Solution:
    planes = scene.reference_planes(size)

    def pack(solution: Solution) -> tuple[dict[str, NDArray], dict[str, Any]]:
        arrays = {name: getattr(solution, name) for name in _ARRAYS}
        return arrays, {name: getattr(solution, name) for name in _NUMBERS}

    def unpack(arrays: dict[str, Any], numbers: dict[str, Any]) -> Solution:
        block = NeoHookeanHexahedra(planes, scene.material)
        return Solution(block, **arrays, **{name: numbers[name] for name in _NUMBERS})

    def make() -> Solution:
        poses = [scene.path[-1]] if start is not None else _approach(scene)
        return solve_contact(planes, scene.material, scene.collider, poses, start, progress)

    form = Form("reference.json", pack, unpack)
    return kept(f"reference-{_hash(scene, planes)}", form, make)


def _approach(scene: Scene) -> list[Pose]:
    """The path's poses without those that are near the one before; the last is there."""
    poses = [scene.path[0]]
    for pose in scene.path[1:-1]:
        turn = 1.0 - abs(float(pose.orientation @ poses[-1].orientation))
        if np.linalg.norm(pose.position - poses[-1].position) > 0.999 * _STRIDE or turn > 0.0009:
            poses.append(pose)
    return [*poses, scene.path[-1]]


def _hash(scene: Scene, planes: tuple[NDArray[np.float64], ...]) -> str:
    """Of everything that decides the solution, the code included."""
    digest = hashlib.sha256()
    for module in (neo_hookean_hexahedra, reference, two_level):
        digest.update(Path(str(module.__file__)).read_bytes())
    for array in (*planes, *(p.matrix for p in _approach(scene)), scene.collider.offset_box):
        digest.update(np.ascontiguousarray(array).tobytes())
    digest.update(repr(scene.material).encode())
    return digest.hexdigest()[:16]
