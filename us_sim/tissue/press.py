"""Presses to a force: the depth at which a probe pushes so hard, and what the tissue does there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from us_sim import Progress
from us_sim.errors import SolverError
from us_sim.geometry.pose import Pose
from us_sim.tissue.elasticity.linear_tetrahedra import shape_gradients
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.tissue.model import Deformation
from us_sim.tissue.solvers.solver import TissueSolver

_FRAMES = 300  # at one pose at most
_BALANCED = 1e-3  # residual with which a pose must end


@dataclass(frozen=True, eq=False)
class Press:
    """The tissue at rest under a probe."""

    depth: float  # m, along the probe's axis from where it began
    force: float  # N, with which the probe is pushed along that axis
    pose: Pose  # of the probe, frame patient
    deformation: Deformation


def press_to_force(
    solver: TissueSolver,
    force: float,
    start: Pose | None = None,
    *,
    step: float = 1e-3,
    deepest: float = 0.1,
    tolerance: float = 1e-3,
    progress: Progress | None = None,
) -> list[Press]:
    """Press a probe along its axis until the tissue pushes back with a force.

    Args:
        solver: quasi-static, of the tissue.
        force: N.
        start: of the probe, frame ``patient``; by default its origin, upright.
        step: m, between the poses on the way.
        deepest: m, from the start, to which it is pressed at most.
        tolerance: of the force, relative.
        progress: takes the part of the force that is reached, and the force in words.

    Returns:
        The presses on the way, the last one of the force.

    Raises:
        SolverError: the tissue finds no balance, or pushes with less than the force at the deepest.

    Examples:
        >>> from us_sim.tissue.model import TissueModel
        >>> from us_sim.tissue.solvers.solver import create_solver
        >>> curve = press_to_force(create_solver("fem", TissueModel.make_block()), 2.0)
        >>> f"{curve[-1].force:.2f} N at {1e3 * curve[-1].depth:.1f} mm"
        '2.00 N at 7.6 mm'
    """
    start = start or Pose()

    def press(depth: float) -> Press:
        pose = start @ Pose(np.array([0.0, 0.0, depth]))
        for _ in range(_FRAMES):
            found = solver.deform(pose)
            if solver.is_settled:
                break
        if not found.residual <= _BALANCED:
            raise SolverError(
                f"{solver.name} finds no balance {1e3 * depth:.1f} mm deep, of residual "
                f"{found.residual:.1g}; it reaches {-found.force[2]:.3g} N: press less, or use fem"
            )
        made = Press(depth, 0.0 - float(found.force[2]), pose, found)  # no minus nothing
        if progress is not None:
            done = min(max(made.force / force, 0.0), 0.99)
            progress(done, f"{made.force:.3g} N, {1e3 * depth:.2f} mm deep")
        return made

    curve = [press(0.0)]
    while curve[-1].force < force:
        depth = curve[-1].depth + step
        if depth > deepest:
            raise SolverError(
                f"the tissue pushes with {curve[-1].force:.3g} N {1e3 * deepest:.0f} mm deep, less "
                f"than {force:g} N: is the probe above it?"
            )
        curve.append(press(depth))
    if abs(curve[-1].force - force) <= tolerance * force or len(curve) == 1:
        return curve
    beyond = curve.pop()
    tried: list[Press] = []

    def excess(depth: float) -> float:
        """Press to a depth; return the force (N) beyond the wanted one, 0 within the tolerance."""
        tried.append(press(depth))
        over = tried[-1].force - force
        return 0.0 if abs(over) <= tolerance * force else over

    brentq(excess, curve[-1].depth, beyond.depth, xtol=1e-9)
    found = min(tried, key=lambda one: abs(one.force - force))
    return [*(one for one in curve if one.depth < found.depth), found]


def strains_along(
    mesh: TetrahedralMesh, nodes: NDArray[np.float64], direction: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return (M,), the elongation of lines along a direction (3,) at rest; negative if pressed.

    Args:
        mesh: at rest.
        nodes: (N, 3) m, deformed.
        direction: of length 1, frame ``patient``.
    """
    slope = np.einsum("eai,eaj->eij", nodes[mesh.tetrahedra], shape_gradients(mesh))
    longer: NDArray[np.float64] = np.linalg.norm(slope @ direction, axis=1) - 1.0
    return longer
