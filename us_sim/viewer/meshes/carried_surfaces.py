"""Surfaces that the tissue carries: told once, after that they move with the tissue's nodes.

Each vertex is the sum of the four nodes of the tetrahedron in which it lies, in barycentric
weights, which do not change while the tissue deforms. So vessels of forty thousand triangles cost
nothing beyond the nodes that travel for the tissue anyway, and the page computes where they are.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError
from us_sim.tissue.mesh.embedding import locate
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.viewer.meshes.clustering import at_most
from us_sim.viewer.meshes.coloured_surface import ColouredSurface
from us_sim.viewer.packet import Packet

_FARTHEST = 5e-3
"""m: a vertex so far outside the mesh is not of this tissue."""
WHILE_MOVING = 20_000
"""Triangles at most while something moves; all of them when it stands still."""


class CarriedSurfaces:
    """Where every vertex is in the tissue, and which triangles are drawn while it moves.

    Vertices are put in an order in which those that are drawn while something moves come first.

    Args:
        mesh: of the tissue, in the state in which the surfaces are as they are here.
        surfaces: at least one.
        triangles: of all together, at most, while something moves.

    Raises:
        MeshError: a surface is not in the tissue.
    """

    def __init__(
        self,
        mesh: TetrahedralMesh,
        surfaces: Sequence[ColouredSurface],
        triangles: int = WHILE_MOVING,
    ) -> None:
        whole = sum(len(surface.triangles) for surface in surfaces)
        firsts = np.cumsum([0, *(len(surface.vertices) for surface in surfaces)])
        fine = [s.triangles + first for s, first in zip(surfaces, firsts, strict=False)]
        coarse = [
            at_most(s.vertices, s.triangles, int(triangles * len(s.triangles) / whole)) + first
            for s, first in zip(surfaces, firsts, strict=False)
        ]
        first_drawn = np.unique(np.concatenate(coarse))
        rest = np.setdiff1d(np.arange(firsts[-1]), first_drawn)
        order = np.concatenate([first_drawn, rest])
        number = np.empty(len(order), dtype=np.uint32)
        number[order] = np.arange(len(order), dtype=np.uint32)
        vertices = np.concatenate([surface.vertices for surface in surfaces])[order]
        location = locate(mesh, vertices)
        if (location.outside > _FARTHEST).any():
            worst = int(np.argmax(location.outside))
            part = int(np.searchsorted(firsts, order[worst], side="right")) - 1
            raise MeshError(
                f"{surfaces[part].name} is {1e3 * location.outside[worst]:.1f} mm outside the "
                f"tissue, which does not carry it: take both from the same scene"
            )
        #: (V, 4) nodes of the tissue that carry a vertex, and (V, 4) their weights, which sum to 1.
        self.nodes = mesh.tetrahedra[location.tetrahedra].astype(np.uint32)
        self.weights = location.weights.astype(np.float32)
        self.moving = len(first_drawn)  # vertices that are drawn while something moves
        self.fine = [number[part] for part in fine]
        self.coarse = [number[part] for part in coarse]
        self._surfaces = [(surface.name, surface.colour) for surface in surfaces]

    def carried(self, nodes: NDArray[np.floating]) -> NDArray[np.float64]:
        """(V, 3) m, the vertices when the tissue's nodes (N, 3) are there."""
        return np.einsum("va,vax->vx", self.weights, nodes[self.nodes])

    def told(self, kind: str, sequence: int, mesh: int) -> Packet:
        """Nodes as uint32, weights as float32, then each part's triangles, all and fewer.

        Args:
            mesh: the number of the tissue's mesh, whose nodes move them.
        """
        header = {
            "mesh": mesh,
            "vertices": len(self.nodes),
            "moving": self.moving,
            "parts": [
                {"name": name, "colour": list(colour), "fine": len(fine), "coarse": len(coarse)}
                for (name, colour), fine, coarse in zip(
                    self._surfaces, self.fine, self.coarse, strict=True
                )
            ],
        }
        lists = [part for pair in zip(self.fine, self.coarse, strict=True) for part in pair]
        arrays = [self.nodes, self.weights, *lists]
        payload = b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)
        return Packet(kind, sequence, header, payload)
