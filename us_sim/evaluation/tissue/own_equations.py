"""A method's own equations, solved without regard to time: what more iterations would give."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from us_sim.evaluation.tissue.cases import Scene
from us_sim.evaluation.tissue.linear_equations import LinearEquations
from us_sim.evaluation.tissue.points import Outcome, volumes
from us_sim.tissue.contact.penetration import push_out
from us_sim.tissue.deformation import Deformation
from us_sim.tissue.model import TissueModel
from us_sim.tissue.solvers.solver import create_solver

__all__ = ["EFFORT", "converged", "equations", "solved_independently"]

EFFORT = (
    "iterations",
    "steps",
    "threads",
    "contact_updates",
    "frame_tolerance",
    "tolerance",
    "most_iterations",
    "time_step",
)
"""Settings that say how hard a method tries, and not what it solves."""

_PATIENT: dict[str, dict[str, Any]] = {
    "fem_nonlinear": {
        "iterations": 60,
        "most_iterations": 400,
        "frame_tolerance": 1e-7,
        "tolerance": 1e-7,
    },
    "fem_cg": {"iterations": 500, "tolerance": 1e-9},
    "msds": {"steps": 100, "rest_tolerance": 1e-8},
    "msds_implicit": {"iterations": 50, "tolerance": 1e-8, "rest_tolerance": 1e-8},
}
"""What each method is given to converge; a setting that it has not is left out."""
_FRAMES = 400
_LONGEST = 10.0  # s


def equations(method: str, setting: dict[str, Any]) -> tuple[Any, ...]:
    """What two settings have in common when they approach the same solution."""
    kept = {key: value for key, value in setting.items() if key not in EFFORT}
    return (method, *sorted(kept.items()))


def converged(
    scene: Scene, model: TissueModel, method: str, setting: dict[str, Any]
) -> tuple[Outcome, str]:
    """The scene's end by a method that takes its time, and words that say how far it came."""
    kept = {key: value for key, value in setting.items() if key not in EFFORT}
    solver = create_solver(method, model, **kept, **_PATIENT.get(method, {}))
    for pose in scene.path:
        deformation = solver.deform(pose)
    begin = time.perf_counter()
    for _ in range(_FRAMES):
        before, deformation = deformation, solver.deform(scene.path[-1])
        if deformation is before or time.perf_counter() - begin > _LONGEST:
            break
    settled = "settled" if deformation is before else "cut off"
    return (
        Outcome.of(model, deformation),
        f"own equations: {method} {settled} at residual {deformation.residual:.0e}",
    )


def solved_independently(
    scene: Scene, model: TissueModel, deformation: Deformation
) -> tuple[Outcome, str]:
    """The linear equations by scikit-fem and SciPy, with the contact that `fem` found."""
    pose, touched = scene.path[-1], deformation.contact_nodes
    _, normals = push_out(scene.collider, pose, deformation.nodes[touched], model.contact_spacing)
    depths = np.einsum("ij,ij->i", normals, deformation.nodes[touched] - model.mesh.nodes[touched])
    displacement, pushes = LinearEquations(model).solve(touched, normals, depths)
    force = -float(((pushes[:, None] * normals).sum(axis=0) @ pose.rotation)[2])
    volume = float(volumes(model, model.mesh.nodes + displacement).sum())
    return (
        Outcome(displacement, force, volume),
        "own equations: scikit-fem and SciPy on fem's contact",
    )
