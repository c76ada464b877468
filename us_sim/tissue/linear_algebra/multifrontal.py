"""Displacement fields of unit forces, by a multifrontal elimination of the mesh.

(J. W. H. Liu, The multifrontal method for sparse matrix solution, SIAM Review 34, 1992.) The order
of elimination is a nested dissection: halves first, then the nodes that separate them (A. George,
Nested dissection of a regular finite element mesh, SIAM J. Numer. Anal. 10, 1973). Each part, when
eliminated, stores how its unknowns follow those around it; parts with forces on them also store
their own response to these. Fields then come from dense products, down the tree, for many forces
at once.

The pressures of nearly incompressible tissue are unknowns of their own. The matrix is then
quasi-definite, and can be factored in any order without pivoting (R. J. Vanderbei, Symmetric
quasidefinite matrices, SIAM J. Optim. 5, 1995): in every part first the displacements by a Cholesky
factor, then the pressures by one of the negative.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cholesky, solve_triangular
from scipy.sparse import bmat, coo_array, csr_array, dia_array

from us_sim.errors import SolverError
from us_sim.kernels import njit
from us_sim.tissue.elasticity.linear_tetrahedra import AveragedPressure
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh

_LARGEST_WHOLE = 60  # nodes of a part that is not halved


@dataclass(eq=False)
class DissectionPart:
    """Nodes that are eliminated together, after those of the parts below."""

    own: NDArray[np.int64]
    parts: list[DissectionPart] = field(default_factory=list)
    boundary: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))  # above it


def nested_dissection(points: NDArray[np.float64], edges: NDArray[np.integer]) -> DissectionPart:
    """Dissect a mesh into the tree of its parts.

    Args:
        points: (N, 3) m, by whose coordinates nodes are halved.
        edges: (E, 2), which nodes couple.
    """
    count = len(points)
    both = np.concatenate([edges, edges[:, ::-1]])
    graph = coo_array((np.ones(len(both), np.int8), tuple(both.T)), shape=(count, count)).tocsr()
    root = _dissect(points, graph, np.arange(count))
    _bound(root, graph, np.zeros(count, dtype=bool))
    return root


def _dissect(points: NDArray, graph: csr_array, nodes: NDArray) -> DissectionPart:
    if len(nodes) <= _LARGEST_WHOLE:
        return DissectionPart(nodes)
    axis = int(np.argmax(np.ptp(points[nodes], axis=0)))
    along = points[nodes, axis]
    middle = np.partition(along, len(nodes) // 2)[len(nodes) // 2]
    below = along < middle
    if not below.any():
        below = along <= middle
        if below.all():
            return DissectionPart(nodes)
    inside = np.zeros(graph.shape[0], dtype=bool)
    inside[nodes[below]] = True
    above = nodes[~below]
    separates = np.zeros(len(above), dtype=bool)
    start = graph.indptr[above]
    length = graph.indptr[above + 1] - start
    owner = np.repeat(np.arange(len(above)), length)
    offset = np.arange(length.sum()) - np.repeat(np.cumsum(length) - length, length)
    separates[owner[inside[graph.indices[start[owner] + offset]]]] = True
    halves = [nodes[below], above[~separates]]
    parts = [_dissect(points, graph, half) for half in halves if len(half)]
    return DissectionPart(above[separates], parts)


def _bound(part: DissectionPart, graph: csr_array, eliminated: NDArray[np.bool_]) -> None:
    for below in part.parts:
        _bound(below, graph, eliminated)
    near = [below.boundary for below in part.parts]
    near += [graph.indices[graph.indptr[i] : graph.indptr[i + 1]] for i in part.own]
    eliminated[part.own] = True
    boundary = np.unique(np.concatenate(near)) if near else part.own
    part.boundary = boundary[~eliminated[boundary]].astype(np.int64)


# Unknowns, and the Schur complement on them.
_Update = tuple[NDArray[np.int64], NDArray[np.float64]]


@dataclass(frozen=True, eq=False)
class _Front:
    """Responses of the unknowns of one part to those around it."""

    own: NDArray[np.int64]  # (O,), unknowns of the part
    around: NDArray[np.int64]  # (R,), unknowns of parts above that they touch
    response: NDArray[np.floating]  # (O, R), of its own per unknown around it
    inverse: NDArray[np.floating] | None  # (O, O), of its own per force; None where none can be


@dataclass(frozen=True, eq=False)
class EliminatedMesh:
    """A mesh whose parts are eliminated, ready for forces on some of its nodes."""

    _fronts: list[_Front]  # a part comes after those below it
    _nodes: int  # N
    _unknowns: int
    _precision: type

    def compute_fields(self, nodes: NDArray[np.integer]) -> NDArray[np.floating]:
        """Return (N, 3, 3K) m/N, displacements by a unit force along each axis at nodes (K,).

        The nodes are among ``loaded`` of `eliminate`; column 3 k + axis is of node k.
        """
        loads = (3 * nodes[:, None] + np.arange(3)).ravel()
        fields: NDArray[np.floating] = np.zeros((self._unknowns, len(loads)), self._precision)
        fields[loads, np.arange(len(loads))] = 1.0
        return self._solve(fields)

    def compute_displacement(self, load: NDArray[np.float64]) -> NDArray[np.floating]:
        """Return (N, 3) m, the displacement by forces (N, 3) N; see `eliminate` on the nodes."""
        right: NDArray[np.floating] = np.zeros((self._unknowns, 1), self._precision)
        right[: 3 * self._nodes, 0] = load.ravel()
        return self._solve(right)[:, :, 0]

    def _solve(self, fields: NDArray[np.floating]) -> NDArray[np.floating]:
        """Return (N, 3, K) m, displacements by forces (unknowns, K), which are overwritten."""
        loaded = np.asarray(fields.any(axis=1))
        for front in self._fronts:
            if front.inverse is not None and loaded[front.own].any():
                loaded[front.around] = True
                fields[front.around] += front.response.T @ fields[front.own]
        for front in reversed(self._fronts):
            moved = front.response @ fields[front.around]
            if front.inverse is not None and loaded[front.own].any():
                moved += front.inverse @ fields[front.own]
            fields[front.own] = moved
        return fields[: 3 * self._nodes].reshape(self._nodes, 3, -1)


def eliminate(
    mesh: TetrahedralMesh,
    system: AveragedPressure,
    fixed: NDArray[np.bool_],
    loaded: NDArray[np.integer],
    precision: type = np.float64,
    report: Callable[[float], None] | None = None,
) -> EliminatedMesh:
    """Eliminate all nodes.

    Args:
        mesh: of the tissue.
        system: its equations.
        fixed: (N,), nodes that stay; enough to make the stiffness positive definite.
        loaded: (K,) nodes that are not fixed, on which there will be forces.
        precision: of the stored responses.
        report: called with the fraction of the arithmetic done.

    Raises:
        SolverError: to rounding, the stiffness is not positive definite.
    """
    root = nested_dissection(mesh.nodes, mesh.edges)
    elimination = _Elimination(system, fixed, loaded, precision, report)
    try:
        elimination.run(root)
    except LinAlgError as error:
        raise SolverError(
            "the stiffness is not positive definite to rounding: the tetrahedra are too flat or "
            "their moduli too different"
        ) from error
    unknowns = 3 * len(mesh.nodes) + len(system.pressure_nodes)
    return EliminatedMesh(elimination.fronts, len(mesh.nodes), unknowns, precision)


class _Elimination:
    """One elimination: the numbering of the unknowns, and the fronts made so far."""

    def __init__(
        self,
        system: AveragedPressure,
        fixed: NDArray[np.bool_],
        loaded: NDArray[np.integer],
        precision: type,
        report: Callable[[float], None] | None,
    ) -> None:
        count = len(fixed)
        self.fronts: list[_Front] = []
        self._free = ~fixed
        self._precision = precision
        self._report = report
        self._pressed = np.zeros(count, dtype=bool)
        self._pressed[system.pressure_nodes] = True
        self._pressure = np.cumsum(self._pressed) - 1 + 3 * count
        capacity = dia_array((-system.capacity[None], [0]), shape=2 * system.capacity.shape)
        self._matrix = csr_array(
            bmat(
                [[system.element.tocsr(), system.coupling.T], [system.coupling, capacity]],
                format="csr",
            )
        )
        self._position = np.full(self._matrix.shape[0], -1, dtype=np.int64)
        self._loaded = np.zeros(self._matrix.shape[0], dtype=bool)
        self._loaded[(3 * loaded[:, None] + np.arange(3)).ravel()] = True
        self._done = self._total = 0.0

    def run(self, root: DissectionPart) -> None:
        """Eliminate all parts."""
        self._total = self._work(root)
        self._eliminate(root)

    def _unknowns(self, nodes: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the displacements and the pressures of nodes, each ascending."""
        free = nodes[self._free[nodes]]
        moves = (3 * free[:, None] + np.arange(3)).ravel()
        return moves, self._pressure[nodes[self._pressed[nodes]]]

    def _work(self, part: DissectionPart) -> float:
        size = sum(len(unknowns) for unknowns in self._unknowns(part.own))
        around = sum(len(unknowns) for unknowns in self._unknowns(part.boundary))
        return size * float(size + around) ** 2 + sum(self._work(below) for below in part.parts)

    def _eliminate(self, part: DissectionPart) -> _Update:
        """Eliminate a part and those below it; return the Schur complement around it."""
        updates = [self._eliminate(below) for below in part.parts]
        moves, presses = self._unknowns(part.own)
        own = np.concatenate([moves, presses])
        around = np.concatenate(self._unknowns(part.boundary))
        if len(own) == 0 and len(updates) == 1:
            return updates[0]
        stiffness, side, left = self._assembled(own, around, updates)
        factor = _Factor(stiffness, len(moves))
        response, schur = factor.condensed(side, left)
        loaded = self._loaded[own].any()
        if loaded:
            self._loaded[around] = True
        self.fronts.append(
            _Front(
                own,
                around,
                response.astype(self._precision),
                factor.solve(np.eye(len(own))).astype(self._precision) if loaded else None,
            )
        )
        if self._report is not None and self._total:  # there is nothing to do where all is fixed
            self._done += len(own) * float(len(own) + len(around)) ** 2
            self._report(self._done / self._total)
        return around, schur

    def _assembled(
        self, own: NDArray, around: NDArray, updates: list[_Update]
    ) -> tuple[NDArray, NDArray, NDArray]:
        """Assemble the blocks own-own, own-around and around-around; add the updates from below."""
        stiffness = np.zeros((len(own), len(own)))
        side = np.zeros((len(own), len(around)))
        left = np.zeros((len(around), len(around)))
        position, matrix = self._position, self._matrix
        position[own] = np.arange(len(own))
        position[around] = len(own) + np.arange(len(around))
        _assemble(stiffness, side, own, matrix.indptr, matrix.indices, matrix.data, position)
        while updates:
            unknowns, schur = updates.pop()
            _extend_add(stiffness, side, left, schur, position[unknowns])
        position[own] = position[around] = -1
        return stiffness, side, left


class _Factor:
    """The Cholesky factors of a part's own unknowns, displacements first."""

    def __init__(self, stiffness: NDArray[np.float64], moves: int) -> None:
        self._moves = moves
        self._factor = _cholesky(stiffness[:moves, :moves])
        self._side = _forward(self._factor, stiffness[:moves, moves:])
        negative = self._side.T @ self._side
        negative -= stiffness[moves:, moves:]
        self._negative = _cholesky(negative)

    def condensed(
        self, side: NDArray[np.float64], left: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Condense the own unknowns out.

        Args:
            side: coupling of the own unknowns to those around.
            left: block of those around, overwritten.

        Returns:
            The response of the own unknowns to those around, and the Schur complement.
        """
        upper, lower = self._halves(side)
        left -= upper.T @ upper
        left += lower.T @ lower
        response = self._rest(upper, lower)
        np.negative(response, out=response)
        return response, left

    def solve(self, right: NDArray[np.float64]) -> NDArray[np.float64]:
        """Solve for the own unknowns under forces on them; those around are at rest."""
        return self._rest(*self._halves(right))

    def _halves(self, right: NDArray) -> tuple[NDArray, NDArray]:
        upper = _forward(self._factor, right[: self._moves])
        lower = self._side.T @ upper
        lower -= right[self._moves :]
        return upper, _forward(self._negative, lower)

    def _rest(self, upper: NDArray[np.float64], lower: NDArray[np.float64]) -> NDArray[np.float64]:
        pressures = _backward(self._negative, lower)
        upper -= self._side @ pressures
        return np.concatenate([_backward(self._factor, upper), pressures])


def _cholesky(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    if len(matrix) == 0:
        return matrix
    return cholesky(matrix, lower=True, check_finite=False)


def _forward(factor: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    if right.size == 0:
        return right.copy()
    return solve_triangular(factor, right, lower=True, check_finite=False)


def _backward(factor: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    if right.size == 0:
        return right
    return solve_triangular(factor, right, lower=True, trans=1, check_finite=False)


@njit(cache=True, nogil=True, error_model="numpy")
def _assemble(stiffness, side, own, start, columns, values, position):
    """Add the rows ``own`` of a sparse matrix to stiffness and side.

    Columns whose position is after the own ones are added to side.
    """
    for row in range(len(own)):
        for entry in range(start[own[row]], start[own[row] + 1]):
            column = position[columns[entry]]
            if column >= len(own):
                side[row, column - len(own)] += values[entry]
            elif column >= 0:
                stiffness[row, column] += values[entry]


@njit(cache=True, nogil=True, error_model="numpy")
def _extend_add(stiffness, side, left, update, index):
    """Add update (r, r) to the rows and columns ``index``: own ones first, then those around."""
    own = len(stiffness)
    for i in range(len(index)):
        row = index[i]
        for j in range(len(index)):
            column = index[j]
            if row >= own:
                if column >= own:
                    left[row - own, column - own] += update[i, j]
            elif column >= own:
                side[row, column - own] += update[i, j]
            else:
                stiffness[row, column] += update[i, j]
