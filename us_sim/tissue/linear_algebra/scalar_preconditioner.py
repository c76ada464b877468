"""A constant matrix, one number per pair of nodes, that approximates a mass-spring tissue's.

As in projective dynamics (T. Liu et al., Fast Simulation of Mass-Spring Systems, ACM Trans. Graph.
32, 2013; T. Liu, S. Bouaziz and L. Kavan, Quasi-Newton Methods for Real-Time Simulation of
Hyperelastic Materials, ACM Trans. Graph. 36, 2017), every spring and every tetrahedron counts as if
it resisted in all three directions alike: one factor, computed once, serves all of them. Nodes that
are confined to planes are corrected for by the compliance of the surface.

>>> import numpy as np
>>> from us_sim.tissue.linear_algebra.scalar_preconditioner import ScalarPreconditioner
>>> ends, one = np.array([[0, 1], [1, 2]]), np.ones(2)
>>> free, first = np.array([False, True, True]), np.array([2])
>>> preconditioner = ScalarPreconditioner(ends, one, np.zeros(3), free, first)
>>> pull = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 1.0]])
>>> preconditioner.solve(pull)[1:].tolist()
[[2.0, 0.0, 1.0], [3.0, 0.0, 2.0]]
>>> preconditioner.confine(np.array([0]), np.array([[1.0, 0.0, 0.0]]))
>>> preconditioner.solve(pull)[2].tolist()
[0.0, 0.0, 2.0]
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csc_array, dia_array
from scipy.sparse.linalg import splu

_BLOCK = 64  # right-hand sides at a time


class ScalarPreconditioner:
    """Sum of weighted graph Laplacian and diagonal, factored, with some rows confined to planes.

    Args:
        edges: (E, 2) nodes.
        weights: (E,) N/m.
        diagonal: (N,) N/m.
        free: (N,), the others do not move.
        surface: (C,) free nodes that can be confined.
        progress: told the fraction done of the solutions for the surface, and what they are.
    """

    def __init__(
        self,
        edges: NDArray[np.integer],
        weights: NDArray[np.float64],
        diagonal: NDArray[np.float64],
        free: NDArray[np.bool_],
        surface: NDArray[np.integer],
        progress: Callable[[float, str], None] | None = None,
    ) -> None:
        count = len(diagonal)
        i, j = edges.T
        entries = np.concatenate([weights, weights, -weights, -weights])
        place = (np.concatenate([i, j, i, j]), np.concatenate([i, j, j, i]))
        own = dia_array((diagonal[None], [0]), shape=(count, count))
        matrix = csc_array((entries, place), shape=(count, count)) + own
        self._free = np.flatnonzero(free)
        self._factor = splu(
            csc_array(matrix)[self._free][:, self._free].tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        self._surface = surface
        # (C, N) m/N, the answer to a push at each surface node; its rounding is corrected at use.
        self._response = np.zeros((len(surface), count), dtype=np.float32)
        number = np.cumsum(free) - 1
        for start in range(0, len(surface), _BLOCK):
            some = number[surface[start : start + _BLOCK]]
            unit = np.zeros((len(self._free), len(some)))
            unit[some, np.arange(len(some))] = 1.0
            end = start + len(some)
            self._response[start:end, self._free] = self._factor.solve(unit).T
            if progress is not None:
                progress(end / len(surface), "responses of the springs' surface")
        self._compliance = self._response[:, surface].astype(np.float64)
        self.confine(np.zeros(0, dtype=np.intp), np.zeros((0, 3)))

    def confine(self, touched: NDArray[np.integer], normal: NDArray[np.float64]) -> None:
        """Let the touched (K,) of the surface nodes move only across normal (K, 3)."""
        self._touched, self._normal = touched, normal
        self._rows = self._surface[touched]
        self._columns = self._response[touched].T  # (N, K)
        if len(touched):
            delassus = self._compliance[np.ix_(touched, touched)] * (normal @ normal.T)
            self._schur = cho_factor(delassus + 1e-6 * np.diag(np.diag(delassus)))

    def solve(self, force: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 3) m, the displacement by force (N, 3) N, confined nodes staying in their planes."""
        displacement = np.zeros_like(force)
        displacement[self._free] = self._factor.solve(force[self._free])
        if len(self._touched):
            normal = self._normal
            along = np.einsum("ij,ij->i", displacement[self._rows], normal)
            self.move(displacement, -along)
            left = np.einsum("ij,ij->i", displacement[self._rows], normal)
            displacement[self._rows] -= left[:, None] * normal
        return displacement

    def move(self, displacement: NDArray[np.float64], distance: NDArray[np.float64]) -> None:
        """Add to displacement (N, 3) m one that moves confined nodes by about distance (K,) m."""
        if len(self._touched):
            push = cho_solve(self._schur, distance)[:, None] * self._normal
            displacement += self._columns @ push.astype(np.float32)
