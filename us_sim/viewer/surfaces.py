"""Surfaces for a page: sent once at rest, after which only positions travel.

>>> import numpy as np
>>> from us_sim.viewer.surfaces import StreamedSurface, weld_corners
>>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 0, 0], [1, 1, 0], [0, 1, 0]])
>>> vertices, triangles = weld_corners(corners)
>>> len(vertices), triangles
(4, array([[0, 1, 3], [0, 3, 2]]))
>>> surface = StreamedSurface(vertices, triangles)
>>> packet = surface.make_packet(vertices + [0, 0, 0.001], kind="skin", sequence=1, stamp=0)
>>> packet.header["resolution"], len(packet.payload)
(1e-06, 24)
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.viewer.stream import Packet

FINEST = 1e-6
"""m, smallest step of positions: int16 steps reach 33 mm, in half the bytes of single precision."""


@dataclass(frozen=True, eq=False)
class ColouredSurface:
    """A surface with its name and colour."""

    name: str
    colour: tuple[float, float, float]  # red, green, blue, 0 to 1
    vertices: NDArray[np.float64]  # (V, 3) m
    triangles: NDArray[np.integer]  # (T, 3)


def weld_corners(corners: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Merge equal corners to vertices (V, 3) and triangles (T, 3); drop triangles without an area.

    Args:
        corners: (3 T, 3) m, three of each triangle in a row.
    """
    order = np.lexsort(corners.T)  # a seventh of the time of `numpy.unique`
    ordered = corners[order]
    is_new = np.insert((ordered[1:] != ordered[:-1]).any(axis=1), 0, values=True)
    numbers = np.empty(len(corners), dtype=np.intp)
    numbers[order] = np.cumsum(is_new) - 1
    return ordered[is_new], _drop_flat(numbers.reshape(-1, 3))


def cluster_vertices(
    vertices: NDArray[np.floating], triangles: NDArray[np.integer], cell: float
) -> NDArray[np.integer]:
    """Merge the vertices in each cell (m) of a grid into one; return the triangles left, (F, 3).

    Vertex clustering after J. Rossignac and P. Borrel, "Multi-resolution 3D approximations for
    rendering complex scenes", 1993. All vertices are ones of the surface, so they also serve a
    deformed state. A closed surface stays closed: a sum of oriented triangles without a border.
    Vertices are (V, 3) m, and triangles (T, 3).
    """
    used, corners = np.unique(triangles, return_inverse=True)
    points = vertices[used]
    grid = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    _, first, cells = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    return _drop_flat(used[first][cells.ravel()][corners.ravel()].reshape(-1, 3))


def simplify_surface(
    vertices: NDArray[np.floating], triangles: NDArray[np.integer], count: int
) -> NDArray[np.integer]:
    """Reduce a surface, (V, 3) m and (T, 3), to ``count`` triangles or somewhat fewer."""
    sides = vertices[triangles] - vertices[np.roll(triangles, 1, axis=1)]
    cell, fewer = 0.5 * float(np.linalg.norm(sides, axis=2).mean()), triangles
    while len(fewer) > count:
        fewer = cluster_vertices(vertices, triangles, cell)
        cell *= 1.15
    return fewer


def _drop_flat(triangles: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the triangles of three different vertices."""
    return triangles[(triangles != np.roll(triangles, 1, axis=1)).all(axis=1)]


class StreamedSurface:
    """Points at rest with their triangles and edges, and packets of their later positions.

    Args:
        points: (N, 3) m, at rest.
        triangles: (T, 3) indices into points.
        edges: (E, 2) indices into points, of lines to draw.
    """

    def __init__(
        self,
        points: NDArray[np.floating],
        triangles: NDArray[np.integer],
        edges: NDArray[np.integer] | None = None,
    ) -> None:
        lines = np.zeros((0, 2), dtype=np.uint32) if edges is None else edges
        #: (N, 3) m, as the page has them: in single precision.
        self.points = np.ascontiguousarray(points, dtype=np.float32)
        self._triangles = np.ascontiguousarray(triangles, dtype=np.uint32)
        self._edges = np.ascontiguousarray(lines, dtype=np.uint32)
        parts = (self.points, self._triangles, self._edges)
        self._payload = b"".join(part.tobytes() for part in parts)
        #: Checksum by which packets name the surface that they move.
        self.number = zlib.crc32(self._payload)

    @classmethod
    def from_mesh(cls, mesh: TetrahedralMesh) -> StreamedSurface:
        """Make a surface of all nodes of a mesh, its outer faces, and their edges."""
        faces = mesh.boundary
        edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        return cls(mesh.nodes, faces, np.unique(edges, axis=0))

    def make_rest_packet(self, kind: str, sequence: int) -> Packet:
        """Make the packet of the rest: points as float32, then triangles and edges as uint32."""
        header = {
            "mesh": self.number,
            "points": len(self.points),
            "triangles": len(self._triangles),
            "edges": len(self._edges),
        }
        return Packet(kind, sequence, header, self._payload)

    def make_packet(
        self, positions: NDArray[np.floating], *, kind: str, sequence: int, stamp: int
    ) -> Packet:
        """Make the packet of positions (N, 3), m, at a stamp, ns, as int16 steps from rest.

        Raises:
            MeshError: there are more or fewer points than at rest.
        """
        if positions.shape != self.points.shape:
            raise MeshError(
                f"{len(positions)} points came, and the mesh has {len(self.points)}: start all "
                f"nodes with the same scene"
            )
        offsets = np.subtract(positions, self.points, dtype=np.float64)
        farthest = float(np.abs(offsets).max(initial=0.0))
        resolution = FINEST * max(1, math.ceil(farthest / (FINEST * np.iinfo(np.int16).max)))
        header = {
            "stamp": str(stamp),  # more digits than a number of JavaScript has
            "mesh": self.number,
            "points": len(self.points),
            "resolution": resolution,
        }
        steps = np.rint(offsets / resolution).astype(np.int16)
        return Packet(kind, sequence, header, steps.tobytes())


class CarriedSurfaces:
    """Surfaces that move with the tissue's nodes.

    A vertex is the barycentric sum of the four nodes of its tetrahedron, and its weights do not
    change while the tissue deforms. So the page moves vessels of forty thousand triangles with the
    nodes that it gets for the tissue anyway. The vertices of the coarse triangles come first: the
    page draws only these while something moves.

    Args:
        mesh: of the tissue, in the same state as the surfaces.
        surfaces: at least one.
        triangles: largest number of coarse triangles of all surfaces together.

    Raises:
        MeshError: a surface is not in the tissue.
    """

    def __init__(
        self, mesh: TetrahedralMesh, surfaces: Sequence[ColouredSurface], triangles: int = 20_000
    ) -> None:
        from us_sim.tissue.mesh.embedding import locate_points  # with its kernels

        whole = sum(len(surface.triangles) for surface in surfaces)
        firsts = np.cumsum([0, *(len(surface.vertices) for surface in surfaces)])
        fine = [s.triangles + first for s, first in zip(surfaces, firsts, strict=False)]
        coarse = [
            simplify_surface(s.vertices, s.triangles, int(triangles * len(s.triangles) / whole))
            + first
            for s, first in zip(surfaces, firsts, strict=False)
        ]
        first_drawn = np.unique(np.concatenate(coarse))
        rest = np.setdiff1d(np.arange(firsts[-1]), first_drawn)
        order = np.concatenate([first_drawn, rest])
        number = np.empty(len(order), dtype=np.uint32)
        number[order] = np.arange(len(order), dtype=np.uint32)
        vertices = np.concatenate([surface.vertices for surface in surfaces])[order]
        location = locate_points(mesh, vertices)
        if (location.outside > 5e-3).any():
            worst = int(np.argmax(location.outside))
            part = int(np.searchsorted(firsts, order[worst], side="right")) - 1
            raise MeshError(
                f"{surfaces[part].name} is {1e3 * location.outside[worst]:.1f} mm outside the "
                f"tissue, which does not carry it: take both from the same scene"
            )
        #: (V, 4) nodes of the tissue that carry a vertex, and (V, 4) their weights, which sum to 1.
        self.nodes = mesh.tetrahedra[location.tetrahedra].astype(np.uint32)
        self.weights = location.weights.astype(np.float32)
        self.moving = len(first_drawn)  # number of vertices of the coarse triangles
        self.fine = [number[part] for part in fine]
        self.coarse = [number[part] for part in coarse]
        self._surfaces = [(surface.name, surface.colour) for surface in surfaces]

    def make_rest_packet(self, kind: str, sequence: int, mesh: int) -> Packet:
        """Make a packet of nodes (uint32), weights (float32), and triangles, fine and coarse.

        ``mesh`` is the number of the tissue's mesh, whose nodes move the surfaces.
        """
        parts = [
            {"name": name, "colour": list(colour), "fine": len(fine), "coarse": len(coarse)}
            for (name, colour), fine, coarse in zip(
                self._surfaces, self.fine, self.coarse, strict=True
            )
        ]
        header = {"mesh": mesh, "vertices": len(self.nodes), "moving": self.moving, "parts": parts}
        lists = [part for pair in zip(self.fine, self.coarse, strict=True) for part in pair]
        payload = b"".join(array.tobytes() for array in (self.nodes, self.weights, *lists))
        return Packet(kind, sequence, header, payload)


def make_transducer_packet(
    kind: str, sequence: int, parts: Sequence[ColouredSurface], outline: NDArray[np.floating]
) -> Packet:
    """Make a packet of each part's vertices (float32) and triangles (uint32), then the outline.

    Parts are in frame ``probe``; the outline (P, 3), m, is that of
    `us_sim.slicing.probe.probe.compute_image_outline`.
    """
    described, arrays = [], list[NDArray[np.generic]]()
    for part in parts:
        sizes = {"vertices": len(part.vertices), "triangles": len(part.triangles)}
        described.append({"name": part.name, "colour": list(part.colour), **sizes})
        arrays += [part.vertices.astype(np.float32), part.triangles.astype(np.uint32)]
    payload = b"".join(array.tobytes() for array in (*arrays, outline.astype(np.float32)))
    return Packet(kind, sequence, {"parts": described, "outline": len(outline)}, payload)


class EquivalentStrain:
    """Equivalent (von Mises) strain of the states of one mesh, at its nodes.

    The strain is sqrt(2/3 e : e) with e the deviator of the Green-Lagrange strain: to first order
    the elongation in uniaxial stretch at constant volume (Holzapfel, *Nonlinear Solid Mechanics*,
    2000). A node has the mean of its tetrahedra, weighted by their volumes at rest.
    """

    def __init__(self, mesh: TetrahedralMesh) -> None:
        corners = mesh.nodes[mesh.tetrahedra]
        self._tetrahedra = mesh.tetrahedra
        self._inverse = np.linalg.inv(corners[:, 1:] - corners[:, :1])  # (M, 3, 3)
        self._volumes = mesh.volumes
        self._around = np.bincount(
            mesh.tetrahedra.ravel(), np.repeat(mesh.volumes, 4), minlength=len(mesh.nodes)
        )

    def compute_strain(self, nodes: NDArray[np.floating]) -> NDArray[np.float64]:
        """Compute the strain (N,) with the mesh's nodes at (N, 3) m."""
        corners = nodes[self._tetrahedra]
        gradient = self._inverse @ (corners[:, 1:] - corners[:, :1])  # the transpose of F
        strain = 0.5 * (gradient @ gradient.transpose(0, 2, 1) - np.eye(3))
        strain -= np.trace(strain, axis1=1, axis2=2)[:, None, None] / 3.0 * np.eye(3)
        equivalent = np.sqrt(2.0 / 3.0 * np.einsum("mij,mij->m", strain, strain))
        weighted = np.repeat(self._volumes * equivalent, 4)
        summed = np.bincount(self._tetrahedra.ravel(), weighted, minlength=len(nodes))
        return summed / self._around
