"""Scene: sections of settings, most of them the domain's own.

`reading` makes a scene from YAML; `building` makes the objects that it names.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from us_sim.errors import SceneError
from us_sim.geometry.pose import Placement
from us_sim.geometry.transducer import ProbeSettings
from us_sim.scene.episode import EpisodeSettings
from us_sim.settings.choice import ChosenOption
from us_sim.settings.quantity import Quantity
from us_sim.settings.registry import FILTERS, SLICERS, SOLVERS, TRACKERS
from us_sim.settings.setting import Settings, setting
from us_sim.skin.settings import SkinSettings
from us_sim.slicing.acoustics.settings import Acoustics
from us_sim.slicing.settings import (
    ColourSettings,
    FlowSettings,
    Imaging,
    MModeSettings,
    SpectrumSettings,
    StrainSettings,
)
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.mesh.tetrahedral_mesh import MeshSettings
from us_sim.tracking.settings import GateSettings
from us_sim.volume.settings import VolumeSettings

CASE_PREFIX = "case:"
EXERCISE_PREFIX = "exercise:"
"""Before the name or the folder of a case, in place of a scene's name."""


@dataclass(frozen=True)
class TissueSettings(Settings):
    """The deformable tissue, its materials by label name, and the solver that deforms it."""

    section = "tissue"
    error = SceneError

    mesh: MeshSettings = setting(description="tetrahedra")
    materials: Mapping[str, Material] = setting(
        description="of each label of the volume; of a volume without labels `tissue`"
    )
    fixed: tuple[str, ...] = setting(
        description="faces (top, bottom, sides, ...) and labels that are held", default=("bottom",)
    )
    gravity: tuple[float, float, float] = setting(
        Quantity("acceleration", -100.0, 100.0),
        "in `patient`, on tissue whose mesh is its shape without; for fem and fem_nonlinear",
        default=(0.0, 0.0, 0.0),
    )
    solver: str = setting(
        description="method; may be switched while running", choice=SOLVERS, default="fem"
    )
    settings: Mapping[str, Settings] = setting(
        description="of solvers, by their names", choice=SOLVERS, default_factory=dict
    )

    def check(self) -> None:
        """Require a material."""
        if not self.materials:
            raise self.make_error("materials", "names no material")


@dataclass(frozen=True)
class StructureSettings(Settings):
    """A surface in the tissue that goes with it: around a label of the volume, or from a file."""

    section = "structures"
    error = SceneError
    alternatives = MappingProxyType({"file": ("unit", "pose"), "label": ("flow",)})

    label: str | None = setting(
        description="of the volume; not given: the structure's own name", default=None
    )
    file: str | None = setting(description="surface in place of a label", default=None, file=True)
    unit: float = setting(
        Quantity("length", 1e-9, 1e3), "length of a unit of the file", default=1.0
    )
    pose: Placement = setting(description="of the file's frame in `patient`", default=Placement())
    colour: tuple[float, float, float] | None = setting(
        Quantity("number", 0.0, 1.0), "red, green, blue", default=None
    )
    flow: FlowSettings | None = setting(
        description="of the blood in the label, which must be a tube", default=None
    )

    def check(self) -> None:
        """Refuse keys that do not go together."""
        if self.file and self.flow:
            raise self.make_error(
                "flow", "is for structures around a label, in which there is room for blood"
            )
        if self.file and self.label:
            raise self.make_error("", "has both `file` and `label`; keep one")
        if not self.file and (self.unit != 1.0 or self.pose != Placement()):
            raise self.make_error("", "`unit` and `pose` are for a surface from a `file` only")


@dataclass(frozen=True)
class TrackerSettings(Settings):
    """The source of the probe's poses, and their processing.

    A source's own settings stand under its name: ``source: camera`` and ``camera: {...}``.
    """

    section = "tracker"
    error = SceneError

    source: ChosenOption = setting(
        description="where poses come from",
        choice=TRACKERS,
        place="named",
        default=ChosenOption("pose"),
    )
    frame: str = setting(description="of the device, in its messages", default="patient")
    entry: int = setting(
        Quantity("number", 0, 1000),
        "number of the body in a PoseArray",
        default=0,
        applies=("source", ("pose_array",)),
    )
    body: str | None = setting(
        description="name of the body: a tf frame, an OpenIGTLink device, a topic of a bag, a "
        "transform of a tracker recording",
        default=None,
        applies=("source", ("tf", "openigtlink", "path")),
    )
    file: str | None = setting(
        description="bag, or tracker recording of Plus",
        default=None,
        file=True,
        applies=("source", ("path",)),
    )
    registration: Placement | str | None = setting(
        description="the device's frame in `patient`: a file of `us-sim calibrate`, or a pose",
        default=None,
        file=True,
    )
    calibration: Placement | str | None = setting(
        description="the probe in the tracked body's frame, likewise", default=None, file=True
    )
    time_offset: float = setting(
        Quantity("time", -10.0, 10.0), "added to the stamps of the poses", default=0.0
    )
    coast_for: float = setting(
        Quantity("time", 1e-3, 60.0),
        "time without a pose after which the probe is `coasting`",
        default=0.3,
    )
    lost_after: float = setting(
        Quantity("time", 1e-3, 60.0), "time without a pose after which it is `lost`", default=1.0
    )
    filter: ChosenOption = setting(
        description="what smooths the poses", choice=FILTERS, default=ChosenOption("none")
    )
    gate: GateSettings | None = setting(description="which poses are refused", default=None)

    def check(self) -> None:
        """Require that a probe coasts before it is lost."""
        if self.lost_after < self.coast_for:
            raise self.make_error(
                "lost_after",
                f"{self.lost_after:g} s is less than coast_for, {self.coast_for:g} s: a probe "
                f"coasts before it is lost",
            )


@dataclass(frozen=True)
class ImagingSettings(Imaging):
    """The console's settings, and the acoustics of the tissue."""

    acoustics: Acoustics = setting(
        description="artefacts of sound, and the acoustic constants of tissues", default=Acoustics()
    )


@dataclass(frozen=True)
class Part:
    """A node of the graph that this scene needs or not, and why."""

    node: str
    needed: bool
    reason: str


@dataclass(frozen=True)
class Scene(Settings):
    """A whole scene.

    Examples:
        >>> from us_sim.scene.reading import load_scene
        >>> scene = load_scene("tests/small_scene.yaml")
        >>> [part.node for part in scene.list_parts() if part.needed]
        ['probe_tracker', 'tissue_deformer', 'skin_deformer', 'slice_interpolator']
    """

    error = SceneError

    name: str = setting(description="of the scene")
    volume: VolumeSettings = setting(description="the ultrasound volume")
    probe: ProbeSettings = setting(description="the transducer")
    tissue: TissueSettings | None = setting(description="what deforms", default=None)
    structures: Mapping[str, StructureSettings] = setting(
        description="surfaces that the tissue carries, by name; a list of labels will do",
        default_factory=dict,
    )
    skin: SkinSettings | None = setting(description="the skin membrane", default=None)
    slice: ChosenOption = setting(
        description="how the image is cut", choice=SLICERS, default=ChosenOption("scan_conversion")
    )
    imaging: ImagingSettings = setting(
        description="how echoes become grey values", default=ImagingSettings()
    )
    strain: StrainSettings = setting(
        description="strain images, where there is tissue and somebody subscribes",
        default=StrainSettings(),
    )
    colour: ColourSettings = setting(
        description="the box of colour Doppler, where a structure has a flow",
        default=ColourSettings(),
    )
    spectrum: SpectrumSettings = setting(
        description="the gate of pulsed-wave Doppler, where a structure has a flow",
        default=SpectrumSettings(),
    )
    m_mode: MModeSettings = setting(description="the line of M-mode", default=MModeSettings())
    tracker: TrackerSettings = setting(
        description="where poses come from", default=TrackerSettings()
    )
    episode: EpisodeSettings = setting(
        description="how robots and learners move the probe, and what differs between episodes",
        default=EpisodeSettings(),
    )
    path: str | None = setting(
        description="bag with a probe path, for the demo", default=None, file=True
    )
    description: str = setting(description="for a person", default="")
    exercise: str | None = setting(
        description="file of an exercise, or name of an installed one, which `scorer` follows",
        default=None,
    )
    case: str | None = setting(
        description="case, or its name, from which all is taken that the scene does not say",
        default=None,
        file=True,
    )
    origin: str = "scene"
    is_drawn: bool = field(default=False, compare=False)  # its seed, by chance

    def check(self) -> None:
        """Require sections that others need."""
        for key, user in (("tissue", "tissue"), ("skin", "skin")):
            if getattr(self, key) is not None and self.probe.collider is None:
                raise self.make_error(
                    "probe.collider", f"is missing, and the {user} needs one to press it"
                )
        if self.structures and self.tissue is None:
            raise self.make_error("structures", "need `tissue` to carry them, and it is missing")
        if self.strain != StrainSettings() and self.tissue is None:
            raise self.make_error("strain", "needs `tissue` to be strained, and it is missing")

    def list_parts(self) -> list[Part]:
        """List the simulation's nodes, each with the reason why it runs or is left out."""
        is_felt, felt = self.tracker.source.name == "haptic", ("tissue", "nothing can be felt")
        return [
            Part("probe_tracker", True, f"poses come from `{self.tracker.source.name}`"),
            _optional_part(
                "tissue_deformer", self.tissue, "tissue", "the volume is sliced rigidly"
            ),
            _optional_part("skin_deformer", self.skin, "skin", "no membrane is computed"),
            Part("slice_interpolator", True, self._describe_imaging()),
            *([_optional_part("haptic_renderer", self.tissue, *felt)] if is_felt else []),
            *([Part("scorer", True, f"the exercise is {self.exercise}")] if self.exercise else []),
        ]

    def compute_checksum(self) -> str:
        """Return 12 digits of a SHA-256 of all that is set but the seed, files by their content."""
        same = replace(self, origin="", volume=replace(self.volume, seed=0))
        document = json.dumps(_read_named_files(asdict(same)), default=str, sort_keys=True)
        return hashlib.sha256(document.encode()).hexdigest()[:12]

    @property
    def flows(self) -> dict[str, FlowSettings]:
        """Flows of the blood in structures, by the structures' names."""
        return {name: given.flow for name, given in self.structures.items() if given.flow}

    @property
    def ready_topics(self) -> list[str]:
        """Topics that are published once all of the scene's nodes are ready."""
        topics = ["probe/pose", "ultrasound/image"]
        topics += ["tissue/nodes"] if self.tissue else []
        return topics + (["skin/nodes"] if self.skin else [])

    def _describe_imaging(self) -> str:
        """Describe for a person how images are made."""
        own = self.imaging
        asked = [each.name for each in fields(Imaging) if getattr(own, each.name) != each.default]
        if self.imaging.acoustics.is_live:
            asked.append("artefacts along the beams")
        formed = f"formed with {', '.join(asked)}" if asked else "shown as they are cut"
        blood = f", with blood in {', '.join(self.flows)}" if self.flows else ""
        return f"{self.probe.geometry} images are cut by `{self.slice.name}`, {formed}{blood}"

    def solver_settings(self, name: str) -> Any:
        """Return the scene's settings of a solver, or None."""
        return self.tissue.settings.get(name) if self.tissue else None


def _read_named_files(value: Any) -> Any:
    """Return JSON-like values with digests of files in place of their paths, which may differ."""
    if isinstance(value, Mapping):
        return {str(key): _read_named_files(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_read_named_files(each) for each in value]
    if not isinstance(value, str) or not os.path.isabs(value):
        return value
    path = Path(value)
    is_readable = path.is_file() and os.access(path, os.R_OK)
    return hashlib.sha256(path.read_bytes()).hexdigest() if is_readable else path.name


def _optional_part(node: str, section: object | None, key: str, consequence: str) -> Part:
    if section is None:
        return Part(node, False, f"the scene has no `{key}`: {consequence}")
    return Part(node, True, f"the scene has `{key}`")
