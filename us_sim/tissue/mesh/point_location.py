"""Location of points in a tetrahedral mesh, and their distance from it outside.

>>> import numpy as np
>>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
>>> from us_sim.tissue.mesh.point_location import locate
>>> mesh = box_mesh([0.0, 0.1], [0.0, 0.1], [0.0, 0.1])
>>> where = locate(mesh, np.array([[0.05, 0.05, 0.05], [0.05, 0.05, -0.02]]))
>>> where.outside
array([0.  , 0.02])
>>> corners = mesh.nodes[mesh.tetrahedra[where.tetrahedra]]
>>> np.einsum("pa,pax->px", where.weights, corners).round(9) + 0.0
array([[ 0.05,  0.05,  0.05], [ 0.05,  0.05, -0.02]])
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError
from us_sim.kernels import njit
from us_sim.tissue.elasticity.linear_tetrahedra import shape_gradients
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh

_ROUNDING = 1e-9
"""A barycentric coordinate this far below zero is rounding."""


@dataclass(frozen=True, eq=False)
class Location:
    """Points in barycentric coordinates of their tetrahedron, or, outside, of the nearest."""

    tetrahedra: NDArray[np.int32]  # (P,)
    weights: NDArray[np.float64]  # (P, 4), barycentric, sum 1; some negative outside the mesh
    outside: NDArray[np.float64]  # (P,) m, distance to the mesh, 0 within it


def locate(mesh: TetrahedralMesh, points: NDArray[np.float64]) -> Location:
    """Find each point's tetrahedron, or the one whose face on the boundary is nearest to it.

    Args:
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
    return Location(tetrahedra, weights, outside)


def _cells(points, lower, per_cell, shape):
    """(P, 3) the grid cell of each point, the outermost for those beyond."""
    return np.clip(((points - lower) * per_cell).astype(np.int64), 0, shape - 1)


@njit(cache=True, nogil=True, error_model="numpy")
def _members(first, last, shape):
    """The tetrahedra that may reach into each cell, as lists one after the other.

    Args:
        first, last: (M, 3) the lowest and highest cell of each tetrahedron.
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
    """(P,) the tetrahedron that a point is deepest in, -1 where it is in none."""
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
    """(P,) the nearest triangle to each of points (P, 3), and (P,) its distance.

    Args:
        faces: (T, 3, 3) corners. sides: (T, 2, 3) from the first to the others.
        middles, radii: (T, 3) and (T,) of a sphere around each.
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
    """By the region of the triangle's plane that p projects to (Ericson 2005, 5.1.5)."""
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
