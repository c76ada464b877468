"""How the surface that a probe can touch, and the whole tissue below it, yields to forces.

>>> import numpy as np
>>> from us_sim.collider import Sphere
>>> from us_sim.tissue.box import face_nodes
>>> from us_sim.tissue.compliance import surface_compliance
>>> from us_sim.tissue.materials import Material, uniform_material
>>> from us_sim.tissue.mesh import box_mesh, uniform_planes
>>> from us_sim.tissue.model import TissueModel
>>> across, deep = uniform_planes(-0.05, 0.05, 5), uniform_planes(0.0, 0.1, 5)
>>> mesh = box_mesh(across, across, deep)
>>> fixed = np.isin(np.arange(len(mesh.nodes)), face_nodes(mesh, "bottom"))
>>> materials = uniform_material(mesh, Material(10e3, 0.45, 1000.0))
>>> model = TissueModel(mesh, materials, fixed, Sphere(0.03), face_nodes(mesh, "top"))
>>> compliance = surface_compliance(model)
>>> forces = np.zeros((25, 3))
>>> forces[12, 2] = 1.0  # N, downwards in the middle of the top
>>> field = compliance.field(forces)
>>> middle = compliance.nodes[12]
>>> bool(field[middle, 2] > 0), bool(np.isclose(field[middle, 2], compliance.matrix[38, 38]))
(True, True)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from us_sim.tissue.averaged_pressure import averaged_pressure
from us_sim.tissue.elasticity import require_held
from us_sim.tissue.model import TissueModel

__all__ = ["SurfaceCompliance", "surface_compliance"]


@dataclass(frozen=True, eq=False)
class SurfaceCompliance:
    """Displacements per force at the S nodes that the probe can touch and move."""

    nodes: NDArray[np.int32]  # (S,), the model's movable contact nodes
    free: NDArray[np.int32]  # (F,), nodes that are not fixed, ascending
    matrix: NDArray[np.float64]  # (3S, 3S), m/N, displacement 3 s + axis of force 3 t + axis
    fields: NDArray[np.floating]  # (3S, 3, F), m/N, what each force does to all free nodes
    count: int  # N, nodes of the mesh
    rounding: float  # unbalanced force that rounding leaves in a field, over the force

    def add_field(self, forces: NDArray[np.float64], displacement: NDArray[np.float32]) -> None:
        """Add what forces (S, 3) N do to displacement (3, N) m; rows without force are not read."""
        total = np.zeros((3, len(self.free)))
        self._sum(forces, total)
        displacement[:, self.free] += total.astype(displacement.dtype)

    def field(self, forces: NDArray[np.float64]) -> NDArray[np.float64]:
        """(N, 3) m, what forces (S, 3) N do to every node."""
        displacement = np.zeros((self.count, 3))
        total = np.zeros((3, len(self.free)))
        self._sum(forces, total)
        displacement[self.free] = total.T
        return displacement

    def _sum(self, forces: NDArray[np.float64], total: NDArray[np.float64]) -> None:
        rows = np.flatnonzero(forces.ravel())
        _add_rows(
            self.fields.reshape(len(self.fields), -1), rows, forces.ravel()[rows], total.reshape(-1)
        )


def surface_compliance(model: TissueModel) -> SurfaceCompliance:
    """Solve for a unit force along each axis at each node that the probe can touch.

    Raises:
        SolverError: the tissue is not held.
    """
    require_held(model.mesh, model.fixed)
    nodes = model.movable_contact_nodes
    count = len(model.mesh.nodes)
    free = np.flatnonzero(~model.fixed).astype(np.int32)
    kept = np.repeat(~model.fixed, 3)
    matrix = averaged_pressure(model.mesh, model.materials).stiffness[kept][:, kept]
    place = np.cumsum(~model.fixed) - 1
    touched = (3 * place[nodes][:, None] + np.arange(3)).ravel()
    loads = np.zeros((3 * len(free), len(touched)))
    loads[touched, np.arange(len(touched))] = 1.0
    solved = splu(matrix.tocsc()).solve(loads) if loads.size else loads
    fields = solved.T.reshape(-1, len(free), 3).transpose(0, 2, 1).astype(np.float32)
    square = solved[touched]
    return SurfaceCompliance(
        nodes,
        free,
        np.ascontiguousarray(square + square.T) / 2,
        np.ascontiguousarray(fields),
        count,
        0.0,
    )


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _add_rows(fields, rows, weights, total):
    """Adds the weighted rows of fields (R, K) to total (K,), four at a time."""
    width = 2048  # of a piece of the total that stays in the cache
    four = len(rows) // 4 * 4
    for begin in range(0, len(total), width):
        piece = total[begin : begin + width]
        for m in range(0, four, 4):
            a = fields[rows[m]][begin : begin + width]
            b = fields[rows[m + 1]][begin : begin + width]
            c = fields[rows[m + 2]][begin : begin + width]
            d = fields[rows[m + 3]][begin : begin + width]
            p, q, r, s = weights[m], weights[m + 1], weights[m + 2], weights[m + 3]
            for i in range(len(piece)):
                piece[i] += p * a[i] + q * b[i] + r * c[i] + s * d[i]
        for m in range(four, len(rows)):
            a = fields[rows[m]][begin : begin + width]
            p = weights[m]
            for i in range(len(piece)):
                piece[i] += p * a[i]
