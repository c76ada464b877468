"""A method's own equations, solved without regard to time: what more iterations would give."""

from __future__ import annotations

import time

import numpy as np

from us_sim.evaluation.tissue.cases import Scene
from us_sim.evaluation.tissue.linear_equations import LinearEquations
from us_sim.evaluation.tissue.points import Outcome
from us_sim.evaluation.tissue_methods import Setting, TissueMethod
from us_sim.tissue.contact.probe_gap import push_out
from us_sim.tissue.deformation import Deformation
from us_sim.tissue.mesh.check import signed_volumes
from us_sim.tissue.model import TissueModel
from us_sim.tissue.solvers.solver import create_solver

_FRAMES = 400  # at the last pose, at the most
_LONGEST = 10.0  # s, of these frames together


def converged(
    scene: Scene, model: TissueModel, method: TissueMethod, setting: Setting
) -> tuple[Outcome, str]:
    """The scene's end by an iterative method that goes on until nothing changes.

    The words say how far it came.
    """
    patient = method.without_effort(setting) | dict(method.patient or {})
    solver = create_solver(method.name, model, **patient)
    for pose in scene.path:
        deformation = solver.deform(pose)
    begin = time.perf_counter()
    for _ in range(_FRAMES):
        before, deformation = deformation, solver.deform(scene.path[-1])
        if deformation is before or time.perf_counter() - begin > _LONGEST:
            break
    settled = "settled" if deformation is before else "cut off"
    words = f"own equations: {method.name} {settled} at residual {deformation.residual:.0e}"
    return Outcome.of(model, deformation), words


def solved_independently(
    scene: Scene, model: TissueModel, deformation: Deformation
) -> tuple[Outcome, str]:
    """The linear equations by scikit-fem and SciPy, with the contact that `fem` found."""
    pose, touched = scene.path[-1], deformation.contact_nodes
    _, normals = push_out(scene.collider, pose, deformation.nodes[touched], model.contact_spacing)
    depths = np.einsum("ij,ij->i", normals, deformation.nodes[touched] - model.mesh.nodes[touched])
    displacement, pushes = LinearEquations(model).solve(touched, normals, depths)
    force = -float(((pushes[:, None] * normals).sum(axis=0) @ pose.rotation)[2])
    nodes = model.mesh.nodes + displacement
    volume = float(signed_volumes(nodes, model.mesh.tetrahedra).sum())
    words = "own equations: scikit-fem and SciPy on fem's contact"
    return Outcome(displacement, force, volume), words
