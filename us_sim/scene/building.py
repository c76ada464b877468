"""Building the objects that a scene names; each function imports only what its object needs.

>>> from us_sim.scene.building import structure_colour, build_probe, build_tracking
>>> from us_sim.scene.reading import load_scene
>>> scene = load_scene("upper_arm")
>>> build_probe(scene).columns, build_tracking(scene).filter.lag
(512, 0.0)
>>> structure_colour(scene, "vein")  # blue
(0.25, 0.4, 0.85)
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from us_sim import Progress
from us_sim.errors import BagError, ProbeError, SceneError, TrackingError, UsSimError
from us_sim.geometry.pose import Placement, Pose
from us_sim.scene.scene import Scene, TissueSettings
from us_sim.settings.registry import COLLIDERS, PROBES, TRACKERS
from us_sim.tracking.measurement import PATIENT
from us_sim.volume.structure_names import AROUND, Colour, choose_colour

if TYPE_CHECKING:
    from us_sim.geometry.collider import Collider
    from us_sim.recording.path import ProbePath
    from us_sim.skin.membrane import SkinMembrane
    from us_sim.skin.settings import MembraneSettings
    from us_sim.skin.surface import TriangleSurface
    from us_sim.slicing.b_mode import BMode
    from us_sim.slicing.flow.blood import Blood
    from us_sim.slicing.probe.probe import Probe
    from us_sim.tissue.elasticity.material import Material
    from us_sim.tissue.elasticity.materials import LabelFractions, TissueMaterials
    from us_sim.tissue.mesh.embedding import EmbeddedSurface
    from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
    from us_sim.tissue.model import TissueModel
    from us_sim.tracking.camera.rigid_body import RigidBody
    from us_sim.tracking.filters import PoseFilter
    from us_sim.tracking.haptic import HapticRendering
    from us_sim.tracking.probe_tracking import ProbeTracking
    from us_sim.volume.volume import Volume


_TAKEN_BACK = "; of what the base of a scene says, `null` takes back a material (`fat: null`)"


def load_volume(scene: Scene, progress: Progress | None = None) -> Volume:
    """Load the scene's volume in frame ``patient``, from its case, its file or its phantom."""
    if scene.volume.case:
        from us_sim.volume.cases.case import read_case

        volume = read_case(scene.volume.case).read_volume()
    elif scene.volume.file:
        from us_sim.volume.files.readers import read_volume

        volume = read_volume(Path(scene.volume.file))
    else:
        from us_sim.volume.phantom.phantom import load_or_make_phantom

        assert scene.volume.phantom is not None
        volume = load_or_make_phantom(
            scene.volume.phantom, scene.volume.seed, scene.volume.voxel_size, progress
        )
    patient_from_volume = scene.volume.pose.pose.matrix
    return dataclasses.replace(
        volume, index_to_patient=patient_from_volume @ volume.index_to_patient
    )


def load_path(scene: Scene, file: Path, topic: str | None = None) -> ProbePath:
    """Load the path of the scene's tracker, or of the probe itself, from a bag or a recording.

    Args:
        scene: its tracker names the body, unless the file lacks that one.
        file: bag or recording.
        topic: of the body, as a person names it.

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


def build_probe(scene: Scene) -> Probe:
    """Build the transducer that images, with the number of pixels that the scene asks for."""
    section = scene.probe
    array: Probe = section.array.resolve_settings(PROBES)
    image = section.image or ((512, 512) if section.geometry == "linear" else 512)
    try:
        if isinstance(image, int):
            return array.with_square_pixels(image)
        return array.with_pixels(*image)
    except ProbeError as error:
        raise SceneError(f"{scene.origin}: {error}") from error


def build_scanner(scene: Scene, volume: Volume, *, threads: int = 1) -> BMode:
    """Build the scanner of the scene's images; `BMode.attach_mesh` gives it the tissue's mesh."""
    from us_sim.slicing.b_mode import BMode

    try:
        return BMode(
            volume,
            build_probe(scene),
            scene.imaging,
            scene.imaging.acoustics,
            method=scene.slice.name,
            threads=threads,
        )
    except ProbeError as error:
        raise SceneError(f"{scene.origin}: {error}") from error


def build_collider(scene: Scene) -> Collider:
    """Build the shape with which the probe presses; a scene without one is refused."""
    if scene.probe.collider is None:
        raise SceneError(f"{scene.origin}: probe.collider: is missing")
    shape: Collider = scene.probe.collider.resolve_settings(COLLIDERS)
    return shape


def build_tissue_model(
    scene: Scene, volume: Volume, note: Callable[[str], None] | None = None
) -> TissueModel:
    """Build the model of the scene's tissue: mesh, materials, fixed nodes and collider.

    Args:
        scene: with tissue.
        volume: of the scene.
        note: called with a sentence on each thing about the mesh that was repaired or is unusual.

    Raises:
        SceneError: a label of the volume has no material, or a material, fixed part or structure
            is unknown.
        MeshError: the mesh or a material cannot be used.

    Examples:
        >>> from us_sim.scene.reading import load_scene
        >>> scene = load_scene("tests/small_scene.yaml")
        >>> len(build_tissue_model(scene, load_volume(scene)).mesh.nodes)
        432
    """
    from us_sim.tissue.model import TissueModel, face_nodes, facing_nodes

    section = scene.tissue
    if section is None:
        raise SceneError(f"{scene.origin}: tissue: is missing")
    require_labels(scene, volume.label_names)
    mesh, remarks, fractions = _build_mesh(scene, section, volume)
    fixed, held = _find_fixed_nodes(section, mesh, volume, fractions)
    if note is not None:
        for remark in (*remarks, *held):
            note(f"tissue mesh: {remark}")
    touched = facing_nodes(mesh) if section.mesh.file else face_nodes(mesh, "top", 0.0)
    contact = np.setdiff1d(touched, np.flatnonzero(fixed)).astype(np.int32)
    return TissueModel(
        mesh=mesh,
        materials=build_materials(scene, section.materials, mesh, volume, fractions),
        fixed=fixed,
        collider=build_collider(scene),
        contact_nodes=contact,
        gravity=np.array(section.gravity),
    )


def build_materials(
    scene: Scene,
    materials: Mapping[str, Material],
    mesh: TetrahedralMesh,
    volume: Volume,
    fractions: LabelFractions | None = None,
) -> TissueMaterials:
    """Compute each tetrahedron's constants from the materials of the labels in it.

    Args:
        scene: named in errors.
        materials: by label names.
        mesh: of the tissue.
        volume: of the scene.
        fractions: of the labels in each tetrahedron; None: they are computed.

    Raises:
        SceneError: a label of the volume has no material, or a material no label.
    """
    from us_sim.tissue.elasticity.materials import average_over_labels, make_uniform_materials

    fractions = fractions or compute_label_fractions(mesh, volume)
    require_materials(scene, materials, volume.label_names if fractions else None)
    if fractions is None:
        return make_uniform_materials(mesh, materials["tissue"])
    by_label = {label: materials[name] for label, name in volume.label_names.items()}
    return average_over_labels(fractions, by_label)


def compute_label_fractions(mesh: TetrahedralMesh, volume: Volume) -> LabelFractions | None:
    """Compute the part of each tetrahedron that each label fills; None without labels."""
    from us_sim.tissue.elasticity.materials import label_fractions

    if volume.labels is None:
        return None
    return label_fractions(mesh, volume.labels, volume.patient_to_index)


def require_materials(
    scene: Scene, materials: Mapping[str, Material], label_names: Mapping[int, str] | None
) -> None:
    """Check that each label has a material and each material a label; raise SceneError if not.

    A volume without labels, whose ``label_names`` are None, needs one material named ``tissue``.
    """
    if label_names is None:
        if list(materials) != ["tissue"]:
            raise SceneError(
                f"{scene.origin}: tissue.materials: this volume has no labels, so it takes one "
                f"material named `tissue`, not {', '.join(materials)}{_TAKEN_BACK}"
            )
        return
    for label, name in label_names.items():
        if name not in materials:
            which = "label 0, the tissue between structures, " if label == 0 else ""
            raise SceneError(
                f"{scene.origin}: tissue.materials.{name}: is missing: {which}needs a material too"
            )
    others = [name for name in materials if name not in label_names.values()]
    if others:
        raise SceneError(
            f"{scene.origin}: tissue.materials.{others[0]}: the volume has no such "
            f"label; it has {', '.join(label_names.values())}{_TAKEN_BACK}"
        )


def load_skin_surface(scene: Scene) -> TriangleSurface:
    """Load the scene's skin at rest from its file, or make it; a scene without one is refused."""
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


def build_membrane(scene: Scene, settings: MembraneSettings | None = None) -> SkinMembrane:
    """Build the skin that the scene's probe presses, by these settings or else the scene's."""
    from us_sim.skin.membrane import SkinMembrane

    return SkinMembrane(load_skin_surface(scene), build_collider(scene), settings or scene.skin)


def _build_mesh(
    scene: Scene, section: TissueSettings, volume: Volume
) -> tuple[TetrahedralMesh, tuple[str, ...], LabelFractions | None]:
    """Read or make the mesh; return it, remarks about it, and the labels' parts in it."""
    given = section.mesh
    if given.file:
        from us_sim.tissue.mesh.file import read_mesh

        mesh, remarks = read_mesh(Path(given.file), given.unit, given.pose.pose)
        parts = int(mesh.parts.max()) + 1
        if parts > 1:
            remarks = (*remarks, f"it is in {parts} parts that touch nowhere")
        return mesh, remarks, compute_label_fractions(mesh, volume)
    if isinstance(given.nodes, int):
        from us_sim.scene.case_tissue import build_box_tissue

        mesh, fractions = build_box_tissue(scene, volume)
        return mesh, (), fractions if volume.labels is not None else None
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
    return mesh, (), compute_label_fractions(mesh, volume)


def _find_fixed_nodes(
    section: TissueSettings,
    mesh: TetrahedralMesh,
    volume: Volume,
    fractions: LabelFractions | None,
) -> tuple[NDArray[np.bool_], list[str]]:
    """Find the nodes on named faces and in named labels, as of bone; return a mask and remarks."""
    from us_sim.tissue.model import FACES, describe_held_nodes, face_nodes, nodes_in_label

    numbers = {name: label for label, name in volume.label_names.items()}
    fixed = np.zeros(len(mesh.nodes), dtype=bool)
    remarks = []
    for name in section.fixed:
        if name in FACES:
            margin = section.mesh.margin if section.mesh.file else 0.0  # a box has faces
            held = face_nodes(mesh, name, margin)
        else:
            assert fractions is not None  # the volume has labels: see `require_labels`
            held = nodes_in_label(mesh, fractions, numbers[name])
        fixed[held] = True
        remark = describe_held_nodes(name, held, mesh)
        remarks += [remark] if remark else []
    return fixed, remarks


def build_tracking(scene: Scene, filter: PoseFilter | None = None) -> ProbeTracking:
    """Build the tracking of the probe by the scene's tracker, with another filter if given."""
    from us_sim.tracking.filters import create_filter
    from us_sim.tracking.probe_tracking import ProbeTracking

    tracker = scene.tracker
    gate = None
    if tracker.gate is not None:
        from us_sim.tracking.outlier_gate import OutlierGate

        gate = OutlierGate(tracker.gate)
    return ProbeTracking(
        *load_tracker_poses(scene),
        filter or create_filter(tracker.filter.name, tracker.filter.given),
        gate,
        time_offset=tracker.time_offset,
        coast_for=tracker.coast_for,
        lost_after=tracker.lost_after,
    )


def source_settings(scene: Scene, source: str) -> Any:
    """Return the scene's settings of a source of poses, or the defaults of another source."""
    chosen = scene.tracker.source
    if chosen.name == source and chosen.given is not None:
        return chosen.given
    return TRACKERS.load_settings(source)()


def load_tracker_poses(scene: Scene) -> tuple[Pose, Pose]:
    """Load registration (the device in ``patient``) and calibration (the probe in the body)."""
    tracker = scene.tracker
    return _pose_or_file(tracker.registration), _pose_or_file(tracker.calibration)


def build_haptic_rendering(scene: Scene) -> HapticRendering:
    """Build the rendering of the wrench on the handle of the scene's haptic arm."""
    from us_sim.tracking.haptic import HapticDevice, HapticRendering

    settings = source_settings(scene, "haptic")
    device = HapticDevice(settings, *load_tracker_poses(scene))
    return HapticRendering(settings, device, time_offset=scene.tracker.time_offset)


def _pose_or_file(given: Placement | str | None) -> Pose:
    if isinstance(given, str):
        from us_sim.tracking.calibration.transform_file import read_transform

        return read_transform(given)
    return given.pose if given is not None else Pose()


def load_camera_body(scene: Scene) -> RigidBody:
    """Load the markers on the probe that the scene's camera looks for."""
    from us_sim.tracking.camera.rigid_body import RigidBody, read_rigid_body

    settings = source_settings(scene, "camera")
    if settings.body:
        return read_rigid_body(settings.body)
    return RigidBody.create_single(settings.dictionary, settings.marker, settings.size)


@dataclass(frozen=True, eq=False)
class Structure:
    """A surface in the tissue, and how it is shown."""

    name: str
    colour: Colour  # red, green, blue, 0 to 1
    surface: EmbeddedSurface


def structure_colour(scene: Scene, name: str) -> Colour:
    """Return a structure's red, green and blue: the scene's, or the usual ones of its label."""
    given = scene.structures[name]
    return given.colour or choose_colour(given.label or name)


def require_labels(scene: Scene, label_names: Mapping[int, str]) -> None:
    """Refuse a scene that names a label which its volume lacks, materials left aside."""
    from us_sim.tissue.model import FACES

    held = enumerate(scene.tissue.fixed if scene.tissue else ())
    tissues = scene.imaging.acoustics.tissues if scene.imaging.acoustics.is_live else ()
    named = {
        f"structures.{name}{'.label' if given.label else ''}": given.label or name
        for name, given in scene.structures.items()
        if not given.file
    }
    named |= {f"tissue.fixed[{i}]": name for i, name in held if name not in FACES}
    named |= {f"imaging.acoustics.tissues.{name}": name for name in tissues if name != AROUND}
    named |= {"episode.target": scene.episode.target} if scene.episode.target else {}
    known = label_names.values()
    for key, label in named.items():
        if label not in known:
            faces = f"; faces are {', '.join(FACES)}" if key.startswith("tissue") else ""
            raise SceneError(
                f"{scene.origin}: {key}: the volume has no label `{label}`; it has "
                f"{', '.join(known) or 'none'}{faces}"
            )


def build_structures(
    scene: Scene, volume: Volume, mesh: TetrahedralMesh, triangles: int
) -> Iterator[Structure]:
    """Make and embed the scene's structures one by one.

    Of a scene that is made from a case, structures that are nowhere in the tissue are left out.

    Args:
        scene: with tissue.
        volume: of the scene.
        mesh: of the scene's tissue. Structures around labels end where it ends.
        triangles: about so many for all structures around labels together; files are taken as
            they are.

    Raises:
        SceneError: the volume has no such label, or no surface can be made of it.
        MeshError: a file cannot be read, or its surface is not in the tissue.
    """
    from us_sim.tissue.mesh.embedding import EmbeddedSurface

    require_labels(scene, volume.label_names)
    numbers = {name: label for label, name in volume.label_names.items()}
    labels = {
        name: numbers[given.label or name]
        for name, given in scene.structures.items()
        if not given.file
    }
    box = np.stack([mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)])
    if scene.case:  # it has structures where the probe is not
        from us_sim.volume.surfaces.label_surface import is_label_within

        labels = {name: one for name, one in labels.items() if is_label_within(volume, one, box)}
    spacing = 0.0
    for name, given in scene.structures.items():
        if not given.file and name not in labels:
            continue
        colour = structure_colour(scene, name)
        try:
            if given.file:
                from us_sim.skin.surface import read_surface

                surface = read_surface(Path(given.file), given.unit)
                vertices = given.pose.pose.transform_points(surface.vertices)
                yield Structure(name, colour, EmbeddedSurface(mesh, vertices, surface.triangles))
                continue
            from us_sim.volume.surfaces.label_surface import choose_spacing, make_label_surface

            spacing = spacing or choose_spacing(volume, list(labels.values()), triangles, box)
            around = make_label_surface(volume, labels[name], spacing, box)
            yield Structure(name, colour, EmbeddedSurface.embed_trimmed(mesh, *around))
        except UsSimError as error:
            raise SceneError(f"{scene.origin}: structures.{name}: {error}") from error


def build_blood(scene: Scene, volume: Volume) -> Blood:
    """Build the scene's vessels with a flow; one that is no tube along its flow is refused."""
    from us_sim.slicing.flow.blood import Blood
    from us_sim.slicing.flow.vessel import Vessel

    require_labels(scene, volume.label_names)
    numbers = {name: label for label, name in volume.label_names.items()}
    vessels = []
    for name, flow in scene.flows.items():
        label = numbers[scene.structures[name].label or name]
        try:
            vessels.append(Vessel(f"structures.{name}", volume, label, flow))
        except SceneError as error:
            raise SceneError(f"{scene.origin}: {error}") from error
    return Blood(vessels)
