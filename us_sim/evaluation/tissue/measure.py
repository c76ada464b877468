"""Error and run time of every method along a probe's path.

The nodes at the path's end are compared with large deformation on fine quadratic elements
(`us_sim.evaluation.tissue.reference`).

>>> import numpy as np
>>> from us_sim.evaluation.tissue.measure import PathOutcome, compare_outcomes
>>> nodes = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
>>> exact = PathOutcome(nodes * 0.1, 10.0, 1.0)
>>> errors = compare_outcomes(PathOutcome(nodes * 0.11, 9.0, 1.01), exact, rest_volume=2.0)
>>> {name: round(error, 4) for name, error in errors.items()}
{'rel_l2_error': 0.1, 'max_error_mm': 10.0, 'force_error': 0.1, 'volume_error': 0.005}
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from us_sim.errors import SolverError
from us_sim.evaluation.block import LARGEST_MESH, MESHES, make_block_mesh
from us_sim.evaluation.subject import Piece
from us_sim.evaluation.tissue.cases import MAIN_SCENE, SCENES, BlockScene
from us_sim.evaluation.tissue.reference import ContactSolution, solve_reference
from us_sim.evaluation.tissue_methods import TISSUE_METHODS, Setting
from us_sim.tissue.mesh.tetrahedral_mesh import signed_volumes
from us_sim.tissue.model import Deformation, TissueModel
from us_sim.tissue.solvers.solver import TissueSolver, create_solver

_QUICK_SCENES = ("press_25mm", "press_and_slide", "tilt")
_SIZES, _QUICK_SIZES = (0.01, 0.0065, 0.005), (0.01, 0.0065)  # m, of the reference's elements


@dataclass(frozen=True, eq=False)
class PathOutcome:
    """Result of a method at the end of a path, or of the reference at the same nodes."""

    displacement: NDArray[np.float64]  # (N, 3) m
    force: float  # N, on the probe along its axis
    volume: float  # m3, of the deformed block

    @classmethod
    def from_deformation(cls, model: TissueModel, deformation: Deformation) -> PathOutcome:
        """Return the outcome of a solver."""
        return cls(
            deformation.nodes - model.mesh.nodes,
            float(deformation.force[2]),
            float(signed_volumes(deformation.nodes, model.mesh.tetrahedra).sum()),
        )


def compare_outcomes(
    found: PathOutcome, exact: PathOutcome, rest_volume: float
) -> dict[str, float]:
    """Compute the errors of ``found``, by column; all but ``max_error_mm`` are relative."""
    difference = found.displacement - exact.displacement
    return {
        "rel_l2_error": float(np.linalg.norm(difference) / np.linalg.norm(exact.displacement)),
        "max_error_mm": float(np.linalg.norm(difference, axis=1).max() * 1e3),
        "force_error": abs(found.force / exact.force - 1.0),
        "volume_error": abs(found.volume - exact.volume) / rest_volume,
    }


def plan_pieces(quick: bool) -> dict[str, list[Piece]]:
    """List the pieces in order: the references, and then the methods.

    The main press runs on every mesh, the others on the paper's finest. There, and in the main
    press on the coarsest mesh, all settings are run; elsewhere each method's defaults.
    """
    bench = TissueBench()
    references, trials = [], []
    for scene in (SCENES[name] for name in _QUICK_SCENES) if quick else SCENES.values():
        solve = partial(bench.measure_reference, scene, _QUICK_SIZES if quick else _SIZES)
        references.append(Piece({"scene": scene.name}, solve))
        main = scene.name == MAIN_SCENE
        meshes = [*MESHES, LARGEST_MESH] if main and not quick else [MESHES[-1]]
        if main and quick:
            meshes = [MESHES[0], MESHES[-1]]
        for counts in meshes:
            some = 1 if counts not in (MESHES[0], MESHES[-1]) or (quick and not main) else None
            for method in TISSUE_METHODS.values():
                for setting in method.settings[: 3 if quick and main else some]:
                    run = partial(bench.run_method, scene, counts, method.name, setting)
                    trials.append(Piece(_describe_trial(scene, counts, method.name, setting), run))
    return {"references": references, "tissue": trials}


def _describe_trial(
    scene: BlockScene, counts: tuple[int, int, int], method: str, setting: Setting
) -> dict[str, Any]:
    mesh = make_block_mesh(counts)
    return {
        "scene": scene.name,
        "method": method,
        "nodes": len(mesh.nodes),
        "tets": len(mesh.tetrahedra),
        "threads": 1,
        "setting": ", ".join(f"{key}={value}" for key, value in setting.items()) or "default",
    }


class TissueBench:
    """A bench that runs the pieces; it keeps the last model, and all references."""

    def __init__(self) -> None:
        self._references: dict[str, ContactSolution] = {}
        self._models: dict[Any, TissueModel] = {}
        self._exact: dict[Any, PathOutcome] = {}  # the reference at its nodes
        self._warm: set[str] = set()

    def measure_reference(
        self, scene: BlockScene, sizes: tuple[float, ...]
    ) -> Iterator[dict[str, Any]]:
        """Solve the nonlinear reference of a scene, and measure its convergence."""
        *_, coarse, fine = solve_reference(scene, sizes)
        self._references[scene.name] = fine
        points = fine.block.corners
        last, before = (each.interpolate_displacement(points) for each in (fine, coarse))
        yield {
            "elements": f"{sizes[-2] * 1e3:g} → {sizes[-1] * 1e3:g} mm",
            "unknowns": fine.displacement.size,
            "force_n": -float(fine.force[2]),
            "l2_change": float(np.linalg.norm(before - last) / np.linalg.norm(last)),
            "force_change": float(
                np.linalg.norm(coarse.force - fine.force) / np.linalg.norm(fine.force)
            ),
            "penetration_mm": fine.penetration * 1e3,
        }

    def run_method(
        self, scene: BlockScene, counts: tuple[int, int, int], method: str, setting: Setting
    ) -> Iterator[dict[str, Any]]:
        """Run a method along the path, time it, and compare it with the reference."""
        if (scene.name, counts) not in self._models:
            self._models = {(scene.name, counts): scene.make_model(counts)}
            self._exact = {
                (scene.name, counts): self._find_exact(scene, make_block_mesh(counts).nodes)
            }
        model, exact = self._models[scene.name, counts], self._exact[scene.name, counts]
        solver = create_solver(method, model, **setting)
        if method not in self._warm:
            solver.warm_up()
            self._warm.add(method)
        milliseconds, last = _time_path(solver, scene)
        volumes = signed_volumes(last.nodes, model.mesh.tetrahedra)
        yield {
            "ms_median": float(np.median(milliseconds)),
            "ms_p99": float(np.percentile(milliseconds, 99)),
            **compare_outcomes(
                PathOutcome.from_deformation(model, last), exact, float(model.mesh.volumes.sum())
            ),
            "estimated_error": solver.estimate_discretisation_error(),
            "smallest_volume_ratio": float((volumes / model.mesh.volumes).min()),
        }

    def _find_exact(self, scene: BlockScene, nodes: NDArray[np.float64]) -> PathOutcome:
        """Return the reference at nodes (N, 3) m."""
        if scene.name not in self._references:
            raise SolverError(f"the reference of {scene.name} was not found")
        exact = self._references[scene.name]
        displacement = exact.interpolate_displacement(nodes)
        return PathOutcome(displacement, float(exact.force[2]), exact.volume)


def _time_path(solver: TissueSolver, scene: BlockScene) -> tuple[list[float], Deformation]:
    """Follow the path three times from rest, or for 20 s; return ms of every frame, and the last.

    The first pass warms caches; it counts only if there is no other.
    """
    frames: list[float] = []
    begin = time.perf_counter()
    with threadpool_limits(1):
        for number in range(3):
            solver.reset()
            frames = [] if number <= 1 else frames
            for pose in scene.path:
                before = time.perf_counter()
                last = solver.deform(pose)
                frames.append((time.perf_counter() - before) * 1e3)
            if time.perf_counter() - begin > 20.0:
                break
    return frames, last
