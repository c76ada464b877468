"""A closed surface of triangles with its volume, area, parts and genus.

trimesh calls two tetrahedra that share one corner watertight, which a mesh of tetrahedra cannot be
filled into.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


@dataclass(frozen=True, eq=False)
class ClosedSurface:
    """Vertices and triangles; `fault` says whether they close and are wound alike.

    >>> corners = np.array([[0.0, 0, 0], [3, 0, 0], [0, 3, 0], [0, 0, 3]])
    >>> faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    >>> tetrahedron = ClosedSurface(corners, faces)
    >>> tetrahedron.volume, tetrahedron.parts, tetrahedron.genus, tetrahedron.fault
    (4.5, 1, 0, '')
    """

    vertices: NDArray[np.float64]  # (V, 3) m, frame patient
    triangles: NDArray[np.int32]  # (T, 3), counter-clockwise seen from outside

    @cached_property
    def volume(self) -> float:
        """m³ inside, by Gauss's theorem; below zero where the triangles face inwards."""
        a, b, c = (self.vertices - self.vertices.mean(axis=0))[self.triangles.T]
        return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6.0

    @cached_property
    def crosses(self) -> NDArray[np.float64]:
        """(T, 3) m², normals of the triangles, twice as long as their areas."""
        a, b, c = self.vertices[self.triangles.T]
        return np.cross(b - a, c - a)

    @cached_property
    def area(self) -> float:
        """m²."""
        return float(np.linalg.norm(self.crosses, axis=1).sum()) / 2.0

    @property
    def half_edges(self) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Starts and ends (3 T,) of the triangles' edges, in the direction that they run."""
        return self.triangles.T.ravel(), np.roll(self.triangles, -1, axis=1).T.ravel()

    @cached_property
    def parts(self) -> int:
        """Number of pieces that share no vertex."""
        return _count_parts(*self.half_edges, len(self.vertices))

    @cached_property
    def genus(self) -> int:
        """Number of handles of all parts, by Euler's formula V - E + F = 2 (parts - genus).

        It holds for a surface without `fault`: each of its edges has two triangles.
        """
        euler = len(self.vertices) - len(self.triangles) * 3 // 2 + len(self.triangles)
        return self.parts - euler // 2

    @cached_property
    def fault(self) -> str:
        """Why it is no closed surface whose triangles all face the same way; empty where it is.

        Every edge must have two triangles, which run along it in opposite directions, and the
        triangles around a vertex must form one fan; every vertex must have some.
        """
        starts, ends = self.half_edges
        there = np.sort(starts.astype(np.int64) * len(self.vertices) + ends)
        back = np.sort(ends.astype(np.int64) * len(self.vertices) + starts)
        if (there[1:] == there[:-1]).any():
            return "an edge has several triangles that run along it the same way"
        if not np.array_equal(there, back):
            return "an edge has a triangle on one side only"
        if len(np.unique(self.triangles)) < len(self.vertices):
            return "a vertex is in no triangle"
        # Half-edge h has its start's corner; its opposite half-edge's successor starts at the same
        # vertex, in the next triangle of the fan.
        count = len(starts)
        opposite = np.empty(count, dtype=np.int64)
        opposite[np.lexsort((ends, starts))] = np.lexsort((starts, ends))
        following = (opposite + len(self.triangles)) % count
        if _count_parts(np.arange(count), following, count) > len(self.vertices):
            return "it touches itself at a vertex"
        return ""


def _count_parts(starts: NDArray[np.integer], ends: NDArray[np.integer], vertices: int) -> int:
    """Count the parts of a graph of so many vertices by its edges' starts and ends."""
    edges = coo_array((np.ones(len(starts)), (starts, ends)), shape=(vertices, vertices))
    return int(connected_components(edges, directed=False)[0])
