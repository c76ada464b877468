"""The skin: a mesh at rest, whose vertices move."""

from __future__ import annotations

from typing import Any

import numpy as np
import rerun
from numpy.typing import NDArray

from us_sim.errors import MeshError
from us_sim.geometry.triangles import vertex_normals
from us_sim.nodes.conversions import mesh_from, vectors_from
from us_sim.to_rerun.rerun_file import RerunFile

SKIN = "skin"
"""Its entity."""
_COLOUR = (217, 166, 140, 90)


class Skin:
    """``skin/mesh`` and ``skin/nodes`` as one mesh that deforms."""

    def __init__(self) -> None:
        self._triangles: NDArray[np.int64] | None = None
        self._is_there = False

    def take(self, entity: str, message: Any, file: RerunFile) -> None:
        """Remember the triangles, or log where the vertices are."""
        if entity == f"{SKIN}/mesh":
            self._triangles = mesh_from(message)[1]
            return
        if self._triangles is None:
            raise MeshError("the skin's triangles on /skin/mesh are missing")
        vertices = vectors_from(message)
        if len(self._triangles) and self._triangles.max() >= len(vertices):
            raise MeshError(
                f"the skin has {len(vertices)} vertices, and a triangle of /skin/mesh names vertex "
                f"{self._triangles.max()}"
            )
        file.place(SKIN, message.header.frame_id)
        if not self._is_there:
            mesh = rerun.Mesh3D.from_fields(triangle_indices=self._triangles, albedo_factor=_COLOUR)
            file.log(SKIN, mesh)
            self._is_there = True
        normals = vertex_normals(vertices, self._triangles)
        file.log(SKIN, rerun.Mesh3D.from_fields(vertex_positions=vertices, vertex_normals=normals))
