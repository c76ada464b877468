"""Inputs that no solver may start on: each must be refused in one sentence.

>>> from us_sim.evaluation.stability.refusals import REFUSALS, refusal_of
>>> trial = refusal_of("fem_cg", "a node is not a number")
>>> trial.refused, trial.passed
(True, True)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from us_sim.errors import UsSimError
from us_sim.evaluation.stability.cases import StabilityCase, model_of
from us_sim.evaluation.stability.meshes import mesh_named
from us_sim.evaluation.stability.points import Trial
from us_sim.geometry.collider import Sphere
from us_sim.geometry.pose import Pose
from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.tissue.model import TissueModel, TissueState
from us_sim.tissue.solvers.solver import create_solver


def refusal_of(method: str, name: str) -> Trial:
    """What a method does with one of the inputs of `REFUSALS`."""
    trial = Trial()
    try:
        REFUSALS[name](method)
    except UsSimError as error:
        trial.refused = True
        trial.say(f"refused: {error}")
    except Exception as error:  # whatever it is, a user would see a traceback
        trial.failure = f"raised {type(error).__name__} instead of refusing: {error}"
    else:
        trial.failure = "was not refused"
    return trial


def _moved_node(method: str, node: int, place: list[float]) -> None:
    mesh = mesh_named("box")
    nodes = mesh.nodes.copy()
    nodes[node] = place
    _solve(method, TetrahedralMesh(nodes, mesh.tetrahedra))


def _other_tetrahedra(method: str, tetrahedra: np.ndarray, more_nodes: int = 0) -> None:
    nodes = mesh_named("box").nodes
    _solve(method, TetrahedralMesh(np.concatenate([nodes, nodes[:more_nodes] + 1]), tetrahedra))


def _inverted(method: str) -> None:
    tetrahedra = mesh_named("box").tetrahedra.copy()
    tetrahedra[7] = tetrahedra[7][[0, 2, 1, 3]]
    _other_tetrahedra(method, tetrahedra)


def _flat(method: str) -> None:
    mesh = mesh_named("tetrahedron")
    _solve(method, TetrahedralMesh(mesh.nodes * [1.0, 1.0, 1e-12], mesh.tetrahedra))


def _doubled_nodes(method: str) -> None:
    box = mesh_named("box")
    nodes = np.concatenate([box.nodes, box.nodes])
    both = np.concatenate([box.tetrahedra, box.tetrahedra + len(box.nodes)])
    _solve(method, TetrahedralMesh(nodes, both))


def _solve(method: str, mesh: TetrahedralMesh) -> None:
    constants = (np.full(len(mesh.tetrahedra), value) for value in (1e4, 0.45, 1e3))
    materials = TissueMaterials(*constants)
    fixed = mesh.nodes[:, 2] >= mesh.nodes[:, 2].max()
    reached = np.flatnonzero(mesh.nodes[:, 2] <= 0).astype(np.int32)
    create_solver(method, TissueModel(mesh, materials, fixed, Sphere(0.03), reached))


def _constant(method: str, **constants: float) -> None:
    create_solver(method, model_of(StabilityCase("unused", **constants)))  # type: ignore[arg-type]


def _setting(method: str, **settings: Any) -> None:
    create_solver(method, model_of(StabilityCase("unused")), **settings)


def _pose(method: str, pose: Callable[[], Pose]) -> None:
    create_solver(method, model_of(StabilityCase("unused"))).deform(pose())


def _state(method: str, displacement: float, count: int = 64) -> None:
    solver = create_solver(method, model_of(StabilityCase("unused")))
    state = TissueState.at_rest(count)
    state.displacement[0] = displacement
    solver.take_over(state)


REFUSALS: dict[str, Callable[[str], None]] = {
    "a node is not a number": lambda m: _moved_node(m, 5, [np.nan, 0.0, 0.0]),
    "a node is at infinity": lambda m: _moved_node(m, 5, [0.0, np.inf, 0.0]),
    "a node pulled through its neighbours": lambda m: _moved_node(m, 21, [0.2, 0.2, 0.2]),
    "a node on its neighbour": lambda m: _moved_node(m, 5, mesh_named("box").nodes[6].tolist()),
    "an inverted tetrahedron": _inverted,
    "a flat tetrahedron": _flat,
    "every node twice": _doubled_nodes,
    "a tetrahedron twice": lambda m: _other_tetrahedra(
        m, np.concatenate([mesh_named("box").tetrahedra, mesh_named("box").tetrahedra[:1]])
    ),
    "a node of no tetrahedron": lambda m: _other_tetrahedra(m, mesh_named("box").tetrahedra, 1),
    "a node that is not there": lambda m: _other_tetrahedra(m, mesh_named("box").tetrahedra + 9),
    "no tetrahedra": lambda m: _other_tetrahedra(m, np.empty((0, 4), dtype=np.int32)),
    "a modulus of zero": lambda m: _constant(m, young_modulus=0.0),
    "a negative modulus": lambda m: _constant(m, young_modulus=-1e4),
    "a modulus that is not a number": lambda m: _constant(m, young_modulus=np.nan),
    "an infinite modulus": lambda m: _constant(m, young_modulus=np.inf),
    "Poisson's ratio of one half": lambda m: _constant(m, poisson_ratio=0.5),
    "Poisson's ratio of minus one": lambda m: _constant(m, poisson_ratio=-1.0),
    "no density": lambda m: _constant(m, density=0.0),
    "an unknown setting": lambda m: _setting(m, patience=3),
    "a pose that is not a number": lambda m: _pose(m, lambda: Pose(np.array([0, 0, np.nan]))),
    "a pose without orientation": lambda m: _pose(m, lambda: Pose(np.zeros(3), np.zeros(4))),
    "a state that is not a number": lambda m: _state(m, np.nan),
    "a state of another mesh": lambda m: _state(m, 0.0, 9),
}
"""Each gives a method one broken input, by what is wrong with it."""
