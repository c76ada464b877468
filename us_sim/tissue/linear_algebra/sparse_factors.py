"""A preconditioner by a sparse factor of the neo-Hookean stiffness.

Thin layers of very different moduli, nearly incompressible, make conjugate gradients with local and
coarse corrections stall. A factor of the stiffness does not mind, but takes longer to make. The
factored matrix has no negative eigenvalue: of the tangent of `NeoHookean` it leaves out the
geometric part, and gives the elements the nodes' share of the bulk stiffness.
"""

from __future__ import annotations

import copy

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array
from scipy.sparse.linalg import splu

from us_sim.kernels import njit
from us_sim.tissue.elasticity.linear_tetrahedra import shape_gradients
from us_sim.tissue.elasticity.neo_hookean_material import (
    barrier_term,
    lumen_energy,
    neo_hookean_constants,
)
from us_sim.tissue.model import TissueModel


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

    def __deepcopy__(self, _: object) -> FactoredStiffness:
        """Share all arrays and the factor, which are replaced and never changed."""
        return copy.copy(self)

    def factor_at(
        self,
        displacement: NDArray[np.floating],
        nodes: NDArray[np.integer],
        normals: NDArray[np.floating],
        stiffness: NDArray[np.floating],
    ) -> bool:
        """Factor the stiffness at a displacement, with springs.

        Args:
            displacement: (3, N) m.
            nodes: (K,), of the springs.
            normals: (K, 3), their directions.
            stiffness: (K,) N/m.

        Returns:
            Whether the matrix is regular to rounding.
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
        alike = self._shear[:, None, None] * np.einsum("eai,ebi->eab", gradients, gradients)
        values += np.einsum("eab,ij->eaibj", alike, np.eye(3)).reshape(-1, 12, 12)
        size = 3 * len(self._free)
        entries = (values.ravel()[self._kept], (self._row, self._column))
        return coo_array(entries, shape=(size, size)).tocsc()


@njit(cache=True, nogil=True, error_model="numpy")
def _wall_slopes(change, modulus):
    """Return (M,), how fast the walls' pressures rise with the volume ratio 1 + change."""
    slopes = np.empty_like(change)
    for e in range(len(change)):
        slopes[e] = modulus[e] * barrier_term(change[e])[2]
    return slopes


@njit(cache=True, nogil=True, error_model="numpy")
def _lumen_slopes(change, table):
    """Return (L,), how fast the pressures of lumens rise with the volume ratio 1 + change."""
    slopes = np.empty_like(change)
    for e in range(len(change)):
        p, a, b, per, wall, onset = table[e]
        slopes[e] = lumen_energy(change[e], (p, a, b, per, wall, onset))[2]
    return slopes
