"""Vessels, nerves and bone of a session in which nobody recorded them.

They follow from what is recorded: the scene names them, and the tissue's nodes carry them.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rerun

from us_sim.nodes.conversions import tetrahedra_from, vectors_from
from us_sim.recording.attached import extract
from us_sim.recording.reader import Bag
from us_sim.scene.building import structures_of, volume_of
from us_sim.scene.reading import load_scene
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.to_rerun.rerun_file import RerunFile

REST, TETRAHEDRA = "/tissue/rest", "/tissue/tetrahedra"
STRUCTURES = "tissue/structures"
"""The entity that holds one for each."""
_TRIANGLES = 6_000


class Structures:
    """The structures of the scene that is attached to a session.

    Args:
        bag: the session, with the tissue's mesh.
        progress: called with the fraction of the volume that is made, and what is being made.

    Raises:
        UsSimError: there is no scene attached, its volume cannot be read, or the mesh is none.
    """

    def __init__(self, bag: Bag, progress: Callable[[float, str], None]) -> None:
        self._shown = False
        self._made = []
        with tempfile.TemporaryDirectory() as folder:
            extract(bag.path, Path(folder))
            scene = load_scene(Path(folder, "scene.yaml"))
            if scene.structures:
                found = {
                    each.topic: bag.deserialize(each) for each in bag.messages([REST, TETRAHEDRA])
                }
                mesh = TetrahedralMesh(
                    vectors_from(found[REST], "patient"), tetrahedra_from(found[TETRAHEDRA])
                )
                volume = volume_of(scene, progress)
                self._made = list(structures_of(scene, volume, mesh, _TRIANGLES))

    def take(self, _: str, message: Any, file: RerunFile) -> None:
        """Log where the tissue's nodes have carried the structures."""
        nodes = vectors_from(message, "patient")
        for structure in self._made:
            entity = f"{STRUCTURES}/{structure.name}"
            if not self._shown:
                file.place(entity, "patient")
                colour = [round(255 * channel) for channel in structure.colour]
                triangles = structure.surface.triangles
                shape = rerun.Mesh3D.from_fields(triangle_indices=triangles, albedo_factor=colour)
                file.log(entity, shape)
            vertices, normals = structure.surface.deform(nodes)
            shape = rerun.Mesh3D.from_fields(vertex_positions=vertices, vertex_normals=normals)
            file.log(entity, shape)
        self._shown = True
