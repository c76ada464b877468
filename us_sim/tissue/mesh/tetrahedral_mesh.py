"""Tetrahedral meshes of soft tissue, and the regular box mesh of the paper (section VI).

>>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
>>> mesh = box_mesh(
...     uniform_planes(-0.1, 0.1, 20), uniform_planes(-0.05, 0.05, 10), uniform_planes(0, 0.1, 10)
... )
>>> len(mesh.nodes), len(mesh.tetrahedra)
(2000, 7695)
>>> f"{mesh.volumes.sum():.6f} m3"
'0.002000 m3'
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import MeshError
from us_sim.geometry.connected_parts import connected_parts
from us_sim.geometry.mesh_faces import boundary_faces, boundary_triangles
from us_sim.tissue.mesh.check import EDGES, check_mesh, signed_volumes

_FIVE = np.array(
    [
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[1, 1, 0], [0, 1, 0], [1, 0, 0], [1, 1, 1]],
        [[1, 0, 1], [0, 0, 1], [1, 1, 1], [1, 0, 0]],
        [[0, 1, 1], [1, 1, 1], [0, 0, 1], [0, 1, 0]],
        [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]],
    ]
)
"""Five tetrahedra of a cell, as corner offsets: four at alternate corners and the one between."""


@dataclass(frozen=True, eq=False)
class TetrahedralMesh:
    """Nodes and positively oriented tetrahedra; every node belongs to at least one.

    It may be in several parts that touch nowhere.

    Raises:
        MeshError: as `us_sim.tissue.mesh.check.check_mesh`.
    """

    nodes: NDArray[np.float64]  # (N, 3), m, frame patient
    tetrahedra: NDArray[np.int32]  # (M, 4), indices into nodes
    planes: tuple[NDArray[np.float64], ...] | None = None  # m, of each axis, of a box mesh

    def __post_init__(self) -> None:
        nodes = np.array(self.nodes, dtype=np.float64, order="C")
        tetrahedra = np.array(self.tetrahedra, order="C")
        check_mesh(nodes, tetrahedra)
        object.__setattr__(self, "nodes", nodes)
        object.__setattr__(self, "tetrahedra", tetrahedra.astype(np.int32))

    @cached_property
    def volumes(self) -> NDArray[np.float64]:
        """(M,) m3, of each tetrahedron."""
        return signed_volumes(self.nodes, self.tetrahedra)

    @cached_property
    def edges(self) -> NDArray[np.int32]:
        """(E, 2) each edge once, the smaller node first, in lexicographic order."""
        ends = np.sort(self.tetrahedra[:, EDGES].reshape(-1, 2), axis=1).astype(np.int64)
        once = np.unique(ends[:, 0] << 32 | ends[:, 1])
        return np.column_stack([once >> 32, once & 0xFFFFFFFF]).astype(np.int32)

    @cached_property
    def boundary(self) -> NDArray[np.int32]:
        """(F, 3) triangles that belong to one tetrahedron only, normals pointing outward."""
        return boundary_triangles(self.tetrahedra)

    @cached_property
    def boundary_tetrahedra(self) -> NDArray[np.int32]:
        """(F,) the tetrahedron that each triangle of the boundary belongs to."""
        return (boundary_faces(self.tetrahedra) // 4).astype(np.int32)

    @cached_property
    def parts(self) -> NDArray[np.int64]:
        """(N,) which part each node belongs to, from 0; parts touch nowhere."""
        return connected_parts(len(self.nodes), *self.edges.T)


def uniform_planes(lo: float, hi: float, n: int) -> NDArray[np.float64]:
    """(n,) m, equally spaced mesh planes of one axis from ``lo`` to ``hi``.

    Raises:
        MeshError: fewer than two planes.
    """
    if n < 2:
        raise MeshError(f"a box mesh of {n} planes along an axis has no cells: give at least 2")
    return np.linspace(lo, hi, n)


def box_mesh(planes_x: ArrayLike, planes_y: ArrayLike, planes_z: ArrayLike) -> TetrahedralMesh:
    """A rectilinear grid of cells, five tetrahedra each, mirrored in every other cell to conform.

    Node (i, j, k) has the index (i * len(planes_y) + j) * len(planes_z) + k.

    Args:
        planes_x, planes_y, planes_z: m, ascending coordinates of the node planes of each axis.

    Raises:
        MeshError: an axis has fewer than two planes, or they do not ascend.
    """
    planes = []
    for axis, values in zip("xyz", (planes_x, planes_y, planes_z), strict=True):
        coordinates = np.asarray(values, dtype=np.float64)
        if (
            coordinates.ndim != 1
            or len(coordinates) < 2
            or not np.isfinite(coordinates).all()
            or not (np.diff(coordinates) > 0).all()
        ):
            raise MeshError(
                f"the mesh planes along {axis} must be at least two finite ascending coordinates"
            )
        planes.append(coordinates)
    shape = tuple(len(coordinates) for coordinates in planes)
    nodes = np.stack(np.meshgrid(*planes, indexing="ij"), axis=-1).reshape(-1, 3)

    cells = np.indices([n - 1 for n in shape]).reshape(3, -1).T
    offsets = np.broadcast_to(_FIVE, (len(cells), 5, 4, 3)).copy()
    odd = cells.sum(axis=1) % 2 == 1
    offsets[odd, ..., 0] = 1 - offsets[odd, ..., 0]
    corners = cells[:, None, None, :] + offsets
    tetrahedra = np.ravel_multi_index(tuple(np.moveaxis(corners, -1, 0)), shape).reshape(-1, 4)
    mirrored = signed_volumes(nodes, tetrahedra) < 0
    tetrahedra[mirrored] = tetrahedra[mirrored][:, [0, 1, 3, 2]]
    return TetrahedralMesh(nodes, tetrahedra, tuple(planes))
