"""One tissue, the solver that deforms it, and a second one beside it for comparison.

>>> import numpy as np
>>> from us_sim.geometry.collider import Sphere
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.mesh.node_selection import face_nodes
>>> from us_sim.tissue.elasticity.materials import Material, uniform_material
>>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
>>> from us_sim.tissue.model import TissueModel
>>> from us_sim.tissue.solvers.switching import SwitchableTissue
>>> across, deep = uniform_planes(-0.05, 0.05, 6), uniform_planes(0.0, 0.1, 6)
>>> mesh = box_mesh(across, across, deep)
>>> fixed = np.isin(np.arange(len(mesh.nodes)), face_nodes(mesh, "bottom"))
>>> materials = uniform_material(mesh, Material(10e3, 0.3, 1000.0))
>>> model = TissueModel(mesh, materials, fixed, Sphere(0.03), face_nodes(mesh, "top"))
>>> tissue = SwitchableTissue(model, "fem_cg")
>>> tissue.compare_with("fem")
>>> for _ in range(20):
...     deformation = tissue.deform(Pose(position=[0.0, 0.0, 0.01]))
>>> tissue.difference.maximum < 1e-5  # m: the same equations below Poisson's ratio 0.4
True
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import SolverError
from us_sim.geometry.pose import Pose
from us_sim.tissue.deformation import Deformation
from us_sim.tissue.model import TissueModel
from us_sim.tissue.solvers.solver import TissueSolver, create_solver

__all__ = ["Difference", "SwitchableTissue", "difference"]


@dataclass(frozen=True)
class Difference:
    """How far the nodes of two deformations are apart."""

    maximum: float  # m
    rms: float  # m


def difference(first: NDArray[np.float64], second: NDArray[np.float64]) -> Difference:
    """Largest and root-mean-square distance between two sets of node positions (N, 3) m."""
    square = ((first - second) ** 2).sum(axis=1)
    return Difference(float(np.sqrt(square.max())), float(np.sqrt(square.mean())))


class SwitchableTissue:
    """Deforms a tissue with one solver by name, and with another on the same poses if asked.

    Each solver is made once, when it is first named.

    Args:
        model: shared by all solvers.
        name: of the solver in use.
        settings: of each solver by its name.

    Raises:
        SolverError: as `create_solver`.
    """

    def __init__(
        self, model: TissueModel, name: str, settings: Mapping[str, Mapping[str, Any]] | None = None
    ) -> None:
        self._model = model
        self._settings = settings or {}
        self._solvers: dict[str, TissueSolver] = {}
        self._solver = self.prepare(name)
        self._beside: TissueSolver | None = None
        self.difference: Difference | None = None

    @property
    def name(self) -> str:
        """Of the solver in use."""
        return self._solver.name

    @property
    def compared(self) -> str:
        """Name of the solver beside it, '' when there is none."""
        return self._beside.name if self._beside else ""

    def contact_stiffness(self) -> NDArray[np.float64] | None:
        """Of the solver in use, see `TissueSolver.contact_stiffness`."""
        return self._solver.contact_stiffness()

    def prepare(self, name: str) -> TissueSolver:
        """Make and compile a solver, so that a later switch to it takes no time.

        Raises:
            SolverError: no such solver, or it cannot solve this model.
        """
        if name not in self._solvers:
            solver = create_solver(name, self._model, **self._settings.get(name, {}))
            solver.warm_up()
            self._solvers[name] = solver
        return self._solvers[name]

    def use(self, name: str) -> None:
        """Switch to another solver; it goes on from where the tissue is."""
        if name == self.name:
            return
        solver = self.prepare(name)
        if solver is self._beside:
            self.compare_with("")
        solver.take_over(self._solver.state)
        self._solver = solver

    def compare_with(self, name: str) -> None:
        """Run a second solver on the same poses from here on; '' ends it.

        Raises:
            SolverError: it is the one in use.
        """
        self.difference = None
        if not name:
            self._beside = None
            return
        if name == self.name:
            raise SolverError(f"{name} is in use already: compare with another solver")
        self._beside = self.prepare(name)
        self._beside.take_over(self._solver.state)

    def deform(self, pose: Pose | None) -> Deformation:
        """One frame of the solver in use, and of the one beside it."""
        deformation = self._solver.deform(pose)
        if self._beside is not None:
            other = self._beside.deform(pose)
            self.difference = difference(deformation.nodes, other.nodes)
        return deformation
