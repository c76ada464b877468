"""A closed surface of triangles with its volume, area, parts and genus.

trimesh was tried for these: it calls two tetrahedra that share one corner watertight, which a mesh
of tetrahedra cannot be filled into, and does not say what is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from us_sim.errors import VolumeError


@dataclass(frozen=True, eq=False)
class ClosedSurface:
    """Vertices and triangles; `fault` says whether they close and are wound alike.

    >>> corners = np.array([[0.0, 0, 0], [3, 0, 0], [0, 3, 0], [0, 0, 3]])
    >>> faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    >>> tetrahedron = ClosedSurface(corners, faces)
    >>> tetrahedron.volume, tetrahedron.parts, tetrahedron.genus, tetrahedron.fault
    (4.5, 1, 0, '')

    Raises:
        VolumeError: the arrays have other shapes, a vertex is not finite, or a triangle names a
            vertex that there is not.
    """

    vertices: NDArray[np.float64]  # (V, 3) m, frame patient
    triangles: NDArray[np.int32]  # (T, 3), counter-clockwise seen from outside

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices, dtype=np.float64)
        triangles = np.ascontiguousarray(self.triangles, dtype=np.int32)
        if vertices.shape[1:] != (3,) or triangles.shape[1:] != (3,) or not len(triangles):
            raise VolumeError(
                f"a surface needs vertices (V, 3) and one triangle (T, 3) or more, not "
                f"{vertices.shape} and {triangles.shape}"
            )
        if not np.isfinite(vertices).all():
            raise VolumeError("a vertex of the surface is not finite")
        if triangles.min() < 0 or triangles.max() >= len(vertices):
            raise VolumeError("a triangle of the surface names a vertex that there is not")
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "triangles", triangles)

    def moved_to(self, vertices: NDArray[np.float64]) -> ClosedSurface:
        """The same triangles with their vertices (V, 3) elsewhere."""
        return ClosedSurface(vertices, self.triangles)

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
        starts, ends = self.half_edges
        count = len(self.vertices)
        edges = coo_array((np.ones(len(starts)), (starts, ends)), shape=(count, count))
        return int(connected_components(edges, directed=False)[0])

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
        if twice := int(np.count_nonzero(there[1:] == there[:-1])):
            return f"{twice} edges have several triangles that run along them the same way"
        if not np.array_equal(there, back):
            alone = np.count_nonzero(~np.isin(there, back, assume_unique=True))
            edges = (len(there) + alone) // 2
            return f"{alone} of its {edges} edges have a triangle on one side only"
        if unused := len(self.vertices) - len(np.unique(self.triangles)):
            return f"{unused} vertices are in no triangle"
        if pinched := self._fans - len(self.vertices):
            return f"it touches itself at {pinched} vertices"
        return ""

    @property
    def _fans(self) -> int:
        """Number of fans of triangles around vertices, where every edge has two triangles.

        Half-edge h has its start's corner; its opposite half-edge's successor starts at the same
        vertex, in the next triangle of the fan.
        """
        starts, ends = self.half_edges
        count = len(self.triangles)
        opposite = np.empty(3 * count, dtype=np.int64)
        opposite[np.lexsort((ends, starts))] = np.lexsort((starts, ends))
        following = (opposite + count) % (3 * count)
        steps = coo_array((np.ones(3 * count), (np.arange(3 * count), following)))
        return int(connected_components(steps, directed=False)[0])
