"""Wrenches and places of a press for given Young's moduli, and their slopes by the moduli.

From pose to pose the tissue of `fem_nonlinear` is brought to balance, without friction and
viscosity. It always begins at rest and goes the whole way, since tissue that is pressed hard may
come to balance in more than one place.

In balance under the probe, r(u, m) = 0, with r the tissue's forces less the contact's at the
displacement u, and m the logarithms of Young's moduli. So by the implicit function theorem

    K du/dm = -dr/dm,    K = dr/du,    dw/dm = w_m + w_u du/dm

for the wrench w(u, m) on the probe, K being the exact tangent with the springs of the contact that
are pressed now (as for images in A. A. Oberai, N. H. Gokhale and G. R. Feijoo, Solution of inverse
problems in elasticity imaging using the adjoint method, Inverse Problems 19, 2003). That takes one
linear solution for each modulus in place of another press.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import SolverError, StiffnessError
from us_sim.geometry.pose import Pose
from us_sim.tissue.contact.probe_gap import FlaredProbe, wrench_on_probe
from us_sim.tissue.contact.surface_points import add_springs, add_turns, surface_contact
from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.elasticity.neo_hookean import NeoHookean
from us_sim.tissue.linear_algebra.two_level import (
    CoarseGrid,
    TwoLevel,
    conjugate_gradients,
    largest_local_eigenvalue,
)
from us_sim.tissue.model import TissueModel
from us_sim.tissue.solvers.fem_nonlinear import FemNonlinear, FemNonlinearSettings
from us_sim.tissue.solvers.tuning import TUNING

_TOLERANCE = 1e-6  # Unbalanced force of a sensitivity, over the force that a modulus changes
# Iterations, and the same fraction with which no answer counts as one.
_MOST_ITERATIONS, _UNSOLVED = 3000, 1e-3
_MOST_CORRECTIONS, _CORRECTED = 30, 0.03  # of a sensitivity; part of the force that each may leave


class Slopes(NamedTuple):
    """Slopes of a press by the logarithms of P moduli."""

    wrench: NDArray[np.float64]  # (6, P) N and N m, frame probe
    displacement: NDArray[np.float64]  # (P, 3, N) m


class PressedTissue:
    """Forces, wrench and tangent of a model at a given displacement.

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

    def set_state(self, pose: Pose, displacement: NDArray[np.float64]) -> None:
        """Set the probe's pose and the nodes' displacement (3, N) m."""
        self._pose, self._displacement = pose, displacement
        at = self._points.rest + self._points.moved(displacement)
        self._contact.set_pose(pose, at)
        self._contact.drop_planes(at)

    @property
    def _contact_forces(self) -> NDArray[np.float64]:
        """(3, N) N, of the probe on the nodes."""
        pushes = np.zeros_like(self._displacement)
        self._points.add(self._contact.force, pushes, self._contact.near)
        return pushes

    @property
    def unbalanced(self) -> NDArray[np.float64]:
        """(3, N) N, forces of the tissue less those of the probe; zero at fixed nodes."""
        forces = self._tissue.forces(self._displacement) - self._contact_forces
        forces[:, self._fixed] = 0.0
        return forces

    @property
    def wrench(self) -> NDArray[np.float64]:
        """(6,) N and N m, of the tissue on the probe about its origin, frame ``probe``."""
        touched = self.model.contact_nodes
        places = self.model.mesh.nodes[touched] + self._displacement.T[touched]
        return np.concatenate(
            wrench_on_probe(self._pose, places, self._contact_forces[:, touched].T)
        )

    def solve(self, force: NDArray[np.float64]) -> NDArray[np.float64]:
        """(3, N) m, the displacement by a small force (3, N) N under the unmoved probe.

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

        def product_of(change: NDArray) -> NDArray:
            image = np.zeros_like(change)
            product(change, image)
            relief = contact.slope * contact.relief_change(points.moved(change))
            points.add(relief[:, None] * contact.normal, image, contact.near)
            image[:, self._fixed] = 0.0
            return image

        preconditioner = self._two_level()
        preconditioner.prepare(
            tissue.diagonal_blocks(), *points.lumped(active, directions, stiffness)
        )
        residual = force.copy()
        residual[:, self._fixed] = 0.0
        size = float(np.linalg.norm(residual))
        if size == 0.0:
            return np.zeros_like(force)
        left, solution = residual / size, np.zeros_like(residual)
        for _ in range(_MOST_CORRECTIONS):
            goal = max(_TOLERANCE, _CORRECTED * float(np.linalg.norm(left)))
            solved = conjugate_gradients(product, preconditioner, left, _MOST_ITERATIONS, goal)
            solution += solved.solution
            # Reliefs of gaps change too. That is not symmetric, and little, so it is put right.
            left = residual / size - product_of(solution)
            if float(np.linalg.norm(left)) <= _TOLERANCE:
                break
        # A state of symmetry may be a ridge, on which forces that keep the symmetry have an answer.
        if float(np.linalg.norm(left)) > _UNSOLVED:
            raise SolverError(
                "the pressed tissue is about to buckle, so that its answer to another modulus "
                "cannot be told"
            )
        return size * solution

    def _two_level(self) -> TwoLevel:
        if self._preconditioner is None:
            model, tissue = self.model, self._tissue
            tissue.linearise(np.zeros((3, tissue.count)))
            grid = CoarseGrid(model.mesh, model.fixed, tissue.tangent_product, np.float64)
            most = largest_local_eigenvalue(
                tissue.diagonal_blocks(), tissue.tangent_product, self._fixed
            )
            self._preconditioner = TwoLevel(grid, self._fixed, TUNING.local_weight / most)
            tissue.linearise(self._displacement)
        return self._preconditioner


def slopes(
    tissue: PressedTissue,
    varied: Sequence[PressedTissue],
    step: float,
    pose: Pose,
    displacement: NDArray[np.float64],
) -> Slopes:
    """Slopes of wrench and displacement of a balanced tissue by each of P moduli.

    Args:
        tissue: whose forces balance.
        varied: the same with the logarithm of one modulus larger by ``step``, for each modulus.
        step: small, since these slopes of the forces are differences.
        displacement: (3, N) m, at which the forces balance.
    """
    tissue.set_state(pose, displacement)
    forces, wrench = tissue.unbalanced, tissue.wrench
    found, moved = np.empty((6, len(varied))), np.empty((len(varied), *displacement.shape))
    for p, other in enumerate(varied):
        other.set_state(pose, displacement)
        moved[p] = tissue.solve((forces - other.unbalanced) / step)
        other.set_state(pose, displacement + step * moved[p])
        found[:, p] = (other.wrench - wrench) / step
    return Slopes(found, moved)


# The constants of all tetrahedra, from Young's moduli (Pa) by structure.
MaterialsFor = Callable[[Mapping[str, float]], TissueMaterials]
_STEP = 1e-5  # Change of a modulus' logarithm by which forces are compared
_FRAMES, _BALANCED = 200, 1e-3  # Frames for a pose at most, and the residual with which it must end
Progress = Callable[[float, str], None]


@dataclass(frozen=True, eq=False)
class PredictedPress:
    """Wrenches at K poses, places of S points, and their slopes by the logarithms of P moduli."""

    wrenches: NDArray[np.float64]  # (K, 6) N and N m, on the probe about its origin, frame probe
    slopes: NDArray[np.float64]  # (K, 6, P)
    places: NDArray[np.float64]  # (S, 3) m, of points seen
    place_slopes: NDArray[np.float64]  # (S, 3, P) m


@dataclass(frozen=True, eq=False)
class CarriedPoints:
    """Points of the tissue that were observed at some of the poses."""

    poses: NDArray[np.intp]  # (S,) number of the pose
    rest: NDArray[np.float64]  # (S, 3) m, where they are in the undeformed tissue
    nodes: NDArray[np.int32]  # (S, 4) that carry them
    weights: NDArray[np.float64]  # (S, 4)

    @classmethod
    def none(cls) -> CarriedPoints:
        """Without a point."""
        return cls(
            np.zeros(0, np.intp), np.zeros((0, 3)), np.zeros((0, 4), np.int32), np.zeros((0, 4))
        )


class PressModel:
    """A tissue and the poses at which a probe presses it.

    Args:
        model: of tissue and probe; its materials do not count.
        materials_for: makes those of given moduli.
        names: of the P structures whose moduli vary.
        poses: K, in the order in which they were gone to.
        seen: points that are observed as well.
    """

    def __init__(
        self,
        model: TissueModel,
        materials_for: MaterialsFor,
        names: Sequence[str],
        poses: Sequence[Pose],
        seen: CarriedPoints | None = None,
    ) -> None:
        self.names = tuple(names)
        self._model, self._materials_for, self._poses = model, materials_for, list(poses)
        self._seen = seen or CarriedPoints.none()
        self._settings = FemNonlinearSettings()

    def predict(
        self, moduli: Mapping[str, float], progress: Progress | None = None
    ) -> PredictedPress:
        """The press with these moduli (Pa), of all structures.

        Raises:
            SolverError: the tissue cannot be solved.
            StiffnessError: it does not come to balance at a pose.
        """
        varied = [{**moduli, name: moduli[name] * float(np.exp(_STEP))} for name in self.names]
        solver = self.solver(moduli)
        tissue = PressedTissue(solver.model)
        others = [PressedTissue(self._with(each)) for each in varied]
        wrenches = np.empty((len(self._poses), 6))
        changes = np.empty((len(self._poses), 6, len(self.names)))
        places = self._seen.rest.copy()
        place_slopes = np.zeros((*self._seen.rest.shape, len(self.names)))
        for k, pose in enumerate(self._poses):
            if progress is not None:
                progress(k / len(self._poses), "pressing")
            moved = self.balanced(solver, pose, k)
            field = np.ascontiguousarray(moved.T)
            found = slopes(tissue, others, _STEP, pose, field)
            tissue.set_state(pose, field)
            wrenches[k], changes[k] = tissue.wrench, found.wrench
            for s in np.flatnonzero(self._seen.poses == k):
                nodes, weights = self._seen.nodes[s], self._seen.weights[s]
                places[s] += weights @ moved[nodes]
                place_slopes[s] = (found.displacement[:, :, nodes] @ weights).T
        return PredictedPress(wrenches, changes, places, place_slopes)

    def solver(self, moduli: Mapping[str, float]) -> FemNonlinear:
        """The tissue of these moduli (Pa), at rest."""
        return FemNonlinear(self._with(moduli), self._settings)

    def _with(self, moduli: Mapping[str, float]) -> TissueModel:
        return replace(self._model, materials=self._materials_for(moduli))

    def balanced(self, solver: FemNonlinear, pose: Pose, k: int = 0) -> NDArray[np.float64]:
        """(N, 3) m, displacement at a pose, the k-th, to which the solver goes from where it is.

        Raises:
            StiffnessError: the tissue does not come to balance.
        """
        for _ in range(_FRAMES):
            deformation = solver.deform(pose)
            if solver.is_settled:
                break
        if not deformation.residual <= _BALANCED:
            raise StiffnessError(
                f"the tissue does not come to balance at pose {k + 1} of {len(self._poses)} "
                f"({deformation.action or f'residual {deformation.residual:.2g}'}): is the press "
                f"deeper than tissue yields, or the mesh too coarse for it?"
            )
        return deformation.nodes - self._model.mesh.nodes
