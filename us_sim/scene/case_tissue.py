"""The tissue of a scene that is made from a case: kept in the case, so that it is made once.

Only what the mesh and its labels follow from counts: the box, the probe's shape, where the volume
is, and the labels. Materials may change without it.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from us_sim.errors import CaseError
from us_sim.scene.scene import Scene
from us_sim.scene.tissue_box import box_planes, counts, footprint
from us_sim.settings.registry import COLLIDERS
from us_sim.tissue.elasticity.materials import label_fractions
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
from us_sim.volume.cases.case import LABELS, TISSUE
from us_sim.volume.cases.tissue import CaseTissue, read_tissue, write_tissue
from us_sim.volume.volume import Volume

_logger = logging.getLogger(__name__)


def kept_tissue(scene: Scene) -> CaseTissue | None:
    """The tissue in the scene's case, if it is the one that this scene would make.

    One that cannot be read is said in a warning, and not used.
    """
    if scene.volume.case is None or not _is_fitted(scene):
        return None
    path = Path(scene.volume.case) / TISSUE
    if not path.is_file():
        return None
    try:
        kept = read_tissue(path)
    except CaseError as error:
        _logger.warning("%s", error)
        return None
    return kept if kept.made_from == _made_from(scene) else None


def keep_tissue(
    scene: Scene, volume: Volume, progress: Callable[[float, str], None] | None = None
) -> None:
    """Make the tissue and keep it in the scene's case, unless it is there or cannot be kept.

    Args:
        progress: called with the fraction done and what is being done.

    Raises:
        MeshError: no mesh can be made.
    """
    if scene.volume.case is None or not _is_fitted(scene) or kept_tissue(scene) is not None:
        return
    try:
        write_tissue(Path(scene.volume.case) / TISSUE, box_tissue(scene, volume, progress))
    except CaseError as error:
        _logger.warning("%s; it is made in every run", error)


def box_tissue(
    scene: Scene, volume: Volume, progress: Callable[[float, str], None] | None = None
) -> CaseTissue:
    """The box of a scene whose nodes are put where they count, and the labels in it.

    Raises:
        MeshError: no mesh can be made of so few nodes, or by fTetWild.
    """
    assert scene.tissue is not None
    made_from = _made_from(scene) if scene.volume.case is not None else {}
    if scene.tissue.mesh.kind == "conforming":
        from us_sim.scene.conforming_tissue import conforming_tissue

        mesh, fractions_by_label = conforming_tissue(scene, volume, progress)
        return CaseTissue(mesh, *fractions_by_label, made_from)
    mesh = box_mesh(*box_planes(scene, volume))
    if volume.labels is None:
        labels, fractions = np.zeros(1, np.uint8), np.ones((len(mesh.tetrahedra), 1))
    else:
        labels, fractions = label_fractions(mesh, volume.labels, volume.patient_to_index)
    return CaseTissue(mesh, labels, fractions, made_from)


def _is_fitted(scene: Scene) -> bool:
    """Whether nodes are put where they count."""
    tissue = scene.tissue
    return tissue is not None and not tissue.mesh.file and isinstance(tissue.mesh.nodes, int)


def _made_from(scene: Scene) -> dict[str, Any]:
    """What the tissue follows from, as JSON gives it back."""
    assert scene.tissue is not None
    assert scene.probe.collider is not None
    assert scene.volume.case is not None
    mesh, pose, folder = scene.tissue.mesh, scene.volume.pose, Path(scene.volume.case)
    named = {given.label or name for name, given in scene.structures.items()}
    checksum = ""
    if (folder / LABELS).is_file():
        with (folder / LABELS).open("rb") as stream:
            checksum = hashlib.file_digest(stream, "sha256").hexdigest()
    kind = {} if mesh.kind == "grid" else {"kind": mesh.kind}
    return kind | {
        "lower": list(mesh.lower or ()),
        "upper": list(mesh.upper or ()),
        "nodes": mesh.nodes,
        "probe": list(footprint(scene.probe.collider.settings(COLLIDERS))),
        "structures": sorted(label for label in named if counts(scene, label)),
        "position": list(pose.position),
        "orientation": list(pose.orientation),
        "labels": checksum,
    }
