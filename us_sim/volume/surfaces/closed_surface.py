"""A closed surface of triangles with its volume, area and parts."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


@dataclass(frozen=True, eq=False)
class ClosedSurface:
    """Vertices and triangles.

    >>> corners = np.array([[0.0, 0, 0], [3, 0, 0], [0, 3, 0], [0, 0, 3]])
    >>> faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    >>> tetrahedron = ClosedSurface(corners, faces)
    >>> tetrahedron.volume, tetrahedron.parts
    (4.5, 1)
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

    @cached_property
    def parts(self) -> int:
        """Number of pieces that share no vertex."""
        edges = self.triangles.ravel(), np.roll(self.triangles, -1, axis=1).ravel()
        count = len(self.vertices)
        joined = coo_array((np.ones(len(edges[0])), edges), shape=(count, count))
        return int(connected_components(joined, directed=False)[0])
