"""The exact linear finite element method: every frame is solved to rounding, not iterated towards.

The stiffness is constant. So the displacement field of a unit force on each node that the probe can
reach is computed once (`us_sim.tissue.linear_algebra.compliance`). A frame finds the forces on
these nodes, as a small complementarity problem (`us_sim.tissue.contact.compliant_contact`), and
adds up their fields.

>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.solvers.fem import Fem
>>> from us_sim.tissue.model import TissueModel
>>> solver = Fem(TissueModel.make_block())
>>> deformation = solver.deform(Pose(position=[0.0, 0.0, 0.01]))
>>> deformation.residual < 1e-6, bool(deformation.force[2] < 0)
(True, True)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from us_sim import Progress
from us_sim.geometry.pose import Pose
from us_sim.tissue.contact.compliant_contact import CompliantContact
from us_sim.tissue.contact.probe_gap import wrench_on_probe
from us_sim.tissue.contact.stiffness import compliance_between, compute_contact_stiffness
from us_sim.tissue.elasticity.stability import count_inverted, select_watched_tetrahedra
from us_sim.tissue.linear_algebra.compliance import compute_compliance, compute_loaded_displacement
from us_sim.tissue.model import Deformation, TissueModel, TissueState
from us_sim.tissue.solvers.solver import SolverSettings, TissueSolver

_EXTENSIONS = 10
"""Times that nodes overlooked at first, being far from the probe, may be added in a frame."""


@dataclass(frozen=True)
class FemSettings(SolverSettings):
    """The settings of the solver ``fem``."""

    section = "fem"


class Fem(TissueSolver):
    """Linear elasticity under a probe, by the compliance of the surface that it can reach.

    The residual is the error of the stored fields by rounding, together with the forces along the
    surface of a curved probe. Rounding is known exactly, by products of what it left unbalanced in
    the fields of unit forces; of a large mesh by a median, as measured when the fields were made.

    Args:
        model: at least three fixed nodes that are not on one line in every connected part.
        settings: see `FemSettings`.

    Raises:
        SolverError: a setting is out of range, the tissue is not held, or is too large.
    """

    name: ClassVar[str] = "fem"
    in_short: ClassVar[str] = (
        "linear elasticity, fastest: for light presses, too stiff or too soft for deep ones"
    )
    must_be_held: ClassVar[bool] = True
    bears_load: ClassVar[bool] = True

    Settings = FemSettings

    def __init__(
        self,
        model: TissueModel,
        settings: FemSettings | None = None,
        progress: Progress | None = None,
    ) -> None:
        settings = settings or FemSettings()
        self._compliance = compute_compliance(model, progress)
        self._reached = self._compliance.nodes
        self._loaded = compute_loaded_displacement(model)
        self._contact = CompliantContact(
            model.collider,
            (model.mesh.nodes + self._loaded)[self._reached],
            model.contact_spacing,
            self._compliance.matrix,
        )
        self._watched = select_watched_tetrahedra(model)
        self._displacement = self._loaded.copy()
        super().__init__(model, settings, progress)

    @property
    def state(self) -> TissueState:
        """Displacement of the tissue; a quasi-static solver has no velocity."""
        return TissueState(self._displacement.copy(), np.zeros_like(self._displacement))

    @property
    def _sag(self) -> NDArray[np.float64]:
        return self._loaded

    def compute_contact_stiffness(self) -> NDArray[np.float64] | None:
        """Compute the stiffness exactly, as the tissue is linear."""
        pushed = np.flatnonzero(self._contact.forces.any(axis=1))
        if self._pose is None or len(pushed) == 0:
            return np.zeros((6, 6))
        touched = self._reached[pushed]
        return compute_contact_stiffness(
            self.model.collider,
            self._pose,
            self.model.mesh.nodes[touched] + self._displacement[touched],
            self._contact.forces[pushed],
            compliance_between(self._compliance.matrix, pushed),
            self.model.contact_spacing,
        )

    def _restore(self, state: TissueState) -> None:
        self._displacement = state.displacement.copy()
        self._contact.clear()

    def _advance(self, pose: Pose | None) -> Deformation:
        contact, compliance = self._contact, self._compliance
        actions: tuple[str, ...] = ()
        if pose is None:
            contact.clear()
        else:
            solved = contact.press_at(pose)
            displacement = compliance.compute_displacement(contact.forces)
            for _ in range(_EXTENSIONS):
                if not contact.add_overlooked(pose, displacement[self._reached]):
                    break
                solved = contact.solve(pose)
                displacement = compliance.compute_displacement(contact.forces)
            else:
                solved = False
            if not solved:
                actions = ("the contact did not settle, so the nearest solution found was kept",)
        self._settled = True
        pushed = np.flatnonzero(contact.forces.any(axis=1))
        if pose is None or len(pushed) == 0:
            contact.clear()
            self._displacement = self._loaded.copy()
            return self._resting()
        displacement[self._reached[contact.near]] = contact.displacement[contact.near]
        displacement += self._loaded
        self._displacement = displacement
        nodes = self.model.mesh.nodes + displacement
        touched = self._reached[pushed]
        forces = contact.forces[pushed]
        force, torque = wrench_on_probe(pose, nodes[touched], forces)
        load = float(np.linalg.norm(forces))
        residual = math.hypot(
            contact.sliding_force / load, compliance.compute_imbalance(contact.forces)
        )
        inverted = count_inverted(nodes, self._watched)
        return Deformation(nodes, touched, force, torque, residual, actions, inverted)
