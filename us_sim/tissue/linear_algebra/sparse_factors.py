"""Preconditioners by a sparse factor: of a mass-spring tissue, and of the neo-Hookean stiffness.

As in projective dynamics (T. Liu et al., Fast Simulation of Mass-Spring Systems, ACM Trans. Graph.
32, 2013; T. Liu, S. Bouaziz and L. Kavan, Quasi-Newton Methods for Real-Time Simulation of
Hyperelastic Materials, ACM Trans. Graph. 36, 2017), every spring and every tetrahedron of a
mass-spring tissue counts as if it resisted in all three directions alike: one factor, computed
once, serves all of them. Nodes that are confined to planes are corrected for by the compliance of
the surface.

Thin layers of very different moduli, nearly incompressible, make conjugate gradients with local and
coarse corrections stall. A factor of the stiffness does not mind, but takes longer to make. The
factored matrix has no negative eigenvalue: of the tangent of `NeoHookean` it leaves out the
geometric part, and gives the elements the nodes' share of the bulk stiffness.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import coo_array, csc_array, dia_array
from scipy.sparse.linalg import splu

from us_sim.kernels import njit
from us_sim.tissue.elasticity.linear_tetrahedra import shape_gradients
from us_sim.tissue.elasticity.neo_hookean_material import (
    barrier_term,
    lumen_energy,
    neo_hookean_constants,
)
from us_sim.tissue.model import TissueModel

_BLOCK = 64  # right-hand sides at a time


class ScalarPreconditioner:
    """Sum of weighted graph Laplacian and diagonal, factored, with some rows confined to planes.

    Args:
        edges: (E, 2) nodes.
        weights: (E,) N/m.
        diagonal: (N,) N/m.
        free: (N,), the others do not move.
        surface: (C,) free nodes that can be confined.
        progress: called with the fraction done of the surface's solutions, and a label.
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


class FactoredStiffness:
    """Solves with a stiffness near the tangent at a displacement, springs included.

    Args:
        model: with enough fixed nodes to hold it.
    """

    def __init__(self, model: TissueModel) -> None:
        mesh = model.mesh
        made = neo_hookean_constants(mesh, model.materials)
        self._tetrahedra = mesh.tetrahedra
        self._gradients = shape_gradients(mesh)  # (M, 4, 3)
        self._shear = mesh.volumes * made.shear
        self._bulk = mesh.volumes * (made.element + made.nodal)
        self._wall = mesh.volumes * made.wall
        self._stiffening = model.materials.stiffening
        self._hollow = np.flatnonzero(made.lumen[:, 0] > 0.0)
        self._lumen = made.lumen_energies(mesh)[self._hollow]
        self.fixed: NDArray[np.integer] = np.flatnonzero(model.fixed)
        number = np.where(model.fixed, -1, np.cumsum(~model.fixed) - 1)
        self._free = np.flatnonzero(~model.fixed)
        self._number = number
        rows = 3 * number[mesh.tetrahedra][:, :, None] + np.arange(3)  # (M, 4, 3)
        rows[number[mesh.tetrahedra] < 0] = -1
        shape = (len(rows), 12, 12)
        row = np.broadcast_to(rows.reshape(-1, 12, 1), shape).ravel()
        column = np.broadcast_to(rows.reshape(-1, 1, 12), shape).ravel()
        self._kept = (row >= 0) & (column >= 0)
        self._row, self._column = row[self._kept], column[self._kept]

    def prepare(
        self,
        displacement: NDArray[np.floating],
        nodes: NDArray[np.integer],
        normals: NDArray[np.floating],
        stiffness: NDArray[np.floating],
    ) -> bool:
        """Factor the stiffness at a displacement (3, N) m, with springs at ``nodes`` (K,) along
        ``normals`` (K, 3) of ``stiffness`` (K,) N/m; returns whether it is regular to rounding.
        """
        matrix = self._assembled(displacement.astype(np.float64))
        unknown = 3 * self._number[nodes][:, None] + np.arange(3)
        blocks = stiffness[:, None, None] * normals[:, :, None] * normals[:, None, :]
        row = np.broadcast_to(unknown[:, :, None], blocks.shape).ravel()
        column = np.broadcast_to(unknown[:, None, :], blocks.shape).ravel()
        springs = coo_array((blocks.ravel(), (row, column)), shape=matrix.shape)
        try:
            self._factor = splu(
                csc_array(matrix + springs),
                permc_spec="MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0,
                options={"SymmetricMode": True},
            )
        except RuntimeError:  # singular
            return False
        return True

    def apply(self, residual: NDArray[np.floating], out: NDArray[np.floating]) -> None:
        """Overwrite ``out`` with the displacement that balances ``residual``, both (3, N)."""
        out[:] = 0.0
        moved = self._factor.solve(residual[:, self._free].T.astype(np.float64).ravel())
        out[:, self._free] = moved.reshape(-1, 3).T

    def _assembled(self, displacement: NDArray[np.float64]) -> csc_array:
        gradients = self._gradients
        corners = displacement.T[self._tetrahedra]  # (M, 4, 3)
        deformed = np.einsum("eai,eaj->eij", corners, gradients) + np.eye(3)
        first, second, third = deformed[:, :, 0], deformed[:, :, 1], deformed[:, :, 2]
        cofactor = np.stack(
            [np.cross(second, third), np.cross(third, first), np.cross(first, second)], axis=2
        )
        ratio = np.einsum("ei,ei->e", first, cofactor[:, :, 0])
        pull = np.einsum("eij,eaj->eai", cofactor, gradients).reshape(-1, 12)
        bulk = self._bulk + _wall_slopes(ratio - 1.0, self._wall)
        bulk[self._hollow] += _lumen_slopes(ratio[self._hollow] - 1.0, self._lumen)
        values = bulk[:, None, None] * pull[:, :, None] * pull[:, None, :]
        shear = self._shear
        if self._stiffening.any():
            # As `stiffening`: e at this place, and its derivative F - cof F.
            beyond = np.maximum(((deformed**2).sum(axis=(1, 2)) - 1.0) / 2 - ratio, 0.0)
            pull = np.einsum("eij,eaj->eai", deformed - cofactor, gradients).reshape(-1, 12)
            rise = 2 * shear * self._stiffening * beyond
            values += rise[:, None, None] * pull[:, :, None] * pull[:, None, :]
            shear = shear * (1.0 + self._stiffening * beyond**2)
        alike = shear[:, None, None] * np.einsum("eai,ebi->eab", gradients, gradients)
        values += np.einsum("eab,ij->eaibj", alike, np.eye(3)).reshape(-1, 12, 12)
        size = 3 * len(self._free)
        entries = (values.ravel()[self._kept], (self._row, self._column))
        return coo_array(entries, shape=(size, size)).tocsc()


@njit(cache=True, nogil=True, error_model="numpy")
def _wall_slopes(change, modulus):
    """(M,) how fast the walls' pressures rise with the volume ratio 1 + change."""
    slopes = np.empty_like(change)
    for e in range(len(change)):
        slopes[e] = modulus[e] * barrier_term(change[e])[2]
    return slopes


@njit(cache=True, nogil=True, error_model="numpy")
def _lumen_slopes(change, table):
    """(L,) how fast the pressures of lumens rise with the volume ratio 1 + change."""
    slopes = np.empty_like(change)
    for e in range(len(change)):
        p, a, b, per, wall, onset = table[e]
        slopes[e] = lumen_energy(change[e], (p, a, b, per, wall, onset))[2]
    return slopes
