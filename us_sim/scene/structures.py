"""The vessels, nerves and bones that a scene names, as surfaces that its tissue carries.

>>> from us_sim.scene.reading import parse_scene
>>> from us_sim.scene.structures import colour_of
>>> scene = parse_scene({
...     "name": "arm", "volume": {"phantom": "upper_arm"}, "structures": ["vein"],
...     "probe": {"aperture": "4 cm", "depth": "4 cm",
...               "collider": {"shape": "sphere", "radius": "2 cm"}},
...     "tissue": {"mesh": {"lower": [-0.03, -0.03, 0], "upper": [0.03, 0.03, 0.05]},
...                "materials": {"vein": {"young_modulus": "1 kPa"}}}})
>>> colour_of(scene, "vein")  # blue
(0.25, 0.4, 0.85)
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import SceneError, UsSimError
from us_sim.scene.scene import Scene
from us_sim.volume.structure_names import Colour, anatomical_colour
from us_sim.volume.volume import Volume

if TYPE_CHECKING:
    from us_sim.tissue.mesh.embedding import EmbeddedSurface
    from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh


@dataclass(frozen=True, eq=False)
class Structure:
    """A surface in the tissue, and how it is shown."""

    name: str
    colour: Colour  # red, green, blue, 0 to 1
    surface: EmbeddedSurface


def colour_of(scene: Scene, name: str) -> Colour:
    """Red, green and blue of a structure: the scene's, or what its label's name suggests."""
    given = scene.structures[name]
    return given.colour or anatomical_colour(given.label or name)


def require_labels(scene: Scene, volume: Volume) -> None:
    """Check that the volume has the labels that the scene's structures are made from.

    Raises:
        SceneError: it has not.
    """
    known = volume.label_names.values() if volume.labels is not None else ()
    for name, given in scene.structures.items():
        label = given.label or name
        if not given.file and label not in known:
            key = "label: " if given.label else ""
            raise SceneError(
                f"{scene.origin}: structures.{name}: {key}the volume has no label `{label}`; it "
                f"has {', '.join(known) or 'none'}, or name a surface `file`"
            )


def structures_of(
    scene: Scene, volume: Volume, mesh: TetrahedralMesh, triangles: int
) -> Iterator[Structure]:
    """Each structure of the scene, made and embedded one by one.

    Args:
        volume: of the scene.
        mesh: of the scene's tissue. Structures around labels end where it ends.
        triangles: about so many for all structures around labels together; files are taken as
            they are. Of a scene that is made from a case, structures that are nowhere in the tissue
            are left out.

    Raises:
        SceneError: the volume has no such label, or no surface can be made of it.
        MeshError: a file cannot be read, or its surface is not in the tissue.
    """
    from us_sim.tissue.mesh.embedding import EmbeddedSurface

    require_labels(scene, volume)
    numbers = {name: label for label, name in volume.label_names.items()}
    labels = {
        name: numbers[given.label or name]
        for name, given in scene.structures.items()
        if not given.file
    }
    box = np.stack([mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)])
    if scene.case:  # it has structures where the probe is not
        from us_sim.volume.surfaces.label_surface import occurs

        labels = {name: one for name, one in labels.items() if occurs(volume, one, box)}
    spacing = 0.0
    for name, given in scene.structures.items():
        if not given.file and name not in labels:
            continue
        colour = colour_of(scene, name)
        try:
            if given.file:
                yield Structure(name, colour, EmbeddedSurface(mesh, *_surface_of(scene, name)))
                continue
            from us_sim.volume.surfaces.label_surface import label_surface, spacing_for

            spacing = spacing or spacing_for(volume, list(labels.values()), triangles, box)
            around = label_surface(volume, labels[name], spacing, box)
            yield Structure(name, colour, EmbeddedSurface.trimmed(mesh, *around))
        except UsSimError as error:
            raise SceneError(f"{scene.origin}: structures.{name}: {error}") from error


def _surface_of(scene: Scene, name: str) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Vertices in ``patient`` and triangles of a structure's file."""
    from us_sim.skin.surface import read_surface

    given = scene.structures[name]
    assert given.file is not None
    surface = read_surface(Path(given.file), given.unit)
    return given.pose.pose.apply(surface.vertices), surface.triangles
