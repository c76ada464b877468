"""The interface of all tissue solvers, and how one is made by its name.

A tissue as small as can be, on which a solver calls the same kernels as on another.

>>> from us_sim.tissue.solvers.solver import make_small_model
>>> len(make_small_model(TissueModel.make_block()).mesh.tetrahedra)
40
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from us_sim import Progress
from us_sim.errors import SolverError
from us_sim.geometry.pose import Pose, is_same_pose
from us_sim.settings.quantity import Quantity
from us_sim.settings.reading import SettingsReader
from us_sim.settings.registry import SOLVERS
from us_sim.settings.setting import Settings
from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, box_mesh
from us_sim.tissue.model import Deformation, Intervention, TissueModel, TissueState
from us_sim.tissue.solvers.discretisation_error import estimate_force_error

COUNT = Quantity("number", 1, 10_000)
"""Iterations, updates or steps in a frame."""
TOLERANCE = Quantity("number", 1e-15, 1.0)
"""The residual at which a solver stops."""

_FAILURES = 5
"""Frames in a row that may fail before the tissue is put to rest."""
_FARTHEST, _FARTHEST_FREE = 3.0, 10.0
"""A node that moved by this many times the mesh's longest side has left the tissue; the latter
where no node is fixed."""


@dataclass(frozen=True)
class SolverSettings(Settings):
    """Base of the settings of a solver, all of which may change while the tissue is deformed.

    Raises:
        SolverError: a value is out of range, with its name and the range.
    """

    error = SolverError
    live = True


class TissueSolver(ABC):
    """Deforms one tissue, frame by frame.

    A solver never returns a number that is not finite, nor nodes that flew off: when a frame fails
    so, the last good state stays and the deformation's ``actions`` report it. After several such
    frames in a row the tissue is put back to rest.

    Examples:
        >>> linear = create_solver("fem", TissueModel.make_block())
        >>> pressed = linear.deform(Pose(position=[0.0, 0.0, 0.01]))
        >>> nonlinear = create_solver("fem_nonlinear", linear.model)
        >>> nonlinear.take_over(linear.state)
        >>> linear.reset()
        >>> bool(linear.state.displacement.any()), bool(nonlinear.state.displacement.any())
        (False, True)
    """

    name: ClassVar[str]
    in_short: ClassVar[str] = ""
    """For whom chooses the method: what it is, and what it is good for."""
    Settings: ClassVar[type[SolverSettings]] = SolverSettings
    """The class of this method's settings. A solver is made with the model, its settings, and a
    callback that takes the fraction done and what is being made, or None."""
    must_be_held: ClassVar[bool] = False
    """True if every part of the mesh needs fixed nodes that hold it (`require_held`)."""
    bears_load: ClassVar[bool] = False
    """True if gravity and forces at nodes are among its equations."""
    most_unbalanced: ClassVar[float] = math.inf
    """Residual beyond which the contact forces are no longer those of the pose. Infinite where
    inertia holds the rest, as in a dynamic method."""

    def __init__(
        self,
        model: TissueModel,
        settings: SolverSettings | None = None,
        progress: Progress | None = None,  # noqa: ARG002
    ) -> None:
        self.model = model
        self.settings = settings if settings is not None else self.Settings()
        #: s, of the clock on the wall, that a frame may take where frames must keep up; or None.
        self.frame_limit: float | None = None
        if model.load.any() and not self.bears_load:
            raise SolverError(
                f"{self.name} knows no gravity and no forces at nodes: use fem or fem_nonlinear"
            )
        self._pose: Pose | None = None
        self._settled = True
        self._failures = 0  # frames in a row that failed
        farthest = _FARTHEST if model.fixed.any() else _FARTHEST_FREE
        self._reach = farthest * float(np.ptp(model.mesh.nodes, axis=0).max())
        self._last = self._resting()

    def deform(self, probe_pose: Pose | None) -> Deformation:
        """Advance a frame: move the probe and let the tissue follow.

        With a probe that has not moved and a tissue that has settled, nothing is computed.

        Args:
            probe_pose: in frame ``patient``, or None when no probe is near.
        """
        if self._settled and is_same_pose(probe_pose, self._pose):
            return self._last
        good = self.state
        deformation = self._advance(probe_pose)
        if self._is_plausible(deformation):
            self._pose = probe_pose
            self._failures = 0
            if deformation.residual > self.most_unbalanced:
                deformation = replace(deformation, is_balanced=False)
        else:
            deformation = self._recover(good)
        self._last = deformation
        return deformation

    @property
    def is_settled(self) -> bool:
        """True if another frame at the same pose would change nothing."""
        return self._settled

    def _recover(self, good: TissueState) -> Deformation:
        """Return the result in place of a frame that failed; the next one tries again."""
        self._failures += 1
        if self._failures < _FAILURES:
            action = "the frame came out not finite or far away, so the last good state was kept"
            done = Intervention.KEPT_STATE
            self._restore(good)
        else:
            action = (
                f"{_FAILURES} frames came out not finite or far away, so the tissue was put to rest"
            )
            done = Intervention.PUT_TO_REST
            self.reset()
        self._settled = False
        done |= Intervention.FRAME_FAILED
        return replace(self._last, actions=(action,), interventions=done, is_balanced=False)

    def reset(self) -> None:
        """Return to the undeformed tissue, with no probe near."""
        self._restore(TissueState.at_rest(len(self.model.mesh.nodes)))
        self._pose = None
        self._settled = True
        self._failures = 0
        self._last = self._resting()

    def take_over(self, state: TissueState) -> None:
        """Continue from the state of another solver of the same model.

        Raises:
            SolverError: the state has another number of nodes, is not finite, or moves a fixed one.
        """
        shape = self.model.mesh.nodes.shape
        if state.displacement.shape != shape or state.velocity.shape != shape:
            raise SolverError(
                f"the state to take over has {len(state.displacement)} nodes, the mesh "
                f"{shape[0]}: hand over a state of the same mesh"
            )
        if not (np.isfinite(state.displacement).all() and np.isfinite(state.velocity).all()):
            raise SolverError("the state to take over is not finite: reset the solver instead")
        if state.displacement[self.model.fixed].any():
            raise SolverError("the state to take over moves fixed nodes: it is of another model")
        self._restore(state)
        self._pose = None
        moves = state.displacement.any() or state.velocity.any() or self.model.load.any()
        self._settled = not moves
        self._last = replace(self._resting(), nodes=self.model.mesh.nodes + state.displacement)

    def warm_up(self) -> None:
        """Compile the kernels on a tissue of eight cells; the solver's own state stays."""
        self.compile_kernels(make_small_model(self.model), self.settings)

    @classmethod
    def compile_kernels(cls, model: TissueModel, settings: SolverSettings) -> None:
        """Make a solver for `warm_up`, and call every kernel that its frames may need."""
        try:
            solver = cls(model, settings)
        except SolverError:  # what suits the tissue need not suit one so small
            solver = cls(model)
        for depth in (0.002, 0.004):
            solver.deform(Pose(position=np.array([depth, 0.0, depth])))
            solver.compute_contact_stiffness()
            solver.estimate_discretisation_error()
        solver._compile_rare_kernels()
        solver.deform(None)

    def _compile_rare_kernels(self) -> None:  # noqa: B027 - most solvers have none of these
        """Call the kernels that only some frames need, for `warm_up`."""

    @property
    @abstractmethod
    def state(self) -> TissueState:
        """Copy of the tissue's displacement and velocity."""

    def compute_contact_stiffness(self) -> NDArray[np.float64] | None:
        """Compute how the wrench of the last frame changes with the probe's pose.

        Returns:
            (6, 6) as `us_sim.tissue.contact.stiffness` says, zero without contact; None where this
            solver does not know it.
        """
        return None

    def estimate_discretisation_error(self) -> float | None:
        """Estimate the relative L2 error of the last frame's displacement to the continuum's.

        Returns:
            None where nothing is deformed, or this solver does not know it.
        """
        return None

    def estimate_force_error(self) -> float | None:
        """Estimate by how much, relative, the mesh is too stiff, and so the last force off.

        Returns:
            None where nothing is deformed, or the method does not balance an elastic solid.
        """
        moved = self._last.nodes - self.model.mesh.nodes
        if not (self.bears_load and self._last.is_balanced and moved.any()):
            return None
        return estimate_force_error(self.model.mesh, self.model.materials, moved)

    @abstractmethod
    def _advance(self, pose: Pose | None) -> Deformation:
        """Compute one frame; set ``_settled``. ``_pose`` is still the frame before's."""

    @abstractmethod
    def _restore(self, state: TissueState) -> None:
        """Put the tissue where a state says."""

    def _is_plausible(self, deformation: Deformation) -> bool:
        numbers = (deformation.force, deformation.torque, deformation.residual)
        # A comparison with NaN is false.
        moved = np.abs(deformation.nodes - self.model.mesh.nodes).max()
        return bool(moved <= self._reach) and all(
            bool(np.isfinite(number).all()) for number in numbers
        )

    @property
    def _sag(self) -> NDArray[np.float64]:
        """(N, 3) m, displacement by the model's own load, where the probe is away."""
        return np.zeros_like(self.model.mesh.nodes)

    def _resting(self) -> Deformation:
        nodes = self.model.mesh.nodes + self._sag
        return Deformation(nodes, np.empty(0, np.int32), np.zeros(3), np.zeros(3), 0.0)


def create_solver(
    name: str,
    model: TissueModel,
    settings: SolverSettings | None = None,
    progress: Progress | None = None,
    **values: Any,
) -> TissueSolver:
    """Make a solver by the name that scenes and reports use.

    Args:
        name: one of `SOLVERS`.
        model: the tissue.
        settings: of the solver's own class.
        progress: called with the fraction done of what takes long, and what is being made.
        values: settings by name, instead of ``settings``.

    Raises:
        SolverError: no such solver or setting, a setting out of range, or a model it cannot solve.

    Examples:
        >>> from us_sim.geometry.pose import Pose
        >>> from us_sim.tissue.model import TissueModel
        >>> model = TissueModel.make_block()
        >>> solver = create_solver("fem_cg", model)
        >>> deformation = solver.deform(Pose(position=[0.0, 0.0, 0.012]))
        >>> bool(deformation.force[2] < 0)  # the tissue pushes the probe back
        True
    """
    solver = SOLVERS.load(name)
    if settings is None:
        settings = SettingsReader(f"solver {name}", error=SolverError).read(solver.Settings, values)
    made: TissueSolver = solver(model, settings, progress)
    return made


def make_small_model(model: TissueModel) -> TissueModel:
    """Make a tissue of eight cells whose frames use the same kernels as another's.

    It is like the other in what decides on kernels: a box mesh or another, the highest Poisson's
    ratio, how far moduli are apart, lumens, and the probe.
    """
    side = np.linspace(-0.01, 0.01, 3)
    mesh = box_mesh(side, side, side + 0.01)
    if model.mesh.planes is None:
        mesh = TetrahedralMesh(mesh.nodes, mesh.tetrahedra)
    own, count = model.materials, len(mesh.tetrahedra)
    hollow = np.arange(count) == 0
    return TissueModel(
        mesh,
        TissueMaterials(
            np.linspace(own.young_modulus.min(), own.young_modulus.max(), count),
            np.full(count, own.poisson_ratio.max()),
            np.full(count, own.density.max()),
            hollow * own.lumen_fraction.max(),
            hollow * own.lumen_pressure.max(),
        ),
        mesh.nodes[:, 2] > 0.015,
        model.collider,
        np.flatnonzero(mesh.nodes[:, 2] == 0.0).astype(np.int32),
    )
