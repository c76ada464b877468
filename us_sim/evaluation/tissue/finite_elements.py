"""Finite elements of scikit-fem as a second opinion on `us_sim.tissue`, with no code in common.

>>> planes = [0.0, 0.05, 0.1]
>>> block = NeoHookeanHexahedra((planes, planes, planes), Material(10e3, 0.45, 1000.0))
>>> turned = block.nodes @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]).T - block.nodes
>>> block.nodes.shape, bool(abs(block.compute_forces(turned)).max() < 1e-12)
((125, 3), True)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import bsr_array, coo_array, csr_array

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

_BATCH = 128  # elements whose stiffness is computed at once, which bounds the memory

_OWN, _LINEAR = 5.0, 45.0
"""Parts of lambda + mu over mu: `own` is all up to Poisson's ratio 0.4, `linear` the rest up to
0.49. The part above that is `own` again; without it Newton's method does not converge at 0.4999."""


class NeoHookeanHexahedra:
    """Large deformation of a box of 27-node hexahedra between planes of each axis.

    The energy density is the stable neo-Hookean one (B. Smith, F. de Goes and T. Kim, Stable
    Neo-Hookean Flesh Simulation, ACM Trans. Graph. 37, 2018, without its logarithm):

        mu/2 (|F|^2 - 3) - mu (J - 1) + own/2 (J - 1)^2 + linear/2 p^2,  own + linear = lambda + mu,

    where p is the linear function in an element that is nearest to J - 1 in the mean square (the
    27/4 element of T. Sussman and K.-J. Bathe, A finite element formulation for nonlinear
    incompressible elastic and inelastic analysis, Comput. Struct. 26, 1987). With J - 1 alone large
    elements are too stiff even far from the probe: at Poisson's ratio 0.49 displacements were 3 %
    wrong. Meshes, shape functions and quadrature are scikit-fem's; its
    loop over pairs of shape functions takes 23 times as long for a stiffness (125 elements).

    Args:
        planes: m, ascending, of x, y and z.
        material: of the whole box.
    """

    def __init__(self, planes: Sequence[ArrayLike], material: Material) -> None:
        self.planes = tuple(np.asarray(coordinates, dtype=np.float64) for coordinates in planes)
        mesh = MeshHex.init_tensor(*self.planes)
        self._basis = basis = Basis(mesh, ElementHex2(), intorder=5)
        self.nodes = basis.doflocs.T.copy()  # (N, 3) m
        self.elements = basis.element_dofs.T.copy()  # (M, 27)
        middles = self.nodes[self.elements].mean(axis=1).T
        #: The element between the planes i and i + 1, j and j + 1, k and k + 1.
        self._element_of_cell = np.empty([len(p) - 1 for p in self.planes], dtype=int)
        cells = (np.searchsorted(p, x) - 1 for p, x in zip(self.planes, middles, strict=True))
        self._element_of_cell[tuple(cells)] = np.arange(len(self.elements))
        linear = Basis(mesh, ElementHex1())
        self.corners = linear.doflocs.T.copy()  # (C, 3) m
        #: (N, C), interpolation from the corners to the nodes.
        self.from_corners = self._evaluate_basis(linear, self.nodes)
        self._weights = basis.dx  # (M, Q) m3
        # (M, Q, 3, 27) 1/m
        self._gradients = np.ascontiguousarray(
            np.stack([field[0].grad for field in basis.basis]).transpose(2, 3, 1, 0)
        )
        self._projection = _make_linear_projection(*basis.quadrature)  # (Q, Q)
        modulus, ratio = material.young_modulus, material.poisson_ratio
        self._shear = modulus / (2 * (1 + ratio))
        whole = self._shear / (1 - 2 * ratio)  # lambda + mu
        self._linear = float(np.clip(whole - _OWN * self._shear, 0.0, _LINEAR * self._shear))
        self._own = whole - self._linear
        top = mesh.facets_satisfying(lambda x: np.isclose(x[2], self.planes[2][0]))
        surface = FacetBasis(mesh, ElementHex2(), facets=top, intorder=7)
        self.surface_points = np.asarray(surface.global_coordinates()).reshape(3, -1).T  # (S, 3) m
        self.surface_weights = surface.dx.ravel()  # (S,) m2
        #: (S, N), values of the shape functions at the surface points.
        self.surface_values = self._evaluate_basis(basis, self.surface_points)

    def compute_energy(self, displacement: Array) -> float:
        """Compute the energy (J) at a displacement (N, 3) m; infinite if an element is inverted."""
        gradient = self._compute_deformation_gradient(displacement)
        ratio = np.linalg.det(gradient)
        if not ratio.min() > 0.0:
            return np.inf
        swelling = ratio - 1.0
        density = 0.5 * self._shear * ((gradient**2).sum(axis=(2, 3)) - 3.0)
        density += (0.5 * self._own * swelling - self._shear) * swelling
        density += 0.5 * self._linear * (swelling @ self._projection.T) ** 2
        return float((self._weights * density).sum())

    def compute_forces(self, displacement: Array) -> Array:
        """Compute forces (N, 3) N, the derivative of the energy."""
        gradient = self._compute_deformation_gradient(displacement)
        pressure, cofactor = self._compute_pressure(gradient)
        stress = self._shear * gradient + pressure[..., None, None] * cofactor
        stress *= self._weights[..., None, None]
        local = (stress @ self._gradients).sum(axis=1)  # (M, 3, 27)
        return np.stack(
            [
                np.bincount(self.elements.ravel(), local[:, i].ravel(), len(self.nodes))
                for i in range(3)
            ],
            axis=1,
        )

    def assemble_stiffness(self, displacement: Array) -> bsr_array:
        """Assemble the energy's second derivative (3N, 3N) N/m; no element may be inverted."""
        gradient = self._compute_deformation_gradient(displacement)
        batches = [slice(k, k + _BATCH) for k in range(0, len(gradient), _BATCH)]
        local = np.concatenate(
            [self._compute_local_stiffness(gradient[some], some) for some in batches]
        )
        rows = np.repeat(self.elements, 27, axis=1).ravel()
        columns = np.tile(self.elements, (1, 27)).ravel()
        entries = [
            coo_array((local[..., i].ravel(), (rows, columns)), shape=2 * [len(self.nodes)]).tocsr()
            for i in range(9)
        ]
        blocks = np.stack([part.data for part in entries], axis=1).reshape(-1, 3, 3)
        return bsr_array((blocks, entries[0].indices, entries[0].indptr))

    def compute_volume(self, displacement: Array) -> float:
        """Compute the volume (m3) of the deformed box."""
        ratio = np.linalg.det(self._compute_deformation_gradient(displacement))
        return float((self._weights * ratio).sum())

    def interpolate_field(self, field: Array, points: Array) -> Array:
        """Interpolate a nodal field (N, D) at rest positions (P, 3) m in the box: (P, D)."""
        return np.asarray(self._evaluate_basis(self._basis, points) @ field)

    def _evaluate_basis(self, basis: Basis, points: Array) -> csr_array:
        """Evaluate a basis' shape functions at points (P, 3) m in the box: (P, N)."""
        cells = tuple(
            np.clip(np.searchsorted(p, x, side="right") - 1, 0, len(p) - 2)
            for p, x in zip(self.planes, points.T, strict=True)
        )
        elements = self._element_of_cell[cells]
        local = basis.mapping.invF(points.T[:, :, None], elements)[:, :, 0]
        values = np.stack([basis.elem.lbasis(local, i)[0] for i in range(basis.Nbfun)], axis=1)
        ends = np.arange(0, values.size + 1, basis.Nbfun)
        nodes = basis.element_dofs.T[elements]
        found = csr_array((values.ravel(), nodes.ravel(), ends), shape=(len(points), basis.N))
        found.eliminate_zeros()
        return found

    def _compute_deformation_gradient(self, displacement: Array) -> Array:
        """Compute the deformation gradient (M, Q, 3, 3) at the quadrature points."""
        local = displacement[self.elements][:, None]  # (M, 1, 27, 3)
        return (self._gradients @ local).swapaxes(2, 3) + np.eye(3)

    def _compute_local_stiffness(self, gradient: Array, batch: slice) -> Array:
        """Compute the stiffness (B, 729, 9) N/m of each pair of nodes of a batch of elements.

        The cofactor's derivative is (cof_ij cof_kl - cof_il cof_kj) / J.
        """
        count, points = gradient.shape[:2]
        weights, shapes = self._weights[batch], self._gradients[batch]
        pressure, cofactor = self._compute_pressure(gradient)
        turned = (cofactor @ shapes).swapaxes(2, 3).reshape(count, points, 81)  # d J
        pushed = weights * pressure / np.linalg.det(gradient)
        twisted = _sum_products(turned, pushed)
        local = twisted + _sum_products(turned, self._own * weights)
        local += _sum_products(self._projection @ turned, self._linear * weights)
        local = local.reshape(count, 27, 3, 27, 3)
        local -= twisted.reshape(local.shape).swapaxes(2, 4)
        sheared = _sum_products(
            shapes.reshape(count, points * 3, 27), np.repeat(self._shear * weights, 3, axis=1)
        )
        local += sheared[:, :, None, :, None] * np.eye(3)[:, None]
        return local.swapaxes(2, 3).reshape(count, 729, 9)

    def _compute_pressure(self, gradient: Array) -> tuple[Array, Array]:
        """Return the cofactor's factor (M, Q) Pa in the stress, and the cofactor (M, Q, 3, 3)."""
        rows = [np.cross(gradient[..., i - 2, :], gradient[..., i - 1, :]) for i in range(3)]
        swelling = np.linalg.det(gradient) - 1.0
        linear = self._linear * (swelling @ self._projection.T)
        return self._own * swelling - self._shear + linear, np.stack(rows, axis=-2)


def _sum_products(vectors: Array, weights: Array) -> Array:
    """Sum weighted products of all pairs of components of vectors (B, Q, K): (B, K, K)."""
    return (vectors * weights[..., None]).swapaxes(1, 2) @ vectors


def _make_linear_projection(points: Array, weights: Array) -> Array:
    """Make the (Q, Q) map from values at points (3, Q) to the nearest linear function's."""
    linear = np.vstack([np.ones(points.shape[1]), points]).T  # (Q, 4)
    weighted = linear * weights[:, None]
    return linear @ np.linalg.solve(linear.T @ weighted, weighted.T)
