"""A closed surface of triangles with its volume, area and parts, and its STL file."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from us_sim.volume.partial_file import partial_file

_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


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


def write_stl(path: Path, surface: ClosedSurface) -> None:
    """Write a surface to a binary file in millimetres; one of that name is replaced.

    Its header says that the axes are left, posterior and superior (``SPACE=LPS``), which 3D Slicer
    looks for; meshio writes no such header.

    Raises:
        VolumeError: the file cannot be written.
    """
    facets = np.zeros(len(surface.triangles), _FACET)
    lengths = np.linalg.norm(surface.crosses, axis=1, keepdims=True)
    facets["normal"] = surface.crosses / np.maximum(lengths, 1e-30)
    facets["corners"] = 1e3 * surface.vertices[surface.triangles]
    header = b"us_sim; millimetres; SPACE=LPS".ljust(80)
    with partial_file(path) as partial:
        partial.write_bytes(header + np.uint32(len(facets)).tobytes() + facets.tobytes())
