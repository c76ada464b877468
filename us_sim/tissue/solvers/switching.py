"""One tissue, the solver that deforms it, and a second one beside it for comparison.

>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.elasticity.material import Material
>>> from us_sim.tissue.model import TissueModel
>>> from us_sim.tissue.solvers.switching import SwitchableTissue
>>> model = TissueModel.block(material=Material(10e3, 0.3, 1000.0))
>>> tissue = SwitchableTissue(model, "fem_cg")
>>> tissue.compare_with("fem")
>>> for _ in range(20):
...     deformation = tissue.deform(Pose(position=[0.0, 0.0, 0.01]))
>>> tissue.difference.maximum < 1e-5  # m: the same equations below Poisson's ratio 0.4
True
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import SolverError
from us_sim.geometry.pose import Pose
from us_sim.settings.registry import SOLVERS
from us_sim.tissue.elasticity.linear_tetrahedra import require_held
from us_sim.tissue.model import Deformation, TissueModel
from us_sim.tissue.solvers.compilation import compiled_solver
from us_sim.tissue.solvers.solver import SolverSettings, TissueSolver


@dataclass(frozen=True)
class Difference:
    """How far the nodes of two deformations are apart."""

    maximum: float  # m
    rms: float  # m


def difference(first: NDArray[np.float64], second: NDArray[np.float64]) -> Difference:
    """Largest and root-mean-square distance between two sets of node positions (N, 3) m."""
    square = ((first - second) ** 2).sum(axis=1)
    return Difference(float(np.sqrt(square.max())), float(np.sqrt(square.mean())))


@dataclass(frozen=True)
class Plan:
    """The solvers and settings with which a tissue is to be deformed."""

    solver: str  # name of the method
    compared: str = ""  # name of a second method that runs beside it, '' for none
    settings: Mapping[str, SolverSettings] = field(default_factory=dict)  # of methods by name
    model: Callable[[], TissueModel] | None = (
        None  # makes a new model; None to go on with the present one
    )
    reason: str = ""  # what was changed, for a person


@dataclass(frozen=True, eq=False)
class Prepared:
    """A plan with its solvers made and compiled."""

    plan: Plan
    model: TissueModel
    solvers: dict[str, TissueSolver]


class SwitchableTissue:
    """Deforms a tissue with one solver by name, and with another on the same poses if asked.

    Each solver is made once for a model and its settings, when it is first named.

    Args:
        model: shared by all solvers.
        name: of the solver in use.
        settings: of solvers by their names; those missing have their defaults.

    Raises:
        SolverError: as `create_solver`.
    """

    def __init__(
        self,
        model: TissueModel,
        name: str,
        settings: Mapping[str, SolverSettings] | None = None,
        progress: Callable[[float, str], None] | None = None,
    ) -> None:
        self._model = model
        self._solvers: dict[str, TissueSolver] = {}
        self._plan = Plan(name, settings=dict(settings or {}))
        self._solvers = self.make(self._plan, progress).solvers
        self._solver = self._solvers[name]
        self._beside: TissueSolver | None = None
        self._frame_limit: float | None = None
        self.difference: Difference | None = None

    @property
    def model(self) -> TissueModel:
        """The tissue as it is now."""
        return self._model

    @property
    def name(self) -> str:
        """Name of the solver in use."""
        return self._solver.name

    @property
    def compared(self) -> str:
        """Name of the solver beside it, '' when there is none."""
        return self._beside.name if self._beside else ""

    @property
    def is_settled(self) -> bool:
        """Whether another frame at the same pose would change nothing."""
        return self._solver.is_settled

    def limit_frames(self, duration: float | None) -> None:
        """Let no frame take longer than this (s) where the method can go on in the next."""
        self._frame_limit = duration
        for solver in filter(None, (self._solver, self._beside)):
            solver.frame_limit = duration

    def contact_stiffness(self) -> NDArray[np.float64] | None:
        """`TissueSolver.contact_stiffness` of the solver in use."""
        return self._solver.contact_stiffness()

    def make(
        self,
        plan: Plan,
        progress: Callable[[float, str], None] | None = None,
        *,
        beside: bool = False,
    ) -> Prepared:
        """Make and compile the solvers of a plan that are not there yet; nothing else changes.

        Args:
            plan: what is wanted.
            progress: as for `create_solver`, and told what is being compiled.
            beside: it is called in a thread of its own while another deforms the tissue, which is
                not to be held up.

        Raises:
            SolverError: no such solver, one compared with itself, or a model it cannot solve.
        """
        if plan.compared == plan.solver:
            raise SolverError(f"{plan.solver} is in use already: compare with another solver")
        model = plan.model() if plan.model else self._model
        solvers: dict[str, TissueSolver] = {}
        for name in filter(None, (plan.solver, plan.compared)):
            made = self._solvers.get(name)
            settings = plan.settings.get(name)
            if made is None or made.model is not model or settings not in (None, made.settings):
                made = self._made(name, model, settings, progress, beside)
            solvers[name] = made
        return Prepared(plan, model, solvers)

    def _made(
        self,
        name: str,
        model: TissueModel,
        settings: SolverSettings | None,
        progress: Callable[[float, str], None] | None,
        beside: bool,
    ) -> TissueSolver:
        cls: type[TissueSolver] = SOLVERS.load(name)
        if cls.must_be_held:  # before a minute of compiling
            require_held(model.mesh, model.fixed)
        return compiled_solver(cls, model, settings or cls.Settings(), progress, elsewhere=beside)

    def adopt(self, prepared: Prepared) -> None:
        """Go on with the solvers made, from where the tissue is."""
        plan, state = prepared.plan, self._solver.state
        if prepared.model is not self._model:
            self._model, self._solvers = prepared.model, {}
        self._solvers |= prepared.solvers
        self._plan = replace(plan, model=None)
        solver = prepared.solvers[plan.solver]
        if solver is not self._solver:
            solver.take_over(state)
            solver.frame_limit = self._frame_limit
            self._solver = solver
        beside = prepared.solvers.get(plan.compared)
        if beside is not self._beside:
            self.difference = None
            if beside is not None:
                beside.take_over(state)
                beside.frame_limit = self._frame_limit
        self._beside = beside

    def use(self, name: str) -> None:
        """Switch to another solver; it goes on from where the tissue is.

        Raises:
            SolverError: no such solver, or it cannot solve this model.
        """
        compared = "" if name == self.compared else self.compared
        self.adopt(self.make(replace(self._plan, solver=name, compared=compared)))

    def compare_with(self, name: str, progress: Callable[[float, str], None] | None = None) -> None:
        """Run a second solver on the same poses from here on; '' ends it.

        Args:
            name: of the solver.
            progress: as for `make`.

        Raises:
            SolverError: it is the one in use.
        """
        self.adopt(self.make(replace(self._plan, compared=name), progress))

    def reset(self) -> None:
        """Bring the tissue to rest, as after a frame that failed halfway."""
        for solver in filter(None, (self._solver, self._beside)):
            solver.reset()
        self.difference = None

    def deform(self, pose: Pose | None) -> Deformation:
        """One frame of the solver in use, and of the one beside it."""
        deformation = self._solver.deform(pose)
        if self._beside is not None:
            other = self._beside.deform(pose)
            self.difference = difference(deformation.nodes, other.nodes)
        return deformation
