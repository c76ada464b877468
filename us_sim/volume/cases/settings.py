"""The keys of ``case.yaml``: the body part, its structures, and how to scan it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from us_sim.errors import CaseError
from us_sim.geometry.pose import Placement
from us_sim.geometry.transducer import ProbeSettings
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting
from us_sim.settings.spelling import describe_unknown, short_repr
from us_sim.tissue.elasticity.material import KINDS, Material, guess_tissue_kind
from us_sim.volume.structure_names import AROUND, Colour, choose_colour

SLIDE = 8e-3  # m, that the proposed path slides and comes back where nothing else is said

_LONGEST_NAME = 80
_FACES = ("top", "bottom", "left", "right", "front", "back", "sides")
RESERVED = (AROUND, *_FACES)  # names that no structure has


def check_name(name: str) -> str | None:
    """Return the problem with the name of a case or of a structure, which become names of files."""
    if not name.strip() or len(name) > _LONGEST_NAME or not name.isprintable():
        return f"{short_repr(name)}: a name has 1 to {_LONGEST_NAME} printable characters"
    if set(name) & set('/\\:*?"<>|') or name.startswith(".") or name != name.strip():
        return f"{short_repr(name)}: a name is no path: use letters, digits, blanks, - and _"
    return None


def _material(given: Material | str | None, name: str) -> Material:
    if isinstance(given, Material):
        return given
    return KINDS[given if given is not None else guess_tissue_kind(name)]


@dataclass(frozen=True)
class CaseStructure(Settings):
    """One structure of a case: a label of ``labels.nrrd``."""

    section = "structures"
    error = CaseError

    label: int = setting(Quantity("number", 1, 255), "its number in `labels.nrrd`")
    material: Material | str | None = setting(
        description="elastic constants, or a kind of tissue; not given: what its name suggests",
        choices=tuple(KINDS),
        default=None,
    )
    colour: Colour | None = setting(
        Quantity("number", 0.0, 1.0),
        "red, green, blue; not given: what its name suggests",
        default=None,
    )


@dataclass(frozen=True)
class CaseStart(Placement):
    """The pose at which a press begins."""

    section = "start"
    error = CaseError

    proposed: bool = setting(
        description="whether us_sim has found it; then it moves to where structures are once there "
        "are some",
        default=False,
    )


@dataclass(frozen=True)
class CaseSettings(Settings):
    """A case: the keys of its ``case.yaml``."""

    error = CaseError

    name: str = setting(description="of the case; never the patient's")
    region: str = setting(description="of the body: `abdomen`", default="")
    description: str = setting(description="for a person", default="")
    probe: ProbeSettings | None = setting(
        description="transducer that it is best scanned with", default=None
    )
    start: CaseStart | None = setting(
        description="pose of the probe where it touches the skin, in the volume's own frame; not "
        "given: found from the volume",
        default=None,
    )
    press: float | None = setting(
        Quantity("length", 0.0, 0.1),
        "how deep the proposed path presses; not given: a third of the image, 22 mm at most",
        default=None,
    )
    around: Material | str = setting(
        description="elastic constants, or a kind of tissue, of what is in no structure",
        choices=tuple(KINDS),
        default="tissue",
    )
    structures: Mapping[str, CaseStructure] = setting(
        description="labels of `labels.nrrd`, by name", default_factory=dict
    )
    nodes: int = setting(
        Quantity("number", 64, 200_000), "that the mesh of its tissue has at most", default=3000
    )
    fixed: tuple[str, ...] = setting(
        description="faces (bottom, sides, ...) and structures that are held; not given: the "
        "bottom, and structures of bone",
        default=(),
    )
    scanned: tuple[Placement, ...] = setting(
        description="poses of the probe along the sweep that the volume was made of, in the "
        "volume's own frame; a proposed start is one of them",
        default=(),
    )
    slide: float | None = setting(
        Quantity("length", -0.05, 0.05),
        "how far it slides along the probe's y, and rocks with it; not given: 8 mm",
        default=None,
    )

    def check(self) -> None:
        """Refuse names that no file can have, reserved names, and labels of two structures."""
        if problem := check_name(self.name):
            raise self.make_error("name", problem)
        seen: dict[int, str] = {}
        for name, structure in self.structures.items():
            if problem := check_name(name):
                raise self.make_error("structures", problem)
            if name in RESERVED:
                raise self.make_error(
                    f"structures.{name}", "means something else already: choose another name"
                )
            if structure.label in seen:
                raise self.make_error(
                    f"structures.{name}.label",
                    f"{structure.label} is `{seen[structure.label]}` already: merge the two, or "
                    f"give one of them a label of its own",
                )
            seen[structure.label] = name
        for i, name in enumerate(self.fixed):
            if name not in (*_FACES, *self.structures):
                raise self.make_error(
                    f"fixed[{i}]", describe_unknown(name, (*_FACES, *self.structures))
                )

    def material_of(self, name: str) -> Material:
        """Elastic constants of a structure, or of the tissue around them all (`AROUND`)."""
        if name == AROUND:
            return _material(self.around, AROUND)
        return _material(self.structures[name].material, name)

    def colour_of(self, name: str) -> Colour:
        """Red, green and blue of a structure."""
        return self.structures[name].colour or choose_colour(name)

    @property
    def held(self) -> tuple[str, ...]:
        """Faces and structures that do not move."""
        if self.fixed:
            return self.fixed
        bones = [name for name in self.structures if self.material_of(name) == KINDS["bone"]]
        return ("bottom", *bones)

    @property
    def label_names(self) -> dict[int, str]:
        """The structures by the labels' numbers, 0 included."""
        return {0: AROUND} | {one.label: name for name, one in self.structures.items()}
