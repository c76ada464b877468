"""The paper's finite element method: linear strain, a few conjugate-gradient iterations a frame.

Quasi-static: every frame goes on from the last one's displacement towards K u = f, where the only
load is a frictionless probe that may push and not pull. The nodes it pushes lie on its surface:
their displacement along the normal is prescribed and projected out of the search space, as in
D. Baraff and A. Witkin, Large Steps in Cloth Simulation, SIGGRAPH 1998, section 5.

>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.solvers.fem_cg import FemCg
>>> from us_sim.tissue.model import TissueModel
>>> solver = FemCg(TissueModel.make_block())
>>> for _ in range(20):
...     deformation = solver.deform(Pose(position=[0.0, 0.0, 0.01]))
>>> deformation.residual < 1e-6, bool(deformation.nodes[:, 2].min() > -0.01)
(True, True)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from us_sim import Progress
from us_sim.geometry.pose import Pose, is_same_pose
from us_sim.settings.setting import setting
from us_sim.tissue.contact.active_set import ActiveSet
from us_sim.tissue.contact.probe_gap import wrench_on_probe
from us_sim.tissue.elasticity.linear_tetrahedra import (
    assemble_stiffness,
    drop_fixed_nodes,
    require_held,
)
from us_sim.tissue.elasticity.stability import count_inverted, select_watched_tetrahedra
from us_sim.tissue.linear_algebra.conjugate_gradients import product_rows, run_conjugate_gradients
from us_sim.tissue.model import Deformation, TissueModel, TissueState
from us_sim.tissue.solvers.solver import COUNT, TOLERANCE, SolverSettings, TissueSolver

_REFINEMENT = 1e-2
"""Fraction to which the residual must fall before touched nodes that slid a little are
corrected."""


@dataclass(frozen=True)
class FemCgSettings(SolverSettings):
    """The settings of the solver ``fem_cg``."""

    section = "fem_cg"

    iterations: int = setting(
        COUNT, "conjugate-gradient iterations in a frame; the paper has 20", default=20
    )
    tolerance: float = setting(TOLERANCE, "residual at which a frame stops early", default=1e-6)
    contact_updates: int = setting(
        COUNT, "how often in a frame the set of touched nodes is revised", default=3
    )


class FemCg(TissueSolver):
    """Linear elasticity by preconditioned conjugate gradients with warm start.

    The residual is the norm of the unbalanced nodal forces (those on free nodes, those along the
    probe's surface on touched nodes, and any with which the probe would have to pull) over the norm
    of the contact forces; after a release, over the largest there were.

    Args:
        model: at least three fixed nodes that are not on one line in every connected part.
        settings: see `FemCgSettings`.

    Raises:
        SolverError: a setting is out of range, or the tissue is not held.
    """

    name: ClassVar[str] = "fem_cg"
    in_short: ClassVar[str] = (
        "linear elasticity as in the paper, nearly solved in each frame: for comparison"
    )
    must_be_held: ClassVar[bool] = True
    most_unbalanced: ClassVar[float] = 0.3  # within 11 % in 95 of 100 frames

    Settings = FemCgSettings

    def __init__(
        self,
        model: TissueModel,
        settings: FemCgSettings | None = None,
        progress: Progress | None = None,
    ) -> None:
        require_held(model.mesh, model.fixed)
        settings = settings or FemCgSettings()
        super().__init__(model, settings, progress)
        self._watched = select_watched_tetrahedra(model)
        self._tolerance = settings.tolerance
        updates = min(settings.contact_updates, settings.iterations)
        self._rounds = np.diff(np.linspace(0, settings.iterations, updates + 1).round().astype(int))

        free = ~model.fixed
        matrix = drop_fixed_nodes(assemble_stiffness(model.mesh, model.materials), model.fixed)
        self._free = np.flatnonzero(free)
        self._matrix = (matrix.indptr, matrix.indices, matrix.data)
        rows = np.repeat(np.arange(len(self._free)), np.diff(matrix.indptr))
        self._inverse = np.linalg.inv(matrix.data[rows == matrix.indices])
        touchable = model.movable_contact_nodes
        self._touchable = (np.cumsum(free) - 1)[touchable]
        self._contact = ActiveSet(
            model.collider, model.mesh.nodes[touchable], model.contact_spacing
        )

        self._displacement = np.zeros((len(self._free), 3))
        self._residual = np.zeros_like(self._displacement)
        self._direction = np.zeros_like(self._displacement)
        self._product = np.zeros_like(self._displacement)
        self._restore(self.state)

    @property
    def state(self) -> TissueState:
        """Displacement of the tissue; a quasi-static solver has no velocity."""
        state = TissueState.at_rest(len(self.model.mesh.nodes))
        state.displacement[self._free] = self._displacement
        return state

    def _restore(self, state: TissueState) -> None:
        self._displacement[:] = state.displacement[self._free]
        self._contact.clear()
        self._renew_equations()
        # N, norm of the contact forces that the residual refers to, and the largest since rest.
        self._reference = self._largest_load = 0.0
        self._taken_over = bool(self._displacement.any())

    def _renew_equations(self) -> None:
        """Constrain the preconditioner to the touched nodes' tangents, and search anew."""
        touched = self._contact.touched
        self._touched = self._touchable[touched]
        self._normal = self._contact.normal[touched]
        self._preconditioner = self._inverse.copy()
        along = np.einsum("nij,nj->ni", self._inverse[self._touched], self._normal)
        compliance = np.einsum("ni,ni->n", along, self._normal)
        self._preconditioner[self._touched] -= (
            along[:, :, None] * along[:, None, :] / compliance[:, None, None]
        )
        self._slope = -1.0
        self._norm, self._refine_at = math.inf, 0.0

    def _advance(self, pose: Pose | None) -> Deformation:
        contact, displacement = self._contact, self._displacement
        untouched = self._settled and not contact.touched.any()
        if untouched and contact.is_consistent(pose, displacement[self._touchable]):
            return self._resting()
        if self._taken_over and pose is not None:
            contact.mark_touching(pose, displacement[self._touchable])
            self._renew_equations()
        self._taken_over = False
        moved = not is_same_pose(pose, self._pose)
        for round_number, iterations in enumerate(self._rounds):
            surface = displacement[self._touchable]
            enough = 0.5 * self._tolerance * self._reference
            exactly = self._norm <= max(self._refine_at, enough)
            if contact.update(pose, surface, exactly=exactly, moved=round_number == 0 and moved):
                displacement[self._touchable] = surface
                self._renew_equations()
            anew = self._slope < 0.0
            self._slope, before, self._norm = run_conjugate_gradients(
                *self._matrix,
                self._preconditioner,
                self._touched,
                self._normal,
                displacement,
                self._residual,
                self._direction,
                self._product,
                self._slope,
                self._norm,
                iterations,
                enough,
            )
            if anew:
                self._refine_at = _REFINEMENT * before
            contact.set_forces(product_rows(*self._matrix, displacement, self._touchable))
            load = float(np.linalg.norm(np.maximum(contact.normal_force, 0.0)))
            self._reference = load or self._largest_load
        return self._make_deformation(pose)

    def _make_deformation(self, pose: Pose | None) -> Deformation:
        contact, displacement = self._contact, self._displacement
        everywhere = np.arange(len(self._free), dtype=self._touchable.dtype)
        unbalanced = product_rows(*self._matrix, displacement, everywhere)
        normal = contact.compute_normals(pose, displacement[self._touchable])
        holding = np.einsum("ij,ij->i", unbalanced[self._touchable], normal)
        push = np.where(contact.touched, np.maximum(holding, 0.0), 0.0)[:, None] * normal
        unbalanced[self._touchable] -= push
        residual_norm = float(np.linalg.norm(unbalanced))
        load = float(np.linalg.norm(push))
        # The latter for a state taken over without contact.
        self._largest_load = max(self._largest_load, load) or residual_norm
        self._reference = load or self._largest_load
        residual = residual_norm / self._reference if self._reference else 0.0
        balanced = residual <= self._tolerance
        self._settled = balanced and contact.is_consistent(pose, displacement[self._touchable])
        nodes = self.model.mesh.nodes.copy()
        nodes[self._free] += displacement
        resting = self._settled or np.array_equal(nodes, self.model.mesh.nodes)
        if resting and not contact.touched.any():
            # Without a load the exact solution is the rest state.
            nodes, displacement[:] = self.model.mesh.nodes.copy(), 0.0
            self._largest_load = self._reference = residual = 0.0
            self._slope = -1.0
        elif not balanced and self._slope == 0.0:
            # The updated residual has drifted from the true one.
            self._slope = -1.0
        pushing = push.any(axis=1)
        pushed = self.model.movable_contact_nodes[pushing]
        force, torque = np.zeros(3), np.zeros(3)
        if pose is not None:
            force, torque = wrench_on_probe(pose, nodes[pushed], push[pushing])
        inverted = count_inverted(nodes, self._watched)
        return Deformation(nodes, pushed, force, torque, residual, inverted=inverted)
