"""SciPy's conjugate gradients for the references, whatever SciPy calls their tolerance.

>>> import numpy as np
>>> from us_sim.evaluation.solved import solved
>>> solved(np.diag([2.0, 4.0]), np.array([2.0, 2.0]), 1e-12, np.eye(2), 10)
array([1. , 0.5])
"""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import cg

from us_sim.errors import SolverError

_TOLERANCE = "rtol" if "rtol" in inspect.signature(cg).parameters else "tol"  # before SciPy 1.12


def solved(
    matrix: Any, right: NDArray[np.float64], tolerance: float, inverse: Any, limit: int
) -> NDArray[np.float64]:
    """(N,) x of the symmetric positive definite system ``matrix @ x = right``.

    Args:
        matrix: (N, N), or a ``LinearOperator``, as ``inverse``.
        right: (N,).
        tolerance: of the residual, relative to ``right``.
        inverse: roughly that of the matrix, the preconditioner.
        limit: of iterations.

    Raises:
        SolverError: it did not converge.
    """
    found, failed = cg(matrix, right, maxiter=limit, M=inverse, **{_TOLERANCE: tolerance})
    if failed:
        raise SolverError(f"the independent reference did not converge in {limit} steps")
    return np.asarray(found)
