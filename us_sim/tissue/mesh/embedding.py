"""Points located in a tetrahedral mesh, and surfaces of structures carried along by the tissue.

Each vertex keeps its barycentric coordinates in the tetrahedron that it lies in at rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError
from us_sim.geometry.triangles import compute_vertex_normals
from us_sim.kernels import njit
from us_sim.tissue.elasticity.linear_tetrahedra import shape_gradients
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh

_ROUNDING = 1e-9  # A barycentric coordinate this far below zero is rounding


@dataclass(frozen=True, eq=False)
class MeshLocation:
    """Points in barycentric coordinates of their tetrahedron, or, outside, of the nearest."""

    tetrahedra: NDArray[np.int32]  # (P,)
    weights: NDArray[np.float64]  # (P, 4), barycentric, sum 1; some negative outside the mesh
    outside: NDArray[np.float64]  # (P,) m, distance to the mesh, 0 within it

    def interpolate(self, corners: NDArray[np.float64]) -> NDArray[np.float64]:
        """Interpolate vectors (M, 4, 3) at the corners of tetrahedra; return (P, 3)."""
        return np.asarray(np.einsum("pa,pax->px", self.weights, corners[self.tetrahedra]))


def locate_points(mesh: TetrahedralMesh, points: NDArray[np.float64]) -> MeshLocation:
    """Find each point's tetrahedron, or the one whose face on the boundary is nearest to it.

    Args:
        mesh: at rest.
        points: (P, 3) m.

    Raises:
        MeshError: the points are not (P, 3) finite numbers.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
        raise MeshError(
            f"points of shape {points.shape} cannot be located: give (P, 3) finite ones"
        )
    gradients = shape_gradients(mesh)
    corners = mesh.nodes[mesh.tetrahedra]
    origins = np.ascontiguousarray(corners[:, 0])
    low, high = corners.min(axis=1), corners.max(axis=1)
    lower = low.min(axis=0)
    # About as many cells as tetrahedra, as cubic as the box allows.
    size = high.max(axis=0) - lower
    cells = np.maximum(1, np.minimum(size / (size.prod() / len(corners)) ** (1 / 3), 1000))
    shape = cells.astype(np.int64)
    per_cell = shape / size
    first = _cells(low, lower, per_cell, shape)
    last = _cells(high, lower, per_cell, shape)
    starts, members = _members(first, last, shape)
    within = _cells(points, lower, per_cell, shape)
    tetrahedra = _find(points, within, starts, members, shape, origins, gradients)
    outside = np.zeros(len(points))
    lost = np.flatnonzero(tetrahedra < 0)
    if len(lost):
        faces = mesh.nodes[mesh.boundary]
        sides = faces[:, 1:] - faces[:, :1]
        middles = faces.mean(axis=1)
        radii = np.linalg.norm(faces - middles[:, None], axis=2).max(axis=1)
        nearest, outside[lost] = _nearest_triangle(points[lost], faces, sides, middles, radii)
        tetrahedra[lost] = mesh.boundary_tetrahedra[nearest]
    offset = points - origins[tetrahedra]
    weights = np.einsum("pax,px->pa", gradients[tetrahedra], offset)
    weights[:, 0] += 1.0
    return MeshLocation(tetrahedra, weights, outside)


def _cells(points, lower, per_cell, shape):
    """Return (P, 3), the grid cell of each point, the outermost for those beyond."""
    return np.clip(((points - lower) * per_cell).astype(np.int64), 0, shape - 1)


@njit(cache=True, nogil=True, error_model="numpy")
def _members(first, last, shape):
    """List the tetrahedra that may reach into each cell, cell after cell.

    ``first`` and ``last`` (M, 3) are the lowest and highest cell of each tetrahedron in a grid of
    ``shape``.

    Returns:
        (cells + 1,) the start of each cell's list, and the lists.
    """
    starts = np.zeros(shape[0] * shape[1] * shape[2] + 1, dtype=np.int64)
    for counting in (True, False):
        if not counting:
            for c in range(1, len(starts)):
                starts[c] += starts[c - 1]
            members = np.empty(starts[-1], dtype=np.int32)
            filled = starts[:-1].copy()
        for t in range(len(first)):
            for i in range(first[t, 0], last[t, 0] + 1):
                for j in range(first[t, 1], last[t, 1] + 1):
                    for k in range(first[t, 2], last[t, 2] + 1):
                        cell = (i * shape[1] + j) * shape[2] + k
                        if counting:
                            starts[cell + 1] += 1
                        else:
                            members[filled[cell]] = t
                            filled[cell] += 1
    return starts, members


@njit(cache=True, nogil=True, error_model="numpy")
def _find(points, cells, starts, members, shape, origins, gradients):
    """Return (P,), the tetrahedron that a point is deepest in, -1 where it is in none."""
    found = np.full(len(points), -1, dtype=np.int32)
    for p in range(len(points)):
        cell = (cells[p, 0] * shape[1] + cells[p, 1]) * shape[2] + cells[p, 2]
        best = -_ROUNDING
        for q in range(starts[cell], starts[cell + 1]):
            t = members[q]
            x = points[p, 0] - origins[t, 0]
            y = points[p, 1] - origins[t, 1]
            z = points[p, 2] - origins[t, 2]
            total = 0.0
            smallest = 1.0
            for a in range(1, 4):
                w = gradients[t, a, 0] * x + gradients[t, a, 1] * y + gradients[t, a, 2] * z
                total += w
                smallest = min(smallest, w)
            smallest = min(smallest, 1.0 - total)
            if smallest > best:
                best = smallest
                found[p] = t
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _nearest_triangle(points, faces, sides, middles, radii):
    """Return (P,), the nearest triangle to each of points (P, 3), and (P,) m, its distance.

    Triangles have corners ``faces`` (T, 3, 3) and ``sides`` (T, 2, 3) from the first to the others;
    ``middles`` (T, 3) and ``radii`` (T,) are of a sphere around each.
    """
    nearest = np.zeros(len(points), dtype=np.int64)
    distance = np.empty(len(points))
    for p in range(len(points)):
        best = np.inf
        for t in range(len(faces)):
            x = points[p, 0] - middles[t, 0]
            y = points[p, 1] - middles[t, 1]
            z = points[p, 2] - middles[t, 2]
            # No point of the triangle is nearer than its sphere.
            reach = best + radii[t]
            if x * x + y * y + z * z < reach * reach:
                d = _distance_to_triangle(points[p], faces[t, 0], sides[t, 0], sides[t, 1])
                if d < best:
                    best = d
                    nearest[p] = t
        distance[p] = best
    return nearest, distance


@njit(cache=True, nogil=True, error_model="numpy")
def _distance_to_triangle(p, a, ab, ac):
    """Return the distance, by the region of the plane that p projects to (Ericson 2005, 5.1.5)."""
    d1 = 0.0
    d2 = 0.0
    bb = 0.0
    bc = 0.0
    cc = 0.0
    for x in range(3):
        d1 += ab[x] * (p[x] - a[x])
        d2 += ac[x] * (p[x] - a[x])
        bb += ab[x] * ab[x]
        bc += ab[x] * ac[x]
        cc += ac[x] * ac[x]
    d3 = d1 - bb
    d4 = d2 - bc
    d5 = d1 - bc
    d6 = d2 - cc
    va = d3 * d6 - d5 * d4
    vb = d5 * d2 - d1 * d6
    vc = d1 * d4 - d3 * d2
    # The nearest point is a + s ab + t ac.
    if d1 <= 0.0 and d2 <= 0.0:
        s, t = 0.0, 0.0
    elif d3 >= 0.0 and d4 <= d3:
        s, t = 1.0, 0.0
    elif d6 >= 0.0 and d5 <= d6:
        s, t = 0.0, 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        s, t = d1 / (d1 - d3), 0.0
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        s, t = 0.0, d2 / (d2 - d6)
    elif va <= 0.0 and d4 >= d3 and d5 >= d6:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        s = 1.0 - t
    else:
        s, t = vb / (va + vb + vc), vc / (va + vb + vc)
    square = 0.0
    for x in range(3):
        square += (p[x] - a[x] - s * ab[x] - t * ac[x]) ** 2
    return np.sqrt(square)


# Distance that a vertex may lie outside the mesh, over the longest edge of the nearest
# tetrahedron, whose deformation carries it.
_REACH = 0.5
_WITHIN = 1e-6  # Distance from the mesh up to which a vertex counts as within it, m


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

    Examples:
        >>> import numpy as np
        >>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
        >>> mesh = box_mesh([0.0, 0.1], [0.0, 0.1], [0.0, 0.1])
        >>> square = np.array([[2, 2, 5], [8, 2, 5], [8, 8, 5], [2, 8, 5]]) / 100
        >>> surface = EmbeddedSurface(mesh, square, np.array([[0, 1, 2], [0, 2, 3]]))
        >>> vertices, normals = surface.deform(mesh.nodes * [1.0, 1.0, 0.5])
        >>> vertices[:, 2], normals[0]
        (array([0.025, 0.025, 0.025, 0.025], dtype=float32), array([0., 0., 1.], dtype=float32))
    """

    def __init__(
        self, mesh: TetrahedralMesh, vertices: NDArray[np.float64], triangles: NDArray[np.integer]
    ) -> None:
        vertices, triangles = _check_surface(vertices, triangles)
        location = locate_points(mesh, vertices)
        far = _find_far(mesh, location)
        if far.any():
            worst = int(np.argmax(location.outside))
            raise MeshError(
                f"{far.sum()} of the surface's {len(vertices)} vertices lie outside the tissue "
                f"mesh, vertex {worst} by {location.outside[worst] * 1e3:.1f} mm: move or trim the "
                f"surface, or enlarge the mesh"
            )
        self._keep(mesh, vertices, triangles, location)

    @classmethod
    def embed_trimmed(
        cls, mesh: TetrahedralMesh, vertices: NDArray[np.float64], triangles: NDArray[np.integer]
    ) -> EmbeddedSurface:
        """Embed the part of a surface that the mesh can carry; vertices are renumbered in order.

        Raises:
            MeshError: the arrays are no surface, or no whole triangle of it is in the mesh.
        """
        vertices, triangles = _check_surface(vertices, triangles)
        location = locate_points(mesh, vertices)
        inside = triangles[~_find_far(mesh, location)[triangles].any(axis=1)]
        if not len(inside):
            raise MeshError("the surface lies outside the tissue mesh: move it or the mesh")
        used, renumbered = np.unique(inside, return_inverse=True)
        kept = MeshLocation(
            location.tetrahedra[used], location.weights[used], location.outside[used]
        )
        surface = cls.__new__(cls)
        surface._keep(mesh, vertices[used], renumbered.reshape(-1, 3).astype(np.int32), kept)
        return surface

    def _keep(
        self, mesh: TetrahedralMesh, vertices: NDArray, triangles: NDArray, location: MeshLocation
    ) -> None:
        self.triangles = triangles  # (T, 3) int32
        self.vertices = vertices.astype(np.float32)  # (V, 3) m, at rest
        self.outside = int(np.count_nonzero(location.outside > _WITHIN))  # of the vertices
        self._rest = mesh.nodes
        self._nodes = np.ascontiguousarray(mesh.tetrahedra[location.tetrahedra])
        self._weights = location.weights.astype(np.float32)

    def deform(
        self, nodes: NDArray[np.floating]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Deform the surface with the mesh, whose nodes are at ``nodes`` (N, 3) m.

        Returns:
            (V, 3) m vertices and (V, 3) unit normals, as `compute_vertex_normals` makes them.

        Raises:
            MeshError: there are more or fewer nodes than in the mesh.
        """
        vertices = self.deform_vertices(nodes)
        return vertices, compute_vertex_normals(vertices, self.triangles)

    def deform_vertices(self, nodes: NDArray[np.floating]) -> NDArray[np.float32]:
        """Return (V, 3) m, the deformed vertices alone.

        Raises:
            MeshError: as `deform`.
        """
        nodes = np.asarray(nodes)
        if nodes.shape != self._rest.shape:
            raise MeshError(
                f"nodes have shape {nodes.shape}: the surface is embedded in a mesh of shape "
                f"{self._rest.shape}"
            )
        # Displacements, not positions, so that float32 rounds only the movement.
        moved = np.zeros((len(nodes), 4), dtype=np.float32)
        moved[:, :3] = nodes - self._rest
        vertices = np.empty_like(self.vertices)
        _carry(self.vertices, self._nodes, self._weights, moved, vertices)
        return vertices


def _check_surface(vertices: NDArray, triangles: NDArray) -> tuple[NDArray, NDArray]:
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


def _find_far(mesh: TetrahedralMesh, location: MeshLocation) -> NDArray[np.bool_]:
    """Return (V,), whether a vertex is too far outside the mesh to go with it."""
    corners = mesh.nodes[mesh.tetrahedra[location.tetrahedra]]
    sides = corners[:, [0, 0, 0, 1, 1, 2]] - corners[:, [1, 2, 3, 2, 3, 3]]
    longest = np.linalg.norm(sides, axis=2).max(axis=1)
    return location.outside > _REACH * longest


@njit(cache=True, nogil=True, error_model="numpy")
def _carry(rest, nodes, weights, moved, vertices):
    """Set vertices (V, 3) to rest (V, 3) + the displacements moved (N, 4) of nodes (V, 4)."""
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
