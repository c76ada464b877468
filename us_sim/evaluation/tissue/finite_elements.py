"""Finite elements of scikit-fem as a second opinion on `us_sim.tissue`, with no kernel in common.

>>> planes = [0.0, 0.05, 0.1]
>>> block = NeoHookeanHexahedra((planes, planes, planes), Material(10e3, 0.45, 1000.0))
>>> turned = block.nodes @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).T - block.nodes
>>> block.nodes.shape, bool(abs(block.forces(turned)).max() < 1e-12)
((125, 3), True)
>>> matrix = bsr_array(np.diag(np.arange(1.0, 7.0)), blocksize=(3, 3))
>>> TwoLevel(matrix, csr_array(np.eye(6, 3)))(np.ones(6), 1e-12).round(3).tolist()
[1.0, 0.5, 0.333, 0.25, 0.2, 0.167]
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import bsr_array, csr_array
from scipy.sparse.linalg import splu

from us_sim.errors import UsSimError
from us_sim.tissue.elasticity.material import Material

try:
    from skfem import Basis, ElementHex1, ElementHex2, FacetBasis, MeshHex
except ImportError as error:
    raise UsSimError(
        "the reference solution needs scikit-fem, which is not installed: run "
        "pip install 'us_sim[evaluate]'"
    ) from error

Array = NDArray[np.float64]

_DEGREE = 3  # of the smoothing polynomial
_SMOOTHED = 20.0  # the smoother acts on eigenvalues down to the largest over this


class TwoLevel:
    """Large symmetric systems of quadratic elements by conjugate gradients over two levels.

    The coarse level is the same mesh with linear elements, solved directly by SciPy; the fine one
    is smoothed by Chebyshev polynomials of the block-Jacobi iteration (M. Adams, M. Brezina, J. Hu
    and R. Tuminaro, Parallel multigrid smoothing, J. Comput. Phys. 188, 2003). The factorised
    system is called with a right-hand side.

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

    def __call__(self, right: Array, tolerance: float) -> Array:
        """(3N,) solution with a residual below ``tolerance`` times the right-hand side's norm.

        Where the matrix turns out not to be positive definite, which ``is_definite`` says then, the
        search ends at the solution so far, which still descends.
        """
        self.is_definite = True
        solution = np.zeros_like(right)
        residual = right.copy()
        direction = preconditioned = self._cycle(residual)
        slope = residual @ preconditioned
        goal = tolerance * np.linalg.norm(right)
        for iteration in range(400):
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

    def _cycle(self, residual: Array) -> Array:
        """Smooth, correct on the coarse level, smooth."""
        solution = self._smoothed(np.zeros_like(residual), residual)
        left = residual - self._matrix @ solution
        solution += self._up @ self._coarse.solve(self._down @ left)
        return self._smoothed(solution, residual)

    def _smoothed(self, solution: Array, right: Array) -> Array:
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

    def _over_diagonal(self, vector: Array) -> Array:
        return np.einsum("nij,nj->ni", self._inverse, vector.reshape(-1, 3)).ravel()

    def _largest_eigenvalue(self) -> float:
        """Of the block-Jacobi iteration's matrix, by power iteration."""
        vector = np.random.default_rng(0).normal(size=self._matrix.shape[0])
        value = 1.0
        for _ in range(15):
            vector = self._over_diagonal(self._matrix @ (vector / np.linalg.norm(vector)))
            value = float(np.linalg.norm(vector))
        return value


_BATCH = 128  # elements whose stiffness is computed at once, which bounds the memory

_OWN, _LINEAR = 5.0, 45.0
"""Parts of lambda + mu over mu: `own` is all up to Poisson's ratio 0.4, `linear` the rest up to
0.49. What is beyond is `own` again, for without it Newton's method finds no way at 0.4999."""

_SIGN = np.zeros((3, 3, 3))  # the sign of each permutation of three axes
_SIGN[[0, 1, 2], [1, 2, 0], [2, 0, 1]] = 1.0
_SIGN[[0, 1, 2], [2, 0, 1], [1, 2, 0]] = -1.0


class NeoHookeanHexahedra:
    """Large deformation of a box of 27-node hexahedra between planes of each axis.

    The energy density is the stable neo-Hookean one (B. Smith, F. de Goes and T. Kim, Stable
    Neo-Hookean Flesh Simulation, ACM Trans. Graph. 37, 2018, without its logarithm):

        mu/2 (|F|^2 - 3) - mu (J - 1) + own/2 (J - 1)^2 + linear/2 p^2,  own + linear = lambda + mu,

    where p is the linear function in an element that is nearest to J - 1 in the mean square (the
    27/4 element of T. Sussman and K.-J. Bathe, A finite element formulation for nonlinear
    incompressible elastic and inelastic analysis, Comput. Struct. 26, 1987). With J - 1 alone large
    elements are too stiff however far from the probe they lie: at Poisson's ratio 0.49
    displacements came out 3 % wrong.

    Args:
        planes: m, ascending, of x, y and z.
        material: of the whole box.
    """

    def __init__(self, planes: Sequence[ArrayLike], material: Material) -> None:
        self.planes = tuple(np.asarray(coordinates, dtype=np.float64) for coordinates in planes)
        mesh = MeshHex.init_tensor(*self.planes)
        basis = Basis(mesh, ElementHex2(), intorder=5)
        self.nodes = basis.doflocs.T.copy()  # (N, 3) m
        self.elements = basis.element_dofs.T.copy()  # (M, 27)
        linear = Basis(mesh, ElementHex1())
        self.corners = linear.doflocs.T.copy()  # (C, 3) m
        # In the unit cube a node of a quadratic element is between the corners of its element.
        places = ElementHex2.doflocs.T
        weights = np.stack([linear.elem.lbasis(places, i)[0] for i in range(8)], axis=1)
        element, node = np.divmod(np.unique(self.elements, return_index=True)[1], 27)
        entries, columns = weights[node].ravel(), linear.element_dofs.T[element].ravel()
        #: (N, C), interpolation from the corners to the nodes.
        self.from_corners = csr_array((entries, columns, np.arange(0, len(entries) + 1, 8)))
        self.from_corners.eliminate_zeros()
        self._weights = basis.dx  # (M, Q) m3
        # (M, 27, Q, 3) 1/m
        self._gradients = np.ascontiguousarray(
            np.stack([field[0].grad for field in basis.basis]).transpose(2, 0, 3, 1)
        )
        self._projection = _onto_linear(basis.quadrature[0], basis.quadrature[1])  # (Q, Q)
        modulus, ratio = material.young_modulus, material.poisson_ratio
        self._shear = modulus / (2 * (1 + ratio))
        whole = self._shear / (1 - 2 * ratio)  # lambda + mu
        self._linear = float(np.clip(whole - _OWN * self._shear, 0.0, _LINEAR * self._shear))
        self._own = whole - self._linear

        top = mesh.facets_satisfying(lambda x: np.isclose(x[2], self.planes[2][0]))
        surface = FacetBasis(mesh, ElementHex2(), facets=top, intorder=7)
        self.surface_points = np.asarray(surface.global_coordinates()).reshape(3, -1).T  # (S, 3) m
        self.surface_weights = surface.dx.ravel()  # (S,) m2
        values = np.stack([np.asarray(field[0]) for field in surface.basis])  # (27, facets, points)
        count = values[0].size
        #: (S, N), values of the shape functions at the surface points.
        self.surface_values = csr_array(
            (
                values.reshape(27, -1).T.ravel(),
                np.repeat(surface.element_dofs.T, values.shape[2], axis=0).ravel(),
                np.arange(0, 27 * count + 1, 27),
            ),
            shape=(count, len(self.nodes)),
        )
        self.surface_values.eliminate_zeros()
        self._lay_out_blocks()

        # Which element lies in cell (i, j, k) between the planes.
        cells = self._cells(self.nodes[self.elements].mean(axis=1))
        self._element_of_cell = np.empty(tuple(len(p) - 1 for p in self.planes), dtype=int)
        self._element_of_cell[tuple(cells.T)] = np.arange(len(cells))
        self._shape_functions, self._mapping = basis.elem, basis.mapping

    def energy(self, displacement: Array) -> float:
        """J, stored at a displacement (N, 3)."""
        gradient = self._deformation_gradient(displacement)
        ratio = np.linalg.det(gradient) - 1.0
        density = 0.5 * self._shear * (np.einsum("mqij,mqij->mq", gradient, gradient) - 3.0)
        density += (0.5 * self._own * ratio - self._shear) * ratio
        density += 0.5 * self._linear * (ratio @ self._projection.T) ** 2
        return float((self._weights * density).sum())

    def forces(self, displacement: Array) -> Array:
        """(N, 3) N, derivative of the energy."""
        gradient = self._deformation_gradient(displacement)
        pressure = self._pressure(gradient)
        stress = self._shear * gradient + pressure[..., None, None] * _cofactor(gradient)
        stress *= self._weights[..., None, None]
        count = len(self.elements)
        local = self._gradients.reshape(count, 27, -1) @ stress.swapaxes(2, 3).reshape(count, -1, 3)
        return np.stack(
            [
                np.bincount(self.elements.ravel(), local[..., i].ravel(), len(self.nodes))
                for i in range(3)
            ],
            axis=1,
        )

    def stiffness(self, displacement: Array) -> bsr_array:
        """(3N, 3N) N/m, second derivative of the energy, in 3x3 blocks."""
        gradient = self._deformation_gradient(displacement)
        blocks = np.zeros((9, len(self._columns)))
        for first in range(0, len(self.elements), _BATCH):
            batch = slice(first, first + _BATCH)
            local = self._local_stiffness(gradient[batch], batch)
            place = self._place[batch].ravel()
            for entry in range(9):
                blocks[entry] += np.bincount(
                    place, local[..., entry].ravel(), minlength=len(self._columns)
                )
        size = 3 * len(self.nodes)
        data = np.ascontiguousarray(blocks.T).reshape(-1, 3, 3)
        return bsr_array((data, self._columns, self._start), shape=(size, size))

    def volume(self, displacement: Array) -> float:
        """m3, of the deformed box."""
        return float(
            (self._weights * np.linalg.det(self._deformation_gradient(displacement))).sum()
        )

    def smallest_volume_ratio(self, displacement: Array) -> float:
        """The least determinant of the deformation gradient at a quadrature point."""
        return float(np.linalg.det(self._deformation_gradient(displacement)).min())

    def at(self, field: Array, points: Array) -> Array:
        """(P, D), a nodal field (N, D) interpolated at rest positions (P, 3) m in the box."""
        elements = self._element_of_cell[tuple(self._cells(points).T)]
        local = self._mapping.invF(points.T[:, :, None], elements)[:, :, 0]
        values = np.stack([self._shape_functions.lbasis(local, i)[0] for i in range(27)], axis=1)
        return np.einsum("pa,pad->pd", values, field[self.elements[elements]])

    def _cells(self, points: Array) -> NDArray[np.intp]:
        """(P, 3) cell between the planes in which each point lies."""
        return np.stack(
            [
                np.clip(np.searchsorted(p, x, side="right") - 1, 0, len(p) - 2)
                for p, x in zip(self.planes, points.T, strict=True)
            ],
            axis=1,
        )

    def _lay_out_blocks(self) -> None:
        """Where the block of each pair of an element's nodes goes in the assembled matrix."""
        count = len(self.nodes)
        rows = np.repeat(self.elements, 27, axis=1).astype(np.int64)
        pairs, place = np.unique(
            rows * count + np.tile(self.elements, (1, 27)), return_inverse=True
        )
        self._place = place.reshape(len(self.elements), -1)  # (M, 729)
        self._columns = (pairs % count).astype(np.int32)
        self._start = np.searchsorted(pairs, np.arange(count + 1) * count).astype(np.int32)

    def _deformation_gradient(self, displacement: Array) -> Array:
        """(M, Q, 3, 3)."""
        count = len(self.elements)
        local = displacement[self.elements].swapaxes(1, 2)  # (M, 3, 27)
        product = local @ self._gradients.reshape(count, 27, -1)
        return product.reshape(count, 3, -1, 3).swapaxes(1, 2) + np.eye(3)

    def _local_stiffness(self, gradient: Array, batch: slice) -> Array:
        """(B, 729, 9) N/m of each pair of nodes, of a batch of elements."""
        count, points = gradient.shape[:2]
        cofactor = _cofactor(gradient)
        pressure = self._pressure(gradient)
        # d P_iJ / d F_kL as (B, Q, J, i, k, L)
        twist = np.einsum("ikm,jln,bqmn->bqjikl", _SIGN, _SIGN, gradient, optimize=True)
        moduli = pressure[..., None, None, None, None] * twist
        moduli += self._own * np.einsum("bqij,bqkl->bqjikl", cofactor, cofactor)
        for i in range(3):
            for j in range(3):
                moduli[:, :, j, i, i, j] += self._shear
        moduli *= self._weights[batch][..., None, None, None, None]
        shapes = self._gradients[batch]  # (B, 27, Q, 3)
        right = moduli.reshape(count, points, 27, 3) @ shapes.transpose(0, 2, 3, 1)
        right = right.reshape(count, points * 3, 9 * 27)
        local = shapes.reshape(count, 27, points * 3) @ right  # (B, 27, 9 * 27)
        local = local.reshape(count, 27, 9, 27).swapaxes(2, 3).reshape(count, -1, 9)
        # d p by the nodes' displacements, (B, Q, 81)
        slopes = np.einsum("bqij,baqj->bqai", cofactor, shapes).reshape(count, points, 81)
        slopes = self._projection @ slopes
        bulk = (slopes * (self._linear * self._weights[batch])[..., None]).swapaxes(1, 2) @ slopes
        local += bulk.reshape(count, 27, 3, 27, 3).swapaxes(2, 3).reshape(count, -1, 9)
        return local

    def _pressure(self, gradient: Array) -> Array:
        """(M, Q) Pa, the factor of the cofactor in the stress."""
        ratio = np.linalg.det(gradient) - 1.0
        linear = self._linear * (ratio @ self._projection.T)
        return self._own * ratio - self._shear + linear


def _onto_linear(points: Array, weights: Array) -> Array:
    """(Q, Q), from values at quadrature points (3, Q) of a box to the nearest linear function's."""
    linear = np.vstack([np.ones(points.shape[1]), points]).T  # (Q, 4)
    weighted = linear * weights[:, None]
    return linear @ np.linalg.solve(linear.T @ weighted, weighted.T)


def _cofactor(matrix: Array) -> Array:
    """The derivative of the determinant of (..., 3, 3) matrices."""
    rows = [np.cross(matrix[..., (i + 1) % 3, :], matrix[..., (i + 2) % 3, :]) for i in range(3)]
    return np.stack(rows, axis=-2)
