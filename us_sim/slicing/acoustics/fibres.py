"""Where the fibres of muscle, nerve and tendon point in tissue as it is deformed now.

A direction at rest is carried by the deformation gradient F of the tetrahedron that it lies in,
t = F t0. With the gradients of the barycentric coordinates at rest, F t0 is a weighted sum of where
the four nodes are now.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit
from us_sim.slicing.cutting.located import Located
from us_sim.slicing.probe.plane import SlicePlane


class Fibres:
    """The directions of fibres at rest, carried by a mesh.

    Args:
        directions: (D, 3) unit vectors in ``patient``.
    """

    def __init__(self, directions: NDArray[np.float64]) -> None:
        self._rest = directions
        self._weights = np.empty((0, len(directions), 4), dtype=np.float32)
        self._corners = np.empty((0, 4), dtype=np.int32)

    def carry(self, rest_nodes: NDArray[np.float64], corners: NDArray[np.int32]) -> None:
        """Let a mesh carry them: (N, 3) m at rest and (M, 4)."""
        edges = rest_nodes[corners[:, 1:]] - rest_nodes[corners[:, :1]]  # rows are edges
        determinant = np.linalg.det(edges)
        flat = np.abs(determinant) < 1e-30
        edges[flat] = np.eye(3)
        # Barycentric coordinates 1 to 3 along a direction: edges^T b = direction.
        along = np.linalg.solve(
            edges.transpose(0, 2, 1),
            np.broadcast_to(self._rest.T, (len(edges), *self._rest.T.shape)),
        )
        weights = np.empty((len(corners), len(self._rest), 4))
        weights[:, :, 1:] = along.transpose(0, 2, 1)
        weights[:, :, 0] = -weights[:, :, 1:].sum(axis=2)
        weights[flat] = 0.0
        self._weights, self._corners = weights.astype(np.float32), corners

    def now(
        self, located: Located, nodes: NDArray[np.float64], plane: SlicePlane
    ) -> NDArray[np.float32]:
        """(E + 1, D, 2): x and z along the image of the unit direction in each map's tissue.

        Args:
            nodes: (N, 3) m, where the mesh is now.
        """
        across, down = (step / np.linalg.norm(step) for step in (plane.column_step, plane.row_step))
        out = np.empty((len(located.maps), len(self._rest), 2), dtype=np.float32)
        out[-1] = self._rest @ np.column_stack([across, down])  # tissue that is as at rest
        _carried(located.tetrahedra, self._corners, nodes, self._weights, across, down, out)
        return out


@njit(cache=True, nogil=True, error_model="numpy")
def _carried(tetrahedra, corners, nodes, weights, across, down, out):
    for q in range(len(tetrahedra)):
        e = np.uint32(tetrahedra[q])
        for d in range(weights.shape[1]):
            x = y = z = 0.0
            for k in range(4):
                n = np.uint32(corners[e, k])
                w = np.float64(weights[e, d, k])
                x += w * nodes[n, 0]
                y += w * nodes[n, 1]
                z += w * nodes[n, 2]
            length = np.sqrt(x * x + y * y + z * z)
            scale = 1.0 / length if length > 0.0 else 0.0
            out[q, d, 0] = scale * (x * across[0] + y * across[1] + z * across[2])
            out[q, d, 1] = scale * (x * down[0] + y * down[1] + z * down[2])
