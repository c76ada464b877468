"""The linear equations that the solver `fem` solves, assembled by scikit-fem, solved by SciPy.

>>> import numpy as np
>>> from us_sim.evaluation.tissue.linear_equations import LinearEquations
>>> from us_sim.evaluation.tissue.cases import SCENES
>>> model = SCENES["press_12mm"].model((5, 3, 3))
>>> equations = LinearEquations(model)
>>> turned = np.cross([0.0, 0.0, 1.0], model.mesh.nodes)
>>> bool(abs(equations.forces(turned)).max() < 1e-12)  # a small turn strains nothing
True
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, dia_array
from scipy.sparse.linalg import LinearOperator
from skfem import Basis, BilinearForm, ElementTetP1, ElementVector, MeshTet
from skfem.helpers import ddot, div, sym_grad

from us_sim.evaluation.solved import solved
from us_sim.tissue.elasticity.materials import volumetric_split
from us_sim.tissue.model import TissueModel

_MAXIMUM_ITERATIONS = 10_000


@BilinearForm
def _elasticity(u, v, w):  # type: ignore[no-untyped-def]
    return 2 * w["shear"] * ddot(sym_grad(u), sym_grad(v)) + w["rest"] * div(u) * div(v)


class LinearEquations:
    """Hooke's law on linear tetrahedra, with the part of the bulk stiffness that acts at nodes.

    The model is of one material throughout.
    """

    def __init__(self, model: TissueModel) -> None:
        self._model = model
        mesh = MeshTet(*map(np.ascontiguousarray, (model.mesh.nodes.T, model.mesh.tetrahedra.T)))
        split = volumetric_split(model.materials)
        shear, element = float(split.shear[0]), float(split.element[0])
        vectors = Basis(mesh, ElementVector(ElementTetP1()))
        self._matrix = _elasticity.assemble(vectors, shear=shear, rest=element - shear).tocsr()

        count, size = len(model.mesh.nodes), len(model.mesh.tetrahedra)
        scalars = Basis(mesh, ElementTetP1())
        gradients = np.stack([field[0].grad[:, :, 0] for field in scalars.basis])  # (4, 3, M)
        columns = 3 * mesh.t[:, None] + np.arange(3)[None, :, None]
        entries, places = (x.transpose(2, 0, 1).ravel() for x in (gradients, columns))
        starts = np.arange(0, 12 * size + 1, 12)
        divergence = csr_array((entries, places, starts), shape=(size, 3 * count))
        # A quarter of each tetrahedron belongs to each of its nodes.
        quarter = np.repeat(scalars.dx.sum(axis=1) / 4, 4)
        around = csr_array((quarter, (mesh.t.T.ravel(), np.repeat(np.arange(size), 4))))
        volume = around.sum(axis=1)
        each = dia_array((1 / volume[None], [0]), shape=2 * volume.shape)
        self._average = (each @ around @ divergence).tocsr()
        self._spread = self._average.T.tocsr()
        self._nodal = float(split.nodal[0]) * volume  # (N,) Pa m3

    def forces(self, displacement: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 3) N, that hold the tissue at a displacement (N, 3) m."""
        return self._product(displacement.ravel()).reshape(-1, 3)

    def solve(
        self, touched: NDArray[np.int32], normals: NDArray[np.float64], depths: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Equilibrium with known displacements of the touched nodes along their normals.

        Args:
            touched: (K,) nodes.
            normals: (K, 3), unit.
            depths: (K,) m.

        Returns:
            (N, 3) m, displacement, and (K,) N, what pushes the touched nodes along the normals.

        Raises:
            SolverError: SciPy's conjugate gradients did not converge.
        """
        free = np.repeat(~self._model.fixed, 3).astype(float)

        def project(vector: NDArray[np.float64]) -> NDArray[np.float64]:
            kept = (vector * free).reshape(-1, 3)
            along = np.einsum("ij,ij->i", kept[touched], normals)
            kept[touched] -= along[:, None] * normals
            return kept.ravel()

        prescribed = np.zeros(self._model.mesh.nodes.shape)
        prescribed[touched] = depths[:, None] * normals
        right = project(-self._product(prescribed.ravel()))
        diagonal = self._matrix.diagonal() + self._spread.power(2) @ self._nodal
        shape = self._matrix.shape
        found = solved(
            LinearOperator(shape, lambda v: project(self._product(project(v)))),
            right,
            1e-11,
            LinearOperator(shape, lambda v: project(project(v) / diagonal)),
            _MAXIMUM_ITERATIONS,
        )
        displacement = prescribed + found.reshape(-1, 3)
        pushes = np.einsum("ij,ij->i", self.forces(displacement)[touched], normals)
        return displacement, pushes

    def _product(self, vector: NDArray[np.float64]) -> NDArray[np.float64]:
        return self._matrix @ vector + self._spread @ (self._nodal * (self._average @ vector))
