"""Scenes made from cases: their keys, and their box of tissue, which is kept.

Frame ``patient`` is the probe's where it touches the skin at the case's start: its origin is the
middle of the probe's face, and +z goes into the body.

>>> from us_sim.geometry.collider import RoundedBox
>>> from us_sim.scene.case_tissue import collider_footprint
>>> collider_footprint(RoundedBox(length=0.046, width=0.014, height=0.04, rounding=0.004))
(0.023, 0.007)
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.cache import load_or_create
from us_sim.geometry.collider import Capsule, Collider, Sphere
from us_sim.geometry.pose import Placement, Pose
from us_sim.geometry.transducer import ProbeSettings
from us_sim.scene.scene import Scene
from us_sim.settings.reading import dump_settings
from us_sim.settings.registry import COLLIDERS, PROBES
from us_sim.tissue.elasticity.material import LAYERS, guess_tissue_kind
from us_sim.tissue.elasticity.materials import LabelFractions, label_fractions
from us_sim.tissue.mesh.box_planes import fit_planes, spacing_by_labels, spacing_under_probe
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, box_mesh
from us_sim.volume.cases.case import LABELS, Case, read_case
from us_sim.volume.cases.settings import SLIDE, CaseSettings
from us_sim.volume.structure_names import AROUND
from us_sim.volume.volume import Volume, compute_grid_extent

_BESIDE = 0.013  # m, of tissue beside the probe
_BELOW = 1.05
"""Depth of the tissue over that of the image: tissue that moves against the volume beside it would
leave a seam in the image."""
_THINNEST = 0.02  # m, to which the tissue is cut where the volume ends
_GENERATOR = 1
"""Part of the cache's key: raise it when a change here, or in what this calls, changes a mesh."""
_STEPS = 160
"""Places along the longest side of the box at which labels are read."""
_IN_REACH = 0.015
"""m: how far from the image's plane at rest structures count; the probe slides and tilts."""


def make_case_document(folder: Path) -> dict[str, Any]:
    """Make the keys of a scene from the case in a folder."""
    case = read_case(folder)
    settings = case.settings
    if settings.start is None or settings.probe is None or settings.probe.collider is None:
        from us_sim.volume.cases.proposal import complete_settings

        settings = complete_settings(settings, case.read_volume())
    assert settings.start is not None
    assert settings.probe is not None
    names = [AROUND, *settings.structures] if case.has_labels else [AROUND]
    held = [name for name in settings.held if case.has_labels or name not in settings.structures]
    start: Pose = settings.start.pose.inverse()
    pose = Placement(tuple(start.position.tolist()), tuple(start.orientation.tolist()))
    document: dict[str, Any] = {
        "name": settings.name,
        "volume": {"case": str(case.folder), "pose": dump_settings(pose)},
        "probe": dump_settings(settings.probe),
        "imaging": {"contact": True},
        "tissue": {
            "solver": "fem_nonlinear",
            "mesh": _mesh_document(case, settings.probe, pose),
            "fixed": held,
            "materials": {name: dump_settings(settings.material_of(name)) for name in names},
        },
        "path": _pressing_path(settings),
    }
    if settings.description:
        document["description"] = settings.description
    if case.has_labels and settings.structures:
        document["structures"] = {
            name: {"colour": list(settings.colour_of(name))} for name in settings.structures
        }
    return document


def _pressing_path(settings: CaseSettings) -> str:
    assert settings.probe is not None
    press = settings.press
    if press is None:
        depth = settings.probe.array.resolve_settings(PROBES).depth
        press = min(1 / 3 * depth, 0.022)  # m, of a firm press on an abdomen
    from us_sim.recording.press_and_slide import find_pressing_path

    return str(find_pressing_path(press, SLIDE if settings.slide is None else settings.slide))


def _mesh_document(case: Case, probe: ProbeSettings, pose: Placement) -> dict[str, Any]:
    """Make the box of tissue: as wide and deep as the image, cut to the volume."""
    matrix, shape = case.read_placement()
    volume = compute_grid_extent(pose.pose.matrix @ matrix, shape)
    array, length, width = probe.array.resolve_settings(PROBES), 0.0, 0.0
    if probe.collider:
        length, width = collider_footprint(probe.collider.resolve_settings(COLLIDERS))
    aside = max(array.width / 2, length + _BESIDE)
    # m, along the probe's y: for its slide, and for tissue to give way
    across = max(0.03, 0.25 * array.depth, 2 * width)
    box = np.array([[-aside, -across, 0.0], [aside, across, _BELOW * array.depth]])
    cut = np.stack([np.maximum(box[0], volume[0]), np.minimum(box[1], volume[1])])
    cut[0, 2] = 0.0
    thin = cut[1] - cut[0] < _THINNEST
    box = np.where(thin, box, cut)
    return {
        "lower": box[0].round(4).tolist(),
        "upper": box[1].round(4).tolist(),
        "nodes": case.settings.nodes,
    }


def collider_footprint(collider: Collider) -> tuple[float, float]:
    """Return half the collider's length and width, m along the probe's x and y."""
    if isinstance(collider, Sphere):
        return collider.radius, collider.radius
    if isinstance(collider, Capsule):
        return collider.length / 2 + collider.radius, collider.radius
    return collider.length / 2, collider.width / 2


def compute_box_planes(
    scene: Scene, volume: Volume
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Compute the planes (m) along x, y, z of a box mesh of as many nodes as the scene says."""
    assert scene.tissue is not None
    assert scene.probe.collider is not None
    given = scene.tissue.mesh
    assert isinstance(given.nodes, int)
    box = np.array([given.lower, given.upper])
    step = float((box[1] - box[0]).max()) / _STEPS
    counted = [label for label, name in volume.label_names.items() if is_refined(scene, name)]
    labels = volume.labels
    if labels is None:
        labels, counted = np.zeros((1, 1, 1), np.uint8), []
    wanted = spacing_by_labels(
        labels, volume.patient_to_index, box, step, counted=counted, aside=_IN_REACH
    )
    pressed = collider_footprint(scene.probe.collider.resolve_settings(COLLIDERS))
    return fit_planes(spacing_under_probe(wanted, *pressed), given.nodes)


def is_refined(scene: Scene, label: str) -> bool:
    """Return whether planes come close together for a label: a structure, not held, no layer."""
    assert scene.tissue is not None
    named = {given.label or name for name, given in scene.structures.items()}
    return (
        label in named
        and label not in scene.tissue.fixed
        and guess_tissue_kind(label) not in LAYERS
    )


def cache_tissue(scene: Scene, volume: Volume) -> None:
    """Make the tissue of the scene's case, unless it is in the user's cache folder already."""
    tissue = scene.tissue
    if tissue is not None and not tissue.mesh.file and isinstance(tissue.mesh.nodes, int):
        build_box_tissue(scene, volume)


def build_box_tissue(scene: Scene, volume: Volume) -> tuple[TetrahedralMesh, LabelFractions]:
    """Make the box of tissue, finest at structures, and the labels in it; a case's is kept."""

    def make() -> tuple[TetrahedralMesh, LabelFractions]:
        mesh = box_mesh(*compute_box_planes(scene, volume))
        if volume.labels is None:
            everything = np.ones((len(mesh.tetrahedra), 1))
            return mesh, LabelFractions(np.zeros(1, np.uint8), everything)
        return mesh, label_fractions(mesh, volume.labels, volume.patient_to_index)

    if scene.volume.case is None:
        return make()
    return load_or_create(_cache_key(scene), _pack, _unpack, make)


def _pack(
    tissue: tuple[TetrahedralMesh, LabelFractions],
) -> tuple[dict[str, NDArray], dict[str, Any]]:
    mesh, fractions = tissue
    assert mesh.planes is not None  # boxes have planes
    return dict(zip("xyz", mesh.planes, strict=True)) | fractions._asdict(), {}


def _unpack(
    arrays: dict[str, NDArray], _: dict[str, Any]
) -> tuple[TetrahedralMesh, LabelFractions]:
    mesh = box_mesh(*(arrays[axis] for axis in "xyz"))
    return mesh, LabelFractions(arrays["labels"], arrays["fractions"])


def _cache_key(scene: Scene) -> str:
    """Return a file name by a hash of all that the tissue follows from."""
    assert scene.tissue is not None
    assert scene.probe.collider is not None
    assert scene.volume.case is not None
    mesh, pose, folder = scene.tissue.mesh, scene.volume.pose, Path(scene.volume.case)
    named = {given.label or name for name, given in scene.structures.items()}
    labels = folder / LABELS
    made_from = {
        "lower": list(mesh.lower or ()),
        "upper": list(mesh.upper or ()),
        "nodes": mesh.nodes,
        "probe": list(collider_footprint(scene.probe.collider.resolve_settings(COLLIDERS))),
        "structures": sorted(label for label in named if is_refined(scene, label)),
        "position": list(pose.position),
        "orientation": list(pose.orientation),
        "labels": hashlib.sha256(labels.read_bytes()).hexdigest() if labels.is_file() else "",
    }
    digest = hashlib.sha256(json.dumps([_GENERATOR, made_from]).encode()).hexdigest()
    return f"tissue-{digest[:16]}"
