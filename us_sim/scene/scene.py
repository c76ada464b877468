"""What a scene may hold: one frozen dataclass a section, each value with its unit and range.

`scene_file` reads and validates the YAML that fills these; `assembly` makes the objects they name.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from us_sim.settings.quantity import Quantity, given
from us_sim.slicing.formation.imaging import Imaging
from us_sim.tracking.camera.settings import CameraSettings
from us_sim.tracking.filter.settings import FilterSettings, GateSettings
from us_sim.tracking.haptic.settings import HapticSettings
from us_sim.tracking.mouse.settings import SixDofMouseSettings
from us_sim.tracking.openigtlink.settings import OpenIGTLinkSettings

__all__ = [
    "ColliderSection",
    "MaterialSection",
    "MeshSection",
    "Part",
    "PoseSection",
    "ProbeSection",
    "Scene",
    "SkinSection",
    "SliceSection",
    "StructureSection",
    "TissueSection",
    "TrackerSection",
    "VolumeSection",
]

_POSITION = Quantity("length", -10.0, 10.0)


@dataclass(frozen=True)
class PoseSection:
    """Where the volume's own frame lies in ``patient``: position m, orientation x, y, z, w."""

    position: tuple[float, float, float] = given(_POSITION, default=(0.0, 0.0, 0.0))
    orientation: tuple[float, float, float, float] = given(
        Quantity("number", -1.0, 1.0), default=(0.0, 0.0, 0.0, 1.0)
    )


@dataclass(frozen=True)
class VolumeSection:
    """The ultrasound volume: a file, or a procedural phantom made from a seed."""

    file: str | None = given(default=None, file=True)
    phantom: str | None = given(default=None, choices=("upper_arm",))
    seed: int = given(Quantity("number", 0, 2**31), default=1)
    voxel_size: float = given(Quantity("length", 2e-4, 5e-3), default=0.3e-3)
    pose: PoseSection = given(default=PoseSection())


@dataclass(frozen=True)
class MaterialSection:
    """An isotropic elastic material."""

    young_modulus: float = given(Quantity("pressure", 1.0, 1e12))
    poisson_ratio: float = given(Quantity("number", 0.0, 0.4999), default=0.45)
    density: float = given(Quantity("density", 1.0, 1e5), default=1000.0)


@dataclass(frozen=True)
class MeshSection:
    """A box of tetrahedra in ``patient``: its corners, and the number of nodes along each axis.

    ``planes`` may give the node coordinates along an axis one by one, to put them where they count.

    Or a mesh from a ``file``, in this ``unit``, with its own frame at ``pose`` in ``patient``;
    ``margin`` is how near to a face of its bounding box a node of its boundary belongs to that
    face (a twentieth of the size along that axis where it is not given).
    """

    lower: tuple[float, float, float] | None = given(_POSITION, default=None)
    upper: tuple[float, float, float] | None = given(_POSITION, default=None)
    nodes: tuple[int, int, int] = given(Quantity("number", 2, 400), default=(20, 10, 10))
    planes: dict[str, tuple[float, ...]] = given(_POSITION, default_factory=dict)
    file: str | None = given(default=None, file=True)
    unit: float = given(Quantity("length", 1e-9, 1e3), default=1.0)
    pose: PoseSection = given(default=PoseSection())
    margin: float | None = given(Quantity("length", 1e-6, 1.0), default=None)


@dataclass(frozen=True)
class TissueSection:
    """The deformable block, its materials by label name, and the solver that deforms it."""

    mesh: MeshSection = given()
    materials: dict[str, MaterialSection] = given()
    fixed: tuple[str, ...] = given(default=("bottom",))
    solver: str = given(
        default="fem",
        choices=("fem", "fem_nonlinear", "fem_cg", "msds", "msds_implicit"),
    )
    settings: dict[str, dict[str, Any]] = given(default_factory=dict)


@dataclass(frozen=True)
class StructureSection:
    """A surface in the tissue that goes with it: around a label of the volume, or from a file.

    ``label`` is the structure's own name unless it is given. A file's surface is in this ``unit``,
    with its own frame at ``pose`` in ``patient``. ``colour`` is red, green, blue.
    """

    label: str | None = given(default=None)
    file: str | None = given(default=None, file=True)
    unit: float = given(Quantity("length", 1e-9, 1e3), default=1.0)
    pose: PoseSection = given(default=PoseSection())
    colour: tuple[float, float, float] | None = given(Quantity("number", 0.0, 1.0), default=None)


@dataclass(frozen=True)
class SkinSection:
    """The skin membrane: a surface file, or a sheet bent down on both sides of a flat part."""

    file: str | None = given(default=None, file=True)
    size: tuple[float, float] = given(Quantity("length", 0.01, 2.0), default=(0.2, 0.2))
    spacing: float = given(Quantity("length", 5e-4, 0.05), default=4e-3)
    flat_width: float = given(Quantity("length", 0.0, 2.0), default=2.0)
    radius: float = given(Quantity("length", 5e-3, 10.0), default=0.05)
    stiffness: float = given(Quantity("stiffness", 1e-6, 1e9), default=40.0)
    anchor_stiffness: float = given(Quantity("stiffness", 1e-6, 1e9), default=4.0)
    density: float = given(Quantity("mass per area", 1e-6, 1e6), default=2.0)


@dataclass(frozen=True)
class ColliderSection:
    """The probe's shape that pushes tissue and skin."""

    shape: str = given(choices=("sphere", "capsule", "rounded_box", "convex"))
    radius: float | None = given(Quantity("length", 1e-4, 0.5), default=None)
    length: float | None = given(Quantity("length", 1e-4, 0.5), default=None)
    width: float | None = given(Quantity("length", 1e-4, 0.5), default=None)
    height: float | None = given(Quantity("length", 1e-4, 0.5), default=None)
    rounding: float | None = given(Quantity("length", 1e-5, 0.25), default=None)


@dataclass(frozen=True)
class ProbeSection:
    """The transducer: its geometry, what it images, and the shape that presses.

    A linear array has an ``aperture``, a convex one the ``radius`` of its face and an
    ``opening_angle``, a sector (phased array) ``aperture`` and ``opening_angle``, and a ``radius``
    if its beams radiate from an apex behind the face. ``image`` is [columns, rows], or the number
    of rows of square pixels; not given it is [512, 512] of a linear array, else 512.
    """

    depth: float = given(Quantity("length", 5e-3, 0.4))
    geometry: str = given(default="linear", choices=("linear", "convex", "sector"))
    aperture: float | None = given(Quantity("length", 3e-3, 0.2), default=None)
    radius: float | None = given(Quantity("length", 0.0, 0.3), default=None)
    opening_angle: float | None = given(
        Quantity("angle", math.radians(1), math.radians(180)), default=None
    )
    focus: float | None = given(Quantity("length", 1e-3, 0.4), default=None)
    lines: int | None = given(Quantity("number", 1, 4096), default=None)
    samples: int | None = given(Quantity("number", 1, 16384), default=None)
    image: tuple[int, int] | int | None = given(Quantity("number", 1, 4096), default=None)
    collider: ColliderSection | None = given(default=None)


@dataclass(frozen=True)
class SliceSection:
    """How the image is cut."""

    method: str = given(
        default="scan_conversion", choices=("scan_conversion", "row_subdivision", "per_pixel")
    )
    regions: int = given(Quantity("number", 1, 4096), default=32)


@dataclass(frozen=True)
class TrackerSection:
    """Where probe poses come from, and what is done to them.

    ``registration`` is the device's frame in ``patient``, ``calibration`` the probe in the tracked
    body's frame: a file that `us-sim calibrate` wrote, or a pose. ``frame`` is the device's frame
    in messages; ``entry`` the number of the body in a PoseArray, ``body`` its name where a device
    has several by name (a tf frame, an OpenIGTLink device, a transform in a recording), ``file``
    a recording.
    """

    source: str = given(
        default="pose",
        choices=(
            "pose",
            "pose_array",
            "tf",
            "camera",
            "six_dof_mouse",
            "haptic",
            "openigtlink",
            "path",
        ),
    )
    frame: str = given(default="patient")
    entry: int = given(Quantity("number", 0, 1000), default=0)
    body: str | None = given(default=None)
    file: str | None = given(default=None, file=True)
    registration: PoseSection | str | None = given(default=None, file=True)
    calibration: PoseSection | str | None = given(default=None, file=True)
    time_offset: float = given(Quantity("time", -10.0, 10.0), default=0.0)
    coast_for: float = given(Quantity("time", 1e-3, 60.0), default=0.3)
    lost_after: float = given(Quantity("time", 1e-3, 60.0), default=1.0)
    filter: FilterSettings = given(default=FilterSettings())
    gate: GateSettings | None = given(default=None)
    camera: CameraSettings | None = given(default=None)
    six_dof_mouse: SixDofMouseSettings | None = given(default=None)
    haptic: HapticSettings | None = given(default=None)
    openigtlink: OpenIGTLinkSettings | None = given(default=None)


@dataclass(frozen=True)
class Part:
    """A node of the graph, whether this scene needs it, and why."""

    node: str
    needed: bool
    reason: str


@dataclass(frozen=True)
class Scene:
    """A whole scene. Only ``volume`` and ``probe`` must be there."""

    name: str = given()
    volume: VolumeSection = given()
    probe: ProbeSection = given()
    tissue: TissueSection | None = given(default=None)
    structures: dict[str, StructureSection] = given(default_factory=dict)
    skin: SkinSection | None = given(default=None)
    slice: SliceSection = given(default=SliceSection())
    imaging: Imaging = given(default=Imaging())
    tracker: TrackerSection = given(default=TrackerSection())
    path: str | None = given(default=None, file=True)
    description: str = given(default="")
    origin: str = "scene"

    def parts(self) -> list[Part]:
        """Every simulation node with the reason why it runs or is left out."""
        return [
            Part("probe_tracker", True, f"poses come from `{self.tracker.source}`"),
            _part("tissue_deformer", self.tissue, "tissue", "the volume is sliced rigidly"),
            _part("skin_deformer", self.skin, "skin", "no membrane is computed"),
            Part("slice_interpolator", True, self._imaged()),
            *self._felt(),
        ]

    def _felt(self) -> list[Part]:
        """What a haptic arm needs."""
        if self.tracker.source != "haptic":
            return []
        return [_part("haptic_renderer", self.tissue, "tissue", "nothing can be felt")]

    def _imaged(self) -> str:
        """How images are made, for a person."""
        asked = [
            entry.name
            for entry in fields(Imaging)
            if getattr(self.imaging, entry.name) != entry.default
        ]
        formed = f"formed with {', '.join(asked)}" if asked else "shown as they are cut"
        return f"{self.probe.geometry} images are cut by `{self.slice.method}`, {formed}"

    @property
    def volume_name(self) -> str:
        """The volume's file name or phantom, for a person."""
        if self.volume.file:
            return Path(self.volume.file).name
        return f"phantom {self.volume.phantom}, seed {self.volume.seed}"


def _part(node: str, section: object | None, key: str, consequence: str) -> Part:
    if section is None:
        return Part(node, False, f"the scene has no `{key}`: {consequence}")
    return Part(node, True, f"the scene has `{key}`")
