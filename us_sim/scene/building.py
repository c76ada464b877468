"""The objects a scene names, each made (and its module imported) only when it is asked for.

>>> from us_sim.scene.building import probe_of
>>> from us_sim.scene.reading import parse_scene
>>> scene = parse_scene({"name": "bare", "volume": {"phantom": "upper_arm"},
...                      "probe": {"aperture": "40 mm", "depth": "30 mm", "image": [400, 300]}})
>>> probe_of(scene).columns
400
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import BagError, ProbeError, SceneError, TrackingError
from us_sim.scene.scene import Scene, TissueSettings
from us_sim.settings.registry import COLLIDERS, PROBES
from us_sim.tracking.measurement import PATIENT

if TYPE_CHECKING:
    from us_sim.geometry.collider import Collider
    from us_sim.recording.path import ProbePath
    from us_sim.skin.membrane import SkinMembrane
    from us_sim.skin.settings import MembraneSettings
    from us_sim.skin.surface import TriangleSurface
    from us_sim.slicing.b_mode import BMode
    from us_sim.slicing.probe.probe import Probe
    from us_sim.tissue.elasticity.material import Material
    from us_sim.tissue.elasticity.materials import LabelFractions, TissueMaterials
    from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
    from us_sim.tissue.model import TissueModel
    from us_sim.volume.volume import Volume

_TAKEN_BACK = "; of what the base of a scene says, `null` takes back a material (`fat: null`)"


def volume_of(scene: Scene, progress: Callable[[float, str], None] | None = None) -> Volume:
    """The scene's volume in frame ``patient``.

    Raises:
        VolumeError, CaseError: its file or its case cannot be read.
    """
    if scene.volume.case:
        from us_sim.volume.cases.case import read_case

        volume = read_case(scene.volume.case).volume()
    elif scene.volume.file:
        from us_sim.volume.files.readers import read_volume

        volume = read_volume(Path(scene.volume.file))
    else:
        from us_sim.volume.phantom.phantom import cached_phantom

        assert scene.volume.phantom is not None
        volume = cached_phantom(
            scene.volume.phantom, scene.volume.seed, scene.volume.voxel_size, progress
        )
    patient_from_volume = scene.volume.pose.pose.matrix
    return dataclasses.replace(
        volume, index_to_patient=patient_from_volume @ volume.index_to_patient
    )


def path_of(scene: Scene, file: Path, topic: str | None = None) -> ProbePath:
    """The probe path in a bag or a recording, of the scene's tracker or of the probe itself.

    Args:
        scene: whose tracker says which body of the file it is, where the file has that.
        file: bag or recording.
        topic: the body that a person names.

    Raises:
        BagError: it cannot be read, or is neither in the tracker's frame nor in ``patient``.
    """
    from us_sim.recording.path import read_path

    tracker = scene.tracker
    named = {
        "path": tracker.body,
        "tf": f"tf:{tracker.body}:{tracker.frame}",
        "pose_array": f"tracker/poses:{tracker.entry}",
    }.get(tracker.source.name)
    own = str(file) == tracker.file
    path = None
    if topic is None and named and not own:
        with contextlib.suppress(BagError, TrackingError):  # it may be of another device
            path = read_path(file, named)
    if path is None:
        topic = named if own else topic
        path = read_path(file, topic, option="tracker.body" if own else "--topic")
    if path.frame_id not in (tracker.frame, PATIENT):
        raise BagError(
            f"{file}: {path.topic} is in frame '{path.frame_id}', but the scene's tracker is in "
            f"'{tracker.frame}'; set tracker.frame in {scene.origin}"
        )
    return path


def probe_of(scene: Scene) -> Probe:
    """The transducer that images.

    Raises:
        SceneError: its image is too large.
    """
    section = scene.probe
    array: Probe = section.array.settings(PROBES)
    image = section.image or ((512, 512) if section.geometry == "linear" else 512)
    try:
        if isinstance(image, int):
            return array.with_square_pixels(image)
        return array.with_pixels(*image)
    except ProbeError as error:
        raise SceneError(f"{scene.origin}: {error}") from error


def scanner_of(scene: Scene, volume: Volume, *, threads: int = 1) -> BMode:
    """The scanner that makes the scene's images; its tissue's mesh is for it to be told.

    Raises:
        SceneError: the scene's acoustics do not go with its volume.
    """
    from us_sim.slicing.b_mode import BMode

    try:
        return BMode(
            volume,
            probe_of(scene),
            scene.imaging,
            scene.imaging.acoustics,
            method=scene.slice.name,
            threads=threads,
            settings=scene.slice.given,
        )
    except ProbeError as error:
        raise SceneError(f"{scene.origin}: {error}") from error


def collider_of(scene: Scene) -> Collider:
    """The probe's shape that presses.

    Raises:
        SceneError: the scene has none.
    """
    section = scene.probe.collider
    if section is None:
        raise SceneError(f"{scene.origin}: probe.collider: is missing")
    shape: Collider = section.settings(COLLIDERS)
    return shape


def tissue_model_of(
    scene: Scene, volume: Volume, note: Callable[[str], None] | None = None
) -> TissueModel:
    """Mesh, materials, fixed nodes and collider of the scene's tissue.

    Args:
        note: called with a sentence on each thing about the mesh that was repaired or is unusual.

    Raises:
        SceneError: a label of the volume has no material, or a material, fixed part or structure
            is unknown.
        MeshError, MaterialError: the mesh or a material cannot be used.
    """
    from us_sim.tissue.model import TissueModel

    section = scene.tissue
    if section is None:
        raise SceneError(f"{scene.origin}: tissue: is missing")
    if scene.structures:
        from us_sim.scene.structures import require_labels

        require_labels(scene, volume)
    mesh, remarks, fractions = _mesh(scene, section, volume)
    fixed, held = _fixed_nodes(scene, section, mesh, volume, fractions)
    if note is not None:
        for remark in (*remarks, *held):
            note(f"tissue mesh: {remark}")
    from us_sim.tissue.model import face_nodes, facing_nodes

    touched = facing_nodes(mesh) if section.mesh.file else face_nodes(mesh, "top", 0.0)
    contact = np.setdiff1d(touched, np.flatnonzero(fixed)).astype(np.int32)
    return TissueModel(
        mesh=mesh,
        materials=_materials(scene, section.materials, mesh, volume, fractions),
        fixed=fixed,
        collider=collider_of(scene),
        contact_nodes=contact,
    )


def materials_of(
    scene: Scene, materials: Mapping[str, Material], mesh: TetrahedralMesh, volume: Volume
) -> TissueMaterials:
    """The constants of each tetrahedron, from materials by label name.

    Raises:
        SceneError: a label of the volume has no material, or a material no label.
    """
    return _materials(scene, materials, mesh, volume, _label_fractions(mesh, volume))


def _label_fractions(mesh: TetrahedralMesh, volume: Volume) -> LabelFractions | None:
    """None where the volume has no labels."""
    from us_sim.tissue.elasticity.materials import label_fractions

    if volume.labels is None:
        return None
    return label_fractions(mesh, volume.labels, volume.patient_to_index)


def _materials(
    scene: Scene,
    materials: Mapping[str, Material],
    mesh: TetrahedralMesh,
    volume: Volume,
    fractions: LabelFractions | None,
) -> TissueMaterials:
    from us_sim.tissue.elasticity.materials import average_over_labels, uniform_material

    materials = dict(materials)
    if fractions is None:
        if list(materials) != ["tissue"]:
            raise SceneError(
                f"{scene.origin}: tissue.materials: this volume has no labels, so it takes one "
                f"material named `tissue`, not {', '.join(materials)}{_TAKEN_BACK}"
            )
        return uniform_material(mesh, materials["tissue"])
    by_label = {}
    for label, name in volume.label_names.items():
        if name not in materials:
            raise SceneError(f"{scene.origin}: tissue.materials.{name}: is missing")
        by_label[label] = materials.pop(name)
    if materials:
        raise SceneError(
            f"{scene.origin}: tissue.materials.{next(iter(materials))}: the volume has no such "
            f"label; it has {', '.join(volume.label_names.values())}{_TAKEN_BACK}"
        )
    return average_over_labels(fractions, by_label)


def skin_surface_of(scene: Scene) -> TriangleSurface:
    """The scene's skin at rest.

    Raises:
        SceneError: the scene has none.
        MeshError: its file cannot be used.
    """
    from us_sim.skin import surface

    section = scene.skin
    if section is None:
        raise SceneError(f"{scene.origin}: skin: is missing")
    if section.file:
        return surface.read_surface(Path(section.file))
    if section.flat_width >= section.size[0]:
        return surface.plane_surface(section.size, section.spacing)
    return surface.bent_surface(
        section.size, section.spacing, flat_width=section.flat_width, radius=section.radius
    )


def membrane_of(scene: Scene, settings: MembraneSettings | None = None) -> SkinMembrane:
    """The scene's skin, pressed by the scene's probe; with other settings where they are given."""
    from us_sim.skin.membrane import SkinMembrane

    sheet = skin_surface_of(scene)
    return SkinMembrane(sheet, collider_of(scene), settings or scene.skin)


def _mesh(
    scene: Scene, section: TissueSettings, volume: Volume
) -> tuple[TetrahedralMesh, tuple[str, ...], LabelFractions | None]:
    """The mesh, what there is to say about it, and how much of each label is in it."""
    given = section.mesh
    if given.file:
        from us_sim.tissue.mesh.file import read_mesh

        mesh, remarks = read_mesh(Path(given.file), given.unit, given.pose.pose)
        parts = int(mesh.parts.max()) + 1
        if parts > 1:
            remarks = (*remarks, f"it is in {parts} parts that touch nowhere")
        return mesh, remarks, _label_fractions(mesh, volume)
    if isinstance(given.nodes, int):
        from us_sim.scene.case_tissue import box_tissue, kept_tissue

        tissue = kept_tissue(scene) or box_tissue(scene, volume)
        return tissue.mesh, (), tissue.label_fractions if volume.labels is not None else None
    from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes

    assert given.lower is not None
    assert given.upper is not None
    planes = [
        np.array(given.planes[axis])
        if axis in given.planes
        else uniform_planes(given.lower[i], given.upper[i], given.nodes[i])
        for i, axis in enumerate("xyz")
    ]
    mesh = box_mesh(*planes)
    return mesh, (), _label_fractions(mesh, volume)


def _fixed_nodes(
    scene: Scene,
    section: TissueSettings,
    mesh: TetrahedralMesh,
    volume: Volume,
    fractions: LabelFractions | None,
) -> tuple[NDArray[np.bool_], list[str]]:
    """Nodes on the named faces and inside the named labels (the skeleton is rigid), and remarks."""
    from us_sim.tissue.model import FACES, face_nodes, held_remark, nodes_in_label

    numbers = {name: label for label, name in volume.label_names.items()}
    fixed = np.zeros(len(mesh.nodes), dtype=bool)
    remarks = []
    for name in section.fixed:
        if name in FACES:
            margin = section.mesh.margin if section.mesh.file else 0.0  # a box has faces
            held = face_nodes(mesh, name, margin)
        elif name in numbers and fractions is not None:
            held = nodes_in_label(mesh, fractions, numbers[name])
        else:
            raise SceneError(
                f"{scene.origin}: tissue.fixed: `{name}` is neither a face ({', '.join(FACES)}) "
                f"nor a label of the volume ({', '.join(numbers) or 'it has none'})"
            )
        fixed[held] = True
        remark = held_remark(name, held, mesh)
        remarks += [remark] if remark else []
    return fixed, remarks
