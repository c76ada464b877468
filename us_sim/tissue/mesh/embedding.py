"""Surfaces of vessels, nerves and bone carried along by the tissue they lie in.

Each vertex keeps its barycentric coordinates in the tetrahedron that it lies in at rest.

>>> import numpy as np
>>> from us_sim.tissue.mesh.embedding import EmbeddedSurface
>>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
>>> mesh = box_mesh([0.0, 0.1], [0.0, 0.1], [0.0, 0.1])
>>> square = np.array([[0.2, 0.2, 0.5], [0.8, 0.2, 0.5], [0.8, 0.8, 0.5], [0.2, 0.8, 0.5]]) / 10
>>> surface = EmbeddedSurface(mesh, square, np.array([[0, 1, 2], [0, 2, 3]]))
>>> vertices, normals = surface.deform(mesh.nodes * [1.0, 1.0, 0.5])
>>> vertices[:, 2], normals[0]
(array([0.025, 0.025, 0.025, 0.025], dtype=float32), array([0., 0., 1.], dtype=float32))
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError
from us_sim.geometry.normals import vertex_normals
from us_sim.kernels import njit
from us_sim.tissue.mesh.point_location import Location, locate
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh

_REACH = 0.5
"""Distance that a vertex may lie outside the mesh, over the longest edge of the nearest
tetrahedron, whose deformation carries it."""

_ROUNDING = 1e-6
"""Distance from the mesh up to which a vertex counts as within it, m."""


class EmbeddedSurface:
    """Vertices and triangles of a surface, located once, deformed with any state of the mesh.

    Vertices slightly outside the mesh go with the nearest tetrahedron; ``outside`` says how many.

    Args:
        mesh: of the tissue, at rest.
        vertices: (V, 3) m, frame ``patient``, at rest.
        triangles: (T, 3) indices into vertices.

    Raises:
        MeshError: the arrays are no surface, or a vertex is farther outside the mesh than half the
            longest edge of the nearest tetrahedron.
    """

    def __init__(
        self,
        mesh: TetrahedralMesh,
        vertices: NDArray[np.float64],
        triangles: NDArray[np.integer],
    ) -> None:
        vertices, triangles = _checked(vertices, triangles)
        location = locate(mesh, vertices)
        far = _far(mesh, location)
        if far.any():
            worst = int(np.argmax(location.outside))
            raise MeshError(
                f"{far.sum()} of the surface's {len(vertices)} vertices lie outside the tissue "
                f"mesh, vertex {worst} by {location.outside[worst] * 1e3:.1f} mm: move or trim the "
                f"surface, or enlarge the mesh"
            )
        self._keep(mesh, vertices, triangles, location)

    @classmethod
    def trimmed(
        cls,
        mesh: TetrahedralMesh,
        vertices: NDArray[np.float64],
        triangles: NDArray[np.integer],
    ) -> EmbeddedSurface:
        """The part of a surface that the mesh can carry, its vertices renumbered in order.

        Raises:
            MeshError: the arrays are no surface, or no whole triangle of it is in the mesh.
        """
        vertices, triangles = _checked(vertices, triangles)
        location = locate(mesh, vertices)
        inside = triangles[~_far(mesh, location)[triangles].any(axis=1)]
        if not len(inside):
            raise MeshError("the surface lies outside the tissue mesh: move it or the mesh")
        used, renumbered = np.unique(inside, return_inverse=True)
        kept = Location(location.tetrahedra[used], location.weights[used], location.outside[used])
        surface = cls.__new__(cls)
        surface._keep(mesh, vertices[used], renumbered.reshape(-1, 3).astype(np.int32), kept)
        return surface

    def _keep(
        self,
        mesh: TetrahedralMesh,
        vertices: NDArray[np.float64],
        triangles: NDArray[np.int32],
        location: Location,
    ) -> None:
        self.triangles = triangles  # (T, 3) int32
        self.vertices = vertices.astype(np.float32)  # (V, 3) m, at rest
        self.outside = int(np.count_nonzero(location.outside > _ROUNDING))  # of the vertices
        self._rest = mesh.nodes
        self._nodes = np.ascontiguousarray(mesh.tetrahedra[location.tetrahedra])
        self._weights = location.weights.astype(np.float32)

    def deform(
        self, nodes: NDArray[np.floating]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Where the surface is when the mesh's nodes are at ``nodes`` (N, 3), m.

        Returns:
            (V, 3) m vertices and (V, 3) unit normals, as
            `us_sim.geometry.normals.vertex_normals` says.

        Raises:
            MeshError: there are more or fewer nodes than in the mesh.
        """
        vertices = self.carry(nodes)
        return vertices, vertex_normals(vertices, self.triangles)

    def carry(self, nodes: NDArray[np.floating]) -> NDArray[np.float32]:
        """(V, 3) m, the vertices alone.

        Raises:
            MeshError: as `deform`.
        """
        nodes = np.asarray(nodes)
        if nodes.shape != self._rest.shape:
            raise MeshError(
                f"nodes have shape {nodes.shape}: the surface is embedded in a mesh of shape "
                f"{self._rest.shape}"
            )
        # Displacements, not positions, so that float32 rounds what moved and nothing else.
        moved = np.zeros((len(nodes), 4), dtype=np.float32)
        moved[:, :3] = nodes - self._rest
        vertices = np.empty_like(self.vertices)
        _carry(self.vertices, self._nodes, self._weights, moved, vertices)
        return vertices


def _checked(
    vertices: NDArray[np.float64], triangles: NDArray[np.integer]
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    vertices = np.array(vertices, dtype=np.float64, order="C")
    triangles = np.array(triangles, order="C")
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise MeshError(f"surface vertices have shape {vertices.shape}: give (V, 3)")
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if len(bad):
        raise MeshError(
            f"surface vertex {bad[0]} is not finite: {vertices[bad[0]].tolist()}; give numbers"
        )
    if (
        triangles.ndim != 2
        or triangles.shape[1] != 3
        or not len(triangles)
        or not np.issubdtype(triangles.dtype, np.integer)
    ):
        raise MeshError(
            f"surface triangles are {triangles.dtype} of shape {triangles.shape}: give (T, 3) "
            f"integers, T > 0"
        )
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise MeshError(
            f"surface triangles name vertices {triangles.min()} to {triangles.max()}, but there "
            f"are only {len(vertices)}"
        )
    return vertices, triangles.astype(np.int32)


def _far(mesh: TetrahedralMesh, location: Location) -> NDArray[np.bool_]:
    """(V,) whether a vertex is too far outside the mesh to go with it."""
    corners = mesh.nodes[mesh.tetrahedra[location.tetrahedra]]
    sides = corners[:, [0, 0, 0, 1, 1, 2]] - corners[:, [1, 2, 3, 2, 3, 3]]
    longest = np.linalg.norm(sides, axis=2).max(axis=1)
    return location.outside > _REACH * longest


@njit(cache=True, nogil=True, error_model="numpy")
def _carry(rest, nodes, weights, moved, vertices):
    """vertices (V, 3) = rest (V, 3) + the displacements moved (N, 4) of its nodes (V, 4)."""
    for v in range(len(rest)):
        i = nodes[v, 0]
        j = nodes[v, 1]
        k = nodes[v, 2]
        m = nodes[v, 3]
        for x in range(3):
            vertices[v, x] = rest[v, x] + (
                (weights[v, 0] * moved[i, x] + weights[v, 1] * moved[j, x])
                + (weights[v, 2] * moved[k, x] + weights[v, 3] * moved[m, x])
            )
