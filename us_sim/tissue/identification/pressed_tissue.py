"""Tissue and contact of `fem_nonlinear` at a displacement, and how both change with the moduli.

At rest under the probe no node is pulled: r(u, m) = 0, with r the tissue's forces less the
contact's at the displacement u, and m the logarithms of Young's moduli. So by the implicit function
theorem

    K du/dm = -dr/dm,    K = dr/du,    dw/dm = w_m + w_u du/dm

for the wrench w(u, m) on the probe, K being the exact tangent with the springs of the contact that
are pressed now (as for images in A. A. Oberai, N. H. Gokhale and G. R. Feijoo, Solution of inverse
problems in elasticity imaging using the adjoint method, Inverse Problems 19, 2003). That takes one
linear solution for each modulus in place of another press.

>>> import numpy as np
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.identification.pressed_tissue import PressedTissue
>>> from us_sim.tissue.model import TissueModel
>>> from us_sim.tissue.solvers.fem_nonlinear import FemNonlinear
>>> model, pose = TissueModel.block(), Pose(position=[0.0, 0.0, 0.01])
>>> solver = FemNonlinear(model)
>>> pressed = [solver.deform(pose) for _ in range(20)][-1]
>>> tissue = PressedTissue(model)
>>> tissue.put(pose, np.ascontiguousarray((pressed.nodes - model.mesh.nodes).T))
>>> bool(np.linalg.norm(tissue.unbalanced) < 1e-4 * np.linalg.norm(pressed.force))
True
>>> bool(np.allclose(tissue.wrench[:3], pressed.force))
True
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import SolverError
from us_sim.geometry.pose import Pose
from us_sim.tissue.contact.probe_gap import FlaredProbe, wrench_on_probe
from us_sim.tissue.contact.surface_points import add_springs, add_turns, surface_contact
from us_sim.tissue.elasticity.neo_hookean import NeoHookean
from us_sim.tissue.linear_algebra.coarse_grid import CoarseGrid
from us_sim.tissue.linear_algebra.two_level import (
    TwoLevel,
    conjugate_gradients,
    largest_local_eigenvalue,
)
from us_sim.tissue.model import TissueModel

_LOCAL_WEIGHT = 12.0
"""As in `us_sim.tissue.solvers.newton`."""

_TOLERANCE = 1e-6
"""Unbalanced force of a sensitivity, over the force that a modulus changes."""

_MOST_ITERATIONS, _UNSOLVED = 3000, 1e-3
"""Iterations, and the same fraction with which no answer counts as one."""


class Slopes(NamedTuple):
    """How a press changes with the logarithms of P moduli."""

    wrench: NDArray[np.float64]  # (6, P) N and N m, frame probe
    displacement: NDArray[np.float64]  # (P, 3, N) m


class PressedTissue:
    """Forces, wrench and tangent of a model at a displacement that is put.

    Args:
        model: of the tissue and the probe; contact is without friction.
    """

    def __init__(self, model: TissueModel) -> None:
        self.model = model
        self._tissue = NeoHookean(model.mesh, model.materials, np.float64)
        self._points, self._contact = surface_contact(model)
        self._probe = FlaredProbe(model.collider, model.contact_spacing)
        self._fixed = np.flatnonzero(model.fixed)
        self._preconditioner: TwoLevel | None = None

    def clearance(self, pose: Pose) -> float:
        """How far (m) the probe is from the undeformed tissue; below zero inside it."""
        gap, _ = self._probe.distance(pose, self._points.rest)
        return float(gap.min(initial=np.inf))

    def put(self, pose: Pose, displacement: NDArray[np.float64]) -> None:
        """Put the probe at a pose and the nodes at a displacement (3, N) m."""
        self._pose, self._displacement = pose, displacement
        at = self._points.rest + self._points.moved(displacement)
        self._contact.set_pose(pose, at)
        self._contact.drop_planes(at)

    @property
    def _pushes(self) -> NDArray[np.float64]:
        """(3, N) N, with which the probe pushes the nodes."""
        pushes = np.zeros_like(self._displacement)
        self._points.add(self._contact.force, pushes, self._contact.near)
        return pushes

    @property
    def unbalanced(self) -> NDArray[np.float64]:
        """(3, N) N, forces of the tissue less those of the probe; zero at fixed nodes."""
        forces = self._tissue.forces(self._displacement) - self._pushes
        forces[:, self._fixed] = 0.0
        return forces

    @property
    def wrench(self) -> NDArray[np.float64]:
        """(6,) N and N m, of the tissue on the probe about its origin, frame ``probe``."""
        touched = self.model.contact_nodes
        places = self.model.mesh.nodes[touched] + self._displacement.T[touched]
        return np.concatenate(wrench_on_probe(self._pose, places, self._pushes[:, touched].T))

    def solve(self, force: NDArray[np.float64]) -> NDArray[np.float64]:
        """(3, N) m, by which a small force (3, N) N would move the nodes, probe and all else alike.

        Raises:
            SolverError: the tissue is about to buckle, so that no force can say how it moves.
        """
        contact, points, tissue = self._contact, self._points, self._tissue
        tissue.linearise(self._displacement)
        still = np.zeros_like(contact.normal)
        active, directions, stiffness = contact.springs_after(still)
        springs = points.nodes[active], points.weights[active], directions, stiffness
        at = points.rest + points.moved(self._displacement)
        turned, turn = contact.geometric_stiffness(at, contact.normal_force)
        bend = points.nodes[turned], points.weights[turned], -turn

        def product(change: NDArray, image: NDArray) -> None:
            tissue.tangent_product(change, image)
            add_springs(*springs, change, image)
            if len(turned):
                add_turns(*bend, change, image)

        preconditioner = self._two_level()
        preconditioner.prepare(
            tissue.diagonal_blocks(), *points.lumped(active, directions, stiffness)
        )
        residual = force.copy()
        residual[:, self._fixed] = 0.0
        size = float(np.linalg.norm(residual))
        if size == 0.0:
            return np.zeros_like(force)
        left = residual / size
        solved = conjugate_gradients(product, preconditioner, left, _MOST_ITERATIONS, _TOLERANCE)
        # A state of symmetry may be a ridge, on which forces that keep the symmetry have an answer.
        if float(np.linalg.norm(left)) > _UNSOLVED:
            raise SolverError(
                "the pressed tissue is about to buckle, so that its answer to another modulus "
                "cannot be told"
            )
        return np.asarray(size * solved.solution)

    def _two_level(self) -> TwoLevel:
        if self._preconditioner is None:
            model, tissue = self.model, self._tissue
            tissue.linearise(np.zeros((3, tissue.count)))
            grid = CoarseGrid(model.mesh, model.fixed, tissue.tangent_product, np.float64)
            most = largest_local_eigenvalue(
                tissue.diagonal_blocks(), tissue.tangent_product, self._fixed
            )
            self._preconditioner = TwoLevel(grid, self._fixed, _LOCAL_WEIGHT / most)
            tissue.linearise(self._displacement)
        return self._preconditioner


def slopes(
    tissue: PressedTissue,
    varied: Sequence[PressedTissue],
    step: float,
    pose: Pose,
    displacement: NDArray[np.float64],
) -> Slopes:
    """How wrench and displacement of a balanced tissue change with each of P moduli.

    Args:
        tissue: whose forces balance.
        varied: the same with the logarithm of one modulus larger by ``step``, for each modulus.
        step: small, since these slopes of the forces are differences.
        pose: of the probe.
        displacement: (3, N) m, at which the forces balance.
    """
    tissue.put(pose, displacement)
    forces, wrench = tissue.unbalanced, tissue.wrench
    found, moved = np.empty((6, len(varied))), np.empty((len(varied), *displacement.shape))
    for p, other in enumerate(varied):
        other.put(pose, displacement)
        moved[p] = tissue.solve((forces - other.unbalanced) / step)
        other.put(pose, displacement + step * moved[p])
        found[:, p] = (other.wrench - wrench) / step
    return Slopes(found, moved)
