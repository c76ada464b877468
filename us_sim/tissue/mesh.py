"""Tetrahedral meshes of soft tissue, and the regular box mesh of the paper (section VI).

>>> from us_sim.tissue.mesh import box_mesh, uniform_planes
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

__all__ = ["TetrahedralMesh", "box_mesh", "uniform_planes"]

# Below this fraction of its longest edge cubed a tetrahedron's volume is rounding noise.
_SMALLEST_VOLUME = 1e-9

# The six edges and the four outward faces of a positively oriented tetrahedron.
_EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
_FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])

# Five tetrahedra of a cell, as corner offsets: four at alternate corners and the one between.
_FIVE = np.array(
    [
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[1, 1, 0], [0, 1, 0], [1, 0, 0], [1, 1, 1]],
        [[1, 0, 1], [0, 0, 1], [1, 1, 1], [1, 0, 0]],
        [[0, 1, 1], [1, 1, 1], [0, 0, 1], [0, 1, 0]],
        [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]],
    ]
)


@dataclass(frozen=True, eq=False)
class TetrahedralMesh:
    """Nodes and positively oriented tetrahedra; every node belongs to at least one.

    Raises:
        MeshError: wrong shapes, nodes that are not finite, indices out of range, an inverted or
            flat tetrahedron, or a node that no tetrahedron uses.
    """

    nodes: NDArray[np.float64]  # (N, 3), m, frame patient
    tetrahedra: NDArray[np.int32]  # (M, 4), indices into nodes
    planes: tuple[NDArray[np.float64], ...] | None = None  # m, of each axis, of a box mesh

    def __post_init__(self) -> None:
        nodes = np.array(self.nodes, dtype=np.float64, order="C")
        tetrahedra = np.array(self.tetrahedra, order="C")
        if nodes.ndim != 2 or nodes.shape[1] != 3:
            raise MeshError(f"mesh nodes have shape {nodes.shape}: give (N, 3) coordinates")
        if tetrahedra.ndim != 2 or tetrahedra.shape[1] != 4 or tetrahedra.shape[0] == 0:
            raise MeshError(f"tetrahedra have shape {tetrahedra.shape}: give (M, 4) indices, M > 0")
        if not np.issubdtype(tetrahedra.dtype, np.integer):
            raise MeshError(f"tetrahedra are of type {tetrahedra.dtype}: give integer node indices")
        bad = np.flatnonzero(~np.isfinite(nodes).all(axis=1))
        if len(bad):
            raise MeshError(f"mesh node {bad[0]} is not finite: {nodes[bad[0]].tolist()}")
        if tetrahedra.min() < 0 or tetrahedra.max() >= len(nodes):
            raise MeshError(
                f"tetrahedra name nodes {tetrahedra.min()} to {tetrahedra.max()}, but the mesh "
                f"has nodes 0 to {len(nodes) - 1}"
            )
        used = np.zeros(len(nodes), dtype=bool)
        used[tetrahedra] = True
        if not used.all():
            raise MeshError(
                f"mesh node {np.flatnonzero(~used)[0]} belongs to no tetrahedron: remove it"
            )
        object.__setattr__(self, "nodes", nodes)
        object.__setattr__(self, "tetrahedra", tetrahedra.astype(np.int32))
        corners = nodes[tetrahedra]
        longest = np.linalg.norm(corners[:, _EDGES[:, 0]] - corners[:, _EDGES[:, 1]], axis=2).max(1)
        bad = np.flatnonzero(self.volumes <= _SMALLEST_VOLUME * longest**3)
        if len(bad):
            raise MeshError(
                f"tetrahedron {bad[0]} is flat or inverted (volume {self.volumes[bad[0]]:.3g} m3): "
                f"order its nodes so that its volume is positive"
            )

    @cached_property
    def volumes(self) -> NDArray[np.float64]:
        """(M,) m3, signed volume of each tetrahedron."""
        return _volumes(self.nodes, self.tetrahedra)

    @cached_property
    def edges(self) -> NDArray[np.int32]:
        """(E, 2) each edge once, the smaller node first, in lexicographic order."""
        return np.unique(np.sort(self.tetrahedra[:, _EDGES].reshape(-1, 2), axis=1), axis=0)

    @cached_property
    def boundary(self) -> NDArray[np.int32]:
        """(F, 3) triangles that belong to one tetrahedron only, normals pointing outward."""
        faces = self.tetrahedra[:, _FACES].reshape(-1, 3)
        _, first, count = np.unique(
            np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True
        )
        return faces[np.sort(first[count == 1])]


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
    mirrored = _volumes(nodes, tetrahedra) < 0
    tetrahedra[mirrored] = tetrahedra[mirrored][:, [0, 1, 3, 2]]
    return TetrahedralMesh(nodes, tetrahedra, tuple(planes))


def _volumes(nodes: NDArray[np.float64], tetrahedra: NDArray[np.integer]) -> NDArray[np.float64]:
    a, b, c, d = np.moveaxis(nodes[tetrahedra], 1, 0)
    return np.einsum("ij,ij->i", b - a, np.cross(c - a, d - a)) / 6
