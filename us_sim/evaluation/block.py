"""The block of tissue that solvers press and slicers cut, its meshes, and SciPy's linear solver.

>>> from us_sim.evaluation.block import MESHES, block, graded_planes
>>> mesh = block(MESHES[0])
>>> len(mesh.nodes), len(mesh.tetrahedra)
(2000, 7695)
>>> graded_planes(0.0, 0.05, 0.0, 0.02, 0.01, 1.2).round(4).tolist()
[0.0, 0.01, 0.02, 0.0336, 0.05]
"""

from __future__ import annotations

import inspect
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import cg

from us_sim.errors import SolverError
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, box_mesh, uniform_planes

EXTENT = ((-0.1, 0.1), (-0.05, 0.05), (0.0, 0.1))  # m, along x, y and z

MESHES = ((20, 10, 10), (24, 12, 12), (28, 14, 14), (32, 16, 16))
"""Nodes along x, y and z of the paper's four meshes (section VI)."""

LARGEST_MESH = (64, 32, 32)  # nodes along x, y and z


@cache
def block(counts: tuple[int, int, int]) -> TetrahedralMesh:
    """The block at rest, with so many nodes along each axis."""
    return box_mesh(
        *(uniform_planes(*side, count) for side, count in zip(EXTENT, counts, strict=True))
    )


def graded_planes(
    low: float, high: float, fine_low: float, fine_high: float, size: float, growth: float
) -> NDArray[np.float64]:
    """Planes (m) from ``low`` to ``high``: ``size`` apart where it is fine, growing outside.

    Each distance outside is about ``growth`` (above 1) times the one before.
    """
    count = max(1, round((fine_high - fine_low) / size))
    parts = [np.linspace(fine_low, fine_high, count + 1)]
    for length, end, direction in (
        (fine_low - low, fine_low, -1),
        (high - fine_high, fine_high, 1),
    ):
        if length > 0:
            number = max(1, round(np.log1p(length / size * (1 - 1 / growth)) / np.log(growth)))
            steps = growth ** np.arange(1, number + 1)
            parts.append(end + direction * length * np.cumsum(steps) / steps.sum())
    planes = np.unique(np.concatenate(parts))
    planes[[0, -1]] = low, high
    return planes


def conjugate_gradients(
    matrix: Any, right: NDArray[np.float64], tolerance: float, inverse: Any, limit: int
) -> NDArray[np.float64]:
    """(N,) x of the symmetric positive definite system ``matrix @ x = right``, by SciPy.

    Args:
        matrix: (N, N), or a ``LinearOperator``, as ``inverse``.
        right: (N,).
        tolerance: of the residual, relative to ``right``.
        inverse: the preconditioner, roughly the inverse of the matrix.
        limit: of iterations.

    Raises:
        SolverError: it did not converge.
    """
    name = "rtol" if "rtol" in inspect.signature(cg).parameters else "tol"  # before SciPy 1.12
    found, failed = cg(matrix, right, maxiter=limit, M=inverse, **{name: tolerance})
    if failed:
        raise SolverError(f"the independent reference did not converge in {limit} steps")
    return np.asarray(found)
