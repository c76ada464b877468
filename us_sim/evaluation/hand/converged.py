"""What every method is compared with: large deformation, converged at each pose of a motion.

A ``fem_nonlinear`` with all the patience that its settings allow follows the poses in order, and is
called again at each until it has converged, or goes no further.

>>> from us_sim.evaluation.hand.converged import Converged
>>> Converged.of_no_frame(3).trusted.tolist()
[False, False, False]
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.evaluation.tissue_methods import TISSUE_METHODS
from us_sim.geometry.pose import Pose
from us_sim.tissue.mesh.tetrahedral_mesh import signed_volumes
from us_sim.tissue.model import Deformation, TissueModel
from us_sim.tissue.solvers.solver import TissueSolver, create_solver

METHOD = "fem_nonlinear"
CONVERGED = 1e-5
"""Residual at which a pose is left for the next."""
TRUSTED = 1e-3
"""Residual above which nothing is compared with what was reached."""
HELD = 1e-6
"""m that a fixed node may move before nothing is compared with it either."""

_MOST_CALLS = 20  # at one pose
_PATIENCE, _PROGRESS = 4, 0.7  # calls, in which the least residual must fall by that factor


@dataclass(frozen=True, eq=False)
class Converged:
    """The answer at each of K poses."""

    nodes: NDArray[np.float64]  # (K, N, 3) m
    residual: NDArray[np.float64]  # (K,) as the solver said in the end
    pressed: NDArray[np.bool_]  # (K,) whether the probe touches the tissue
    smallest: NDArray[np.float64]  # (K,) volume ratio of the tetrahedron most crushed
    slipped: NDArray[np.float64]  # (K,) m, of the fixed node that moved most

    @classmethod
    def of_no_frame(cls, count: int) -> Converged:
        """In place of what failed: there is nothing to compare with."""
        never = np.zeros(count, dtype=np.bool_)
        unknown = np.full(count, np.nan)
        return cls(np.empty((count, 0, 3)), np.full(count, np.inf), never, unknown, unknown)

    @property
    def trusted(self) -> NDArray[np.bool_]:
        """(K,) whether something may be compared with it."""
        return (self.residual <= TRUSTED) & (self.slipped <= HELD)

    @property
    def last_pressed(self) -> int:
        """The last frame in which the probe touches; the last of all where it never does."""
        touching = np.flatnonzero(self.pressed)
        return int(touching[-1]) if len(touching) else len(self.pressed) - 1


def converged(
    model: TissueModel, poses: Sequence[Pose], progress: Callable[[int], None] | None = None
) -> Converged:
    """Follow the poses, each to convergence.

    Args:
        model: of the tissue.
        poses: of the probe, in order.
        progress: told how many of the poses are done.

    Raises:
        UsSimError: the method does not take the tissue.
    """
    solver = patient_solver(model)
    nodes = np.empty((len(poses), *model.mesh.nodes.shape))
    residual, pressed = np.empty(len(poses)), np.zeros(len(poses), dtype=np.bool_)
    smallest, slipped = np.empty(len(poses)), np.empty(len(poses))
    for k, pose in enumerate(poses):
        found = settled(solver, pose)
        nodes[k], residual[k] = found.nodes, found.residual
        pressed[k] = len(found.contact_nodes) > 0
        volumes = signed_volumes(found.nodes, model.mesh.tetrahedra)
        smallest[k] = (volumes / model.mesh.volumes).min()
        slipped[k] = moved_fixed(model, found)
        if progress is not None:
            progress(k + 1)
    return Converged(nodes, residual, pressed, smallest, slipped)


def moved_fixed(model: TissueModel, found: Deformation) -> float:
    """m, of the fixed node that moved most: none should."""
    return float(np.abs(found.nodes - model.mesh.nodes)[model.fixed].max(initial=0.0))


def patient_solver(model: TissueModel) -> TissueSolver:
    """The method with the settings with which it converges.

    Raises:
        UsSimError: it does not take the tissue.
    """
    return create_solver(METHOD, model, **(TISSUE_METHODS[METHOD].patient or {}))


def settled(solver: TissueSolver, pose: Pose) -> Deformation:
    """The last of many frames at one pose, or the best: until it settles, or goes no further.

    Of frames in balance the last is the best: in the earlier ones the probe is still sunk in.
    """
    found = solver.deform(pose)
    best = [found]
    for _ in range(_MOST_CALLS - 1):
        stalled = len(best) > _PATIENCE and (
            best[-1].residual > max(CONVERGED, _PROGRESS * best[-1 - _PATIENCE].residual)
        )
        if solver.is_settled or stalled:
            break
        found = solver.deform(pose)
        balanced = found.residual <= CONVERGED
        best.append(found if balanced else min(best[-1], found, key=lambda each: each.residual))
    return best[-1]
