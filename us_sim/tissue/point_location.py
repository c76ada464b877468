"""Where points lie in a tetrahedral mesh, or how far outside it.

>>> import numpy as np
>>> from us_sim.tissue.mesh import box_mesh
>>> from us_sim.tissue.point_location import locate
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
from numba import njit
from numpy.typing import NDArray

from us_sim.errors import MeshError
from us_sim.tissue.elasticity import shape_gradients
from us_sim.tissue.mesh import TetrahedralMesh

__all__ = ["Location", "locate"]

# A barycentric coordinate this far below zero is rounding.
_ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Location:
    """Points within tetrahedra; those outside the mesh are given in the nearest one."""

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
        a, b, c = (np.ascontiguousarray(mesh.nodes[mesh.boundary[:, i]]) for i in range(3))
        nearest, outside[lost] = _nearest_triangle(points[lost], a, b, c)
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
def _nearest_triangle(points, a, b, c):
    """(P,) the nearest of the triangles a, b, c (T, 3) to each point, and (P,) its distance."""
    middles = (a + b + c) / 3
    radii = np.empty(len(a))
    for t in range(len(a)):
        radii[t] = np.sqrt(
            max(
                np.sum((a[t] - middles[t]) ** 2),
                np.sum((b[t] - middles[t]) ** 2),
                np.sum((c[t] - middles[t]) ** 2),
            )
        )
    nearest = np.zeros(len(points), dtype=np.int64)
    distance = np.empty(len(points))
    for p in range(len(points)):
        best = np.inf
        for t in range(len(a)):
            x = points[p, 0] - middles[t, 0]
            y = points[p, 1] - middles[t, 1]
            z = points[p, 2] - middles[t, 2]
            # No point of the triangle is nearer than its bounding sphere.
            reach = best + radii[t]
            if x * x + y * y + z * z < reach * reach:
                d = _distance_to_triangle(points[p], a[t], b[t], c[t])
                if d < best:
                    best = d
                    nearest[p] = t
        distance[p] = best
    return nearest, distance


@njit(cache=True, nogil=True, error_model="numpy")
def _distance_to_triangle(p, a, b, c):
    """By the region of the triangle's plane that p projects to (Ericson 2005, 5.1.5)."""
    ab = b - a
    ac = c - a
    d1 = np.sum(ab * (p - a))
    d2 = np.sum(ac * (p - a))
    if d1 <= 0.0 and d2 <= 0.0:
        return np.sqrt(np.sum((p - a) ** 2))
    d3 = np.sum(ab * (p - b))
    d4 = np.sum(ac * (p - b))
    if d3 >= 0.0 and d4 <= d3:
        return np.sqrt(np.sum((p - b) ** 2))
    d5 = np.sum(ab * (p - c))
    d6 = np.sum(ac * (p - c))
    if d6 >= 0.0 and d5 <= d6:
        return np.sqrt(np.sum((p - c) ** 2))
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return np.sqrt(np.sum((p - a - d1 / (d1 - d3) * ab) ** 2))
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return np.sqrt(np.sum((p - a - d2 / (d2 - d6) * ac) ** 2))
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 >= d3 and d5 >= d6:
        return np.sqrt(np.sum((p - b - (d4 - d3) / ((d4 - d3) + (d5 - d6)) * (c - b)) ** 2))
    total = va + vb + vc
    return np.sqrt(np.sum((p - a - vb / total * ab - vc / total * ac) ** 2))
