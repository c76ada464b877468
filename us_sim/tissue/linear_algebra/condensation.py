"""Static condensation: the compliance of a few nodes, and how all others follow them.

A multifrontal elimination (J. W. H. Liu, The multifrontal method for sparse matrix solution, SIAM
Review 34, 1992) in which the kept nodes come last, with a dense stiffness. Each part of the mesh,
when eliminated, stores how it follows the nodes around it, so that the displacement of all nodes
comes from that of the kept ones by dense products, for all loads at once.

The pressures of nearly incompressible tissue are unknowns of their own. The matrix is then
quasi-definite, and can be factored in any order without pivoting (R. J. Vanderbei, Symmetric
quasidefinite matrices, SIAM J. Optim. 5, 1995): in every part first the displacements by a Cholesky
factor, then the pressures by one of the negative.

>>> import numpy as np
>>> from us_sim.tissue.elasticity.averaged_pressure import averaged_pressure
>>> from us_sim.tissue.linear_algebra.condensation import condense
>>> from us_sim.tissue.elasticity.material import Material
>>> from us_sim.tissue.elasticity.materials import uniform_material
>>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
>>> mesh = box_mesh(*(uniform_planes(0.0, 0.1, 4) for axis in range(3)))
>>> system = averaged_pressure(mesh, uniform_material(mesh, Material(10e3, 0.49, 1000.0)))
>>> top, fixed = np.flatnonzero(mesh.nodes[:, 2] == 0.0), mesh.nodes[:, 2] == 0.1
>>> condensed = condense(mesh, system, fixed, top)
>>> condensed.compliance.shape
(48, 48)
>>> sum(len(nodes) for nodes, _ in condensed.fields()), int((~fixed).sum())
(48, 48)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cholesky, solve_triangular
from scipy.linalg.lapack import dpotri
from scipy.sparse import block_array, csr_array, dia_array

from us_sim.errors import SolverError
from us_sim.tissue.elasticity.averaged_pressure import AveragedPressure
from us_sim.tissue.linear_algebra.nested_dissection import Part, nested_dissection
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh

__all__ = ["Condensed", "Field", "condense"]

Field = tuple[NDArray[np.int64], NDArray[np.floating]]
"""Free nodes (F,), and their displacements (3F, 3K) m/N."""

_Update = tuple[NDArray[np.int64], NDArray[np.float64]]  # unknowns, and what is added to them


@dataclass(eq=False)
class _Follower:
    """How the unknowns of one part follow those around it."""

    nodes: NDArray[np.int64]  # its free nodes, ascending
    response: NDArray[np.floating]  # (3 nodes + pressures, R), per unknown around it
    around: NDArray[np.int64]  # (R,), those unknowns, in the order of the parent's own and its own
    below: list[_Follower] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class Condensed:
    """The compliance of K kept nodes, and the parts of the mesh that follow them."""

    kept: NDArray[np.int32]  # (K,)
    compliance: NDArray[np.float64]  # (3K, 3K), m/N, displacement 3 k + axis of force 3 l + axis
    _order: NDArray[np.int64]  # (3K,), of ascending kept unknowns in the compliance
    _pressures: NDArray[np.float64]  # pressures of kept nodes per their ascending displacements
    _below: list[_Follower]

    def fields(self) -> Iterator[Field]:
        """For every part of the mesh its (F,) free nodes and their (3F, 3K) m/N displacements.

        Row 3 f + axis, column 3 k + axis of the force. The parts' numbers are in the precision
        that `condense` was told; kept nodes are a part too.
        """
        ascending = self.compliance[self._order]
        yield np.sort(self.kept).astype(np.int64), ascending
        if self._below:
            precision = self._below[0].response.dtype
            everything = np.concatenate([ascending, self._pressures @ ascending])
            yield from _follow(self._below, everything.astype(precision))


def condense(
    mesh: TetrahedralMesh,
    system: AveragedPressure,
    fixed: NDArray[np.bool_],
    kept: NDArray[np.int32],
    precision: type = np.float64,
    report: Callable[[float], None] | None = None,
) -> Condensed:
    """Eliminate all but the kept nodes.

    Args:
        mesh: of the system.
        system: its equations.
        fixed: (N,), nodes that stay; enough to make the stiffness positive definite.
        kept: (K,) nodes that are not fixed.
        precision: of the numbers that say how parts follow.
        report: told the fraction of the arithmetic done.

    Raises:
        SolverError: to rounding, the stiffness is not positive definite.
    """
    is_kept = np.zeros(len(mesh.nodes), dtype=bool)
    is_kept[kept] = True
    root = nested_dissection(mesh.nodes, mesh.edges, is_kept)
    elimination = _Elimination(mesh, system, fixed, precision, report)
    try:
        below, schur, pressures = elimination.root(root)
        compliance = _inverse(schur)
    except LinAlgError as error:
        raise SolverError(
            "the stiffness is not positive definite to rounding: the tetrahedra are too flat or "
            "their moduli too different"
        ) from error
    ranks = np.argsort(np.argsort(kept))
    place = (3 * ranks[:, None] + np.arange(3)).ravel()
    order = (3 * np.argsort(kept)[:, None] + np.arange(3)).ravel()
    return Condensed(
        kept, np.ascontiguousarray(compliance[np.ix_(place, place)]), order, pressures, below
    )


def _inverse(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    if len(matrix) == 0:
        return matrix
    factor = cholesky(matrix, lower=True, check_finite=False)
    inverse, _ = dpotri(factor, lower=True)
    inverse = np.tril(inverse)
    return inverse + np.tril(inverse, -1).T


def _follow(parts: list[_Follower], above: NDArray[np.floating]) -> Iterator[Field]:
    """The fields of parts and those below, from the (R, 3K) fields around them."""
    for part in parts:
        around = above[part.around]
        own = part.response @ around
        if len(part.nodes):
            yield part.nodes, own[: 3 * len(part.nodes)]
        if part.below:
            yield from _follow(part.below, np.concatenate([own, around]))


class _Elimination:
    """One elimination: the numbering of the unknowns, and the fronts."""

    def __init__(
        self,
        mesh: TetrahedralMesh,
        system: AveragedPressure,
        fixed: NDArray[np.bool_],
        precision: type,
        report: Callable[[float], None] | None,
    ) -> None:
        count = len(mesh.nodes)
        self._free = ~fixed
        self._precision = precision
        self._report = report
        self._pressed = np.zeros(count, dtype=bool)
        self._pressed[system.pressure_nodes] = True
        self._pressure = np.cumsum(self._pressed) - 1 + 3 * count
        capacity = dia_array((-system.capacity[None], [0]), shape=2 * system.capacity.shape)
        self._matrix = csr_array(
            block_array(
                [[system.element.tocsr(), system.coupling.T], [system.coupling, capacity]],
                format="csr",
            )
        )
        self._position = np.full(self._matrix.shape[0], -1, dtype=np.int64)
        self._done = self._total = 0.0

    def root(self, root: Part) -> tuple[list[_Follower], NDArray[np.float64], NDArray[np.float64]]:
        """The parts below the root, its stiffness, and its pressures per displacement."""
        self._total = self._work(root)
        below, updates = self._below(root)
        moves, presses = self._unknowns(root.own)
        unknowns = np.concatenate([moves, presses])
        front = self._front(moves, presses, unknowns, updates)
        count = len(moves)
        schur = front[:count, :count]
        pressures = np.zeros((len(presses), count))
        if len(presses):
            factor = cholesky(-front[count:, count:], lower=True, check_finite=False)
            half = solve_triangular(factor, front[count:, :count], lower=True, check_finite=False)
            schur = schur + half.T @ half
            pressures = solve_triangular(factor, half, lower=True, trans=1, check_finite=False)
        for follower, (around, _) in zip(below, updates, strict=True):
            follower.around = np.searchsorted(unknowns, around)
        return below, schur, pressures

    def _unknowns(self, nodes: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Displacements and pressures of nodes, each ascending."""
        free = nodes[self._free[nodes]]
        moves = (3 * free[:, None] + np.arange(3)).ravel()
        return moves, self._pressure[nodes[self._pressed[nodes]]]

    def _work(self, part: Part) -> float:
        size = sum(len(unknowns) for unknowns in self._unknowns(part.own))
        around = sum(len(unknowns) for unknowns in self._unknowns(part.boundary))
        return size * float(size + around) ** 2 + sum(self._work(below) for below in part.parts)

    def _below(self, part: Part) -> tuple[list[_Follower], list[_Update]]:
        made = [self._eliminate(below) for below in part.parts]
        return [follower for follower, _ in made], [update for _, update in made]

    def _eliminate(self, part: Part) -> tuple[_Follower, _Update]:
        below, updates = self._below(part)
        moves, presses = self._unknowns(part.own)
        around = np.concatenate(self._unknowns(part.boundary))
        unknowns = np.concatenate([moves, presses, around])
        front = self._front(moves, presses, unknowns, updates)
        for follower, (theirs, _) in zip(below, updates, strict=True):
            self._position[unknowns] = np.arange(len(unknowns))
            follower.around = self._position[theirs]
            self._position[unknowns] = -1
        updates.clear()
        response, schur = _condense_front(front, len(moves), len(presses))
        if self._report is not None:
            self._done += (len(moves) + len(presses)) * float(len(unknowns)) ** 2
            self._report(self._done / self._total)
        follower = _Follower(
            moves[::3] // 3, response.astype(self._precision), np.empty(0, np.int64), below
        )
        return follower, (around, schur)

    def _front(
        self,
        moves: NDArray[np.int64],
        presses: NDArray[np.int64],
        unknowns: NDArray[np.int64],
        updates: list[_Update],
    ) -> NDArray[np.float64]:
        """The matrix of a part's own unknowns and those around, with the updates from below."""
        front = np.zeros((len(unknowns), len(unknowns)))
        position = self._position
        position[unknowns] = np.arange(len(unknowns))
        own = np.concatenate([moves, presses])
        matrix = self._matrix
        _assemble(front, own, matrix.indptr, matrix.indices, matrix.data, position)
        for around, schur in updates:
            _extend_add(front, schur, position[around])
        position[unknowns] = -1
        return front


def _condense_front(
    front: NDArray[np.float64], moves: int, presses: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How the first unknowns follow the others, and the Schur complement of the others."""
    own = moves + presses
    left = front[moves:, moves:]
    half = np.empty((0, len(front) - moves))
    if moves:
        factor = cholesky(front[:moves, :moves], lower=True, check_finite=False)
        half = solve_triangular(factor, front[:moves, moves:], lower=True, check_finite=False)
        left = left - half.T @ half
    schur = left[presses:, presses:]
    response = np.empty((own, len(schur)))
    if presses:
        negative = cholesky(-left[:presses, :presses], lower=True, check_finite=False)
        quarter = solve_triangular(
            negative, left[:presses, presses:], lower=True, check_finite=False
        )
        schur = schur + quarter.T @ quarter
        response[moves:] = solve_triangular(
            negative, quarter, lower=True, trans=1, check_finite=False
        )
    if moves:
        load = half[:, presses:] + half[:, :presses] @ response[moves:]
        response[:moves] = -solve_triangular(factor, load, lower=True, trans=1, check_finite=False)
    return response, schur


@njit(cache=True, nogil=True, error_model="numpy")
def _assemble(front, own, start, columns, values, position):
    """Adds the rows ``own`` of a sparse matrix to front, where their columns have a position."""
    for row in range(len(own)):
        for entry in range(start[own[row]], start[own[row] + 1]):
            column = position[columns[entry]]
            if column >= 0:
                front[row, column] += values[entry]
                if column >= len(own):
                    front[column, row] += values[entry]


@njit(cache=True, nogil=True, error_model="numpy")
def _extend_add(front, update, index):
    """Adds update (r, r) to the rows and columns ``index`` of front."""
    for i in range(len(index)):
        row = front[index[i]]
        for j in range(len(index)):
            row[index[j]] += update[i, j]
