"""Large symmetric systems of quadratic elements by conjugate gradients over two levels.

The coarse level is the same mesh with linear elements, solved directly by SciPy; the fine one is
smoothed by Chebyshev polynomials of the block-Jacobi iteration (M. Adams, M. Brezina, J. Hu and
R. Tuminaro, Parallel multigrid smoothing, J. Comput. Phys. 188, 2003).

>>> import numpy as np
>>> from scipy.sparse import bsr_array, csr_array
>>> from us_sim.evaluation.tissue.two_level import TwoLevel
>>> matrix = bsr_array(np.diag(np.arange(1.0, 7.0)), blocksize=(3, 3))
>>> solve = TwoLevel(matrix, csr_array(np.eye(6, 3)))
>>> solve(np.ones(6), 1e-12).round(3).tolist()
[1.0, 0.5, 0.333, 0.25, 0.2, 0.167]
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, csr_array
from scipy.sparse.linalg import splu

_DEGREE = 3  # of the smoothing polynomial
_SMOOTHED = 20.0  # the smoother acts on eigenvalues down to the largest over this
_MAXIMUM_ITERATIONS = 400


class TwoLevel:
    """A factorised system, called with a right-hand side.

    Args:
        matrix: (3N, 3N) symmetric and positive definite, in 3x3 blocks.
        prolongation: (3N, 3C) from the coarse level.
    """

    def __init__(self, matrix: bsr_array, prolongation: csr_array) -> None:
        self._matrix = matrix
        rows = np.repeat(np.arange(len(matrix.indptr) - 1), np.diff(matrix.indptr))
        self._inverse = np.linalg.inv(matrix.data[rows == matrix.indices])
        self._up, self._down = prolongation, prolongation.T.tocsr()
        coarse = (self._down @ (matrix.tocsr() @ prolongation)).tocsc()
        self._coarse = splu(
            coarse,
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        self._largest = 1.1 * self._largest_eigenvalue()

    def __call__(self, right: NDArray[np.float64], tolerance: float) -> NDArray[np.float64]:
        """(3N,) solution with a residual below ``tolerance`` times the right-hand side's norm.

        Where the matrix turns out not to be positive definite, which ``is_definite`` says then, the
        search ends at what was found before, which still descends.
        """
        self.is_definite = True
        solution = np.zeros_like(right)
        residual = right.copy()
        direction = preconditioned = self._cycle(residual)
        slope = residual @ preconditioned
        goal = tolerance * np.linalg.norm(right)
        for iteration in range(_MAXIMUM_ITERATIONS):
            product = self._matrix @ direction
            curvature = direction @ product
            if curvature <= 0.0:
                self.is_definite = False
                return solution if iteration else direction
            step = slope / curvature
            solution += step * direction
            residual -= step * product
            if np.linalg.norm(residual) <= goal:
                break
            preconditioned = self._cycle(residual)
            before, slope = slope, residual @ preconditioned
            direction = preconditioned + (slope / before) * direction
        return solution

    def _cycle(self, residual: NDArray[np.float64]) -> NDArray[np.float64]:
        """Smooth, correct on the coarse level, smooth."""
        solution = self._smoothed(np.zeros_like(residual), residual)
        left = residual - self._matrix @ solution
        solution += self._up @ self._coarse.solve(self._down @ left)
        return self._smoothed(solution, residual)

    def _smoothed(
        self, solution: NDArray[np.float64], right: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        high, low = self._largest, self._largest / _SMOOTHED
        centre, radius = 0.5 * (high + low), 0.5 * (high - low)
        step = self._over_diagonal(right - self._matrix @ solution) / centre
        ratio = radius / centre
        solution = solution + step
        for _ in range(_DEGREE - 1):
            after = 1.0 / (2.0 * centre / radius - ratio)
            correction = self._over_diagonal(right - self._matrix @ solution)
            step = after * ratio * step + 2.0 * after / radius * correction
            ratio = after
            solution = solution + step
        return solution

    def _over_diagonal(self, vector: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.einsum("nij,nj->ni", self._inverse, vector.reshape(-1, 3)).ravel()

    def _largest_eigenvalue(self) -> float:
        """Of the block-Jacobi iteration's matrix, by power iteration."""
        vector = np.random.default_rng(0).normal(size=self._matrix.shape[0])
        value = 1.0
        for _ in range(15):
            vector = self._over_diagonal(self._matrix @ (vector / np.linalg.norm(vector)))
            value = float(np.linalg.norm(vector))
        return value
