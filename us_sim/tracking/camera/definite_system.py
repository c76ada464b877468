"""Small systems of equations with a positive definite matrix, solved inside compiled loops.

>>> import numpy as np
>>> from us_sim.tracking.camera.definite_system import solve_definite
>>> right = np.array([6.0, 7.0])
>>> solve_definite(np.array([[4.0, 2.0], [2.0, 3.0]]), right), right
(True, array([0.5, 2. ]))
"""

from __future__ import annotations

import math

from us_sim.kernels import njit


@njit(cache=True, nogil=True, error_model="numpy")
def solve_definite(matrix, right):
    """Replace ``right`` (n,) by the solution, with Cholesky's factor of the matrix's (n, n) lower
    triangle, which is overwritten; False, with ``right`` spoilt, where it is not definite.
    """
    size = len(right)
    for i in range(size):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                matrix[i, i] = math.sqrt(total)
            else:
                matrix[i, j] = total / matrix[j, j]
    for i in range(size):
        for j in range(i):
            right[i] -= matrix[i, j] * right[j]
        right[i] /= matrix[i, i]
    for i in range(size - 1, -1, -1):
        for j in range(i + 1, size):
            right[i] -= matrix[j, i] * right[j]
        right[i] /= matrix[i, i]
    return True
