"""A surface whose triangles are told once, and of which only positions travel after that.

>>> import numpy as np
>>> from us_sim.viewer.meshes.rest_surface import RestSurface
>>> square = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]])
>>> surface = RestSurface(square, np.array([[0, 1, 2], [0, 2, 3]]))
>>> packet = surface.moved(square + [0, 0, 0.001], kind="skin", sequence=1, stamp=0)
>>> packet.header["resolution"], len(packet.payload)
(1e-06, 24)
"""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.viewer.meshes.offsets import Offsets
from us_sim.viewer.packet import Packet


class RestSurface:
    """Points at rest with their triangles and edges, and packets of where they are later.

    Args:
        points: (N, 3) m, at rest.
        triangles: (T, 3) indices into points.
        edges: (E, 2) likewise, of lines to draw.

    Raises:
        MeshError: an index is of no point, a coordinate is not finite, or the shapes are wrong.
    """

    def __init__(
        self,
        points: NDArray[np.floating],
        triangles: NDArray[np.integer],
        edges: NDArray[np.integer] | None = None,
    ) -> None:
        lines = np.zeros((0, 2), dtype=np.uint32) if edges is None else edges
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise MeshError(f"points of shape {points.shape} are no (N, 3) finite positions")
        for name, indices, corners in (("triangle", triangles, 3), ("edge", lines, 2)):
            if indices.ndim != 2 or indices.shape[1] != corners:
                raise MeshError(f"{name}s have shape {indices.shape}: give (…, {corners})")
            if indices.size and not 0 <= indices.min() <= indices.max() < len(points):
                raise MeshError(
                    f"a {name} names point {indices.max()}, but there are only {len(points)}"
                )
        #: (N, 3) m, as the page has them: in single precision.
        self.points = np.ascontiguousarray(points, dtype=np.float32)
        self._triangles = np.ascontiguousarray(triangles, dtype=np.uint32)
        self._edges = np.ascontiguousarray(lines, dtype=np.uint32)
        parts = (self.points, self._triangles, self._edges)
        self._payload = b"".join(part.tobytes() for part in parts)
        #: By which packets name the surface that they move.
        self.number = zlib.crc32(self._payload)

    @classmethod
    def around(cls, mesh: TetrahedralMesh) -> RestSurface:
        """All nodes of a mesh with its outer faces, and their edges, each once."""
        faces = mesh.boundary
        edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
        return cls(mesh.nodes, faces, np.unique(edges, axis=0))

    def told(self, kind: str, sequence: int) -> Packet:
        """All of it at rest: points as float32, then triangles and edges as uint32."""
        header = {
            "mesh": self.number,
            "points": len(self.points),
            "triangles": len(self._triangles),
            "edges": len(self._edges),
        }
        return Packet(kind, sequence, header, self._payload)

    def moved(
        self, positions: NDArray[np.floating], *, kind: str, sequence: int, stamp: int
    ) -> Packet:
        """Where the points are now (N, 3) m, as int16 steps from rest; ``stamp`` in ns.

        Raises:
            MeshError: there are more or fewer than at rest.
        """
        if positions.shape != self.points.shape:
            raise MeshError(
                f"{len(positions)} points came, and the mesh has {len(self.points)}: start all "
                f"nodes with the same scene"
            )
        offsets = Offsets.between(positions, self.points)
        header = {
            "stamp": str(stamp),  # more digits than a number of JavaScript has
            "mesh": self.number,
            "points": len(self.points),
            "resolution": offsets.resolution,
        }
        return Packet(kind, sequence, header, offsets.steps.tobytes())
