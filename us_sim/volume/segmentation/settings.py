"""Settings of a segmentation: the options of `us-sim segment`, and the files of seeds."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from us_sim.errors import VolumeError
from us_sim.settings.quantity import Quantity
from us_sim.settings.reading import SettingsReader
from us_sim.settings.setting import Settings, setting
from us_sim.settings.text_files import read_yaml
from us_sim.volume.cases.settings import check_name

_MOST = 255
_MILLIMETRES = Quantity("number", -1e5, 1e5)
_GREY = Quantity("number", 0.0, 255.0)
_RADIUS = Quantity("length", 0.0, 0.05)

_Point = tuple[float, float, float]


@dataclass(frozen=True)
class StructureSeeds(Settings):
    """One structure: what is connected with its seeds through grey values in a range."""

    section = "structures"
    error = VolumeError

    seeds_mm: tuple[_Point, ...] = setting(
        _MILLIMETRES, "points in it, left-posterior-superior, mm"
    )
    lower: float = setting(_GREY, "least grey value", default=0.0)
    upper: float = setting(_GREY, "largest grey value", default=255.0)
    reach: float | None = setting(
        Quantity("length", 1e-3, 1.0),
        "what is farther from all seeds is not looked at; not given: all is",
        default=None,
    )
    smooth: float = setting(
        Quantity("length", 0.0, 0.02),
        "standard deviation of the Gaussian that smooths grey values before, 0 for none",
        default=0.0,
    )
    open: float = setting(
        _RADIUS, "what a ball of this radius has no room in is left out", default=0
    )
    close: float = setting(
        _RADIUS, "gaps that a ball of this radius has no room in are filled", default=0
    )

    def check(self) -> None:
        """Refuse no seeds, and a range that holds nothing."""
        if not self.seeds_mm:
            raise self.make_error("seeds_mm", "is empty; give a point in it")
        if self.lower > self.upper:
            raise self.make_error(
                "upper", f"{self.upper:g} is below lower, {self.lower:g}: swap them"
            )


@dataclass(frozen=True)
class SegmentationSettings(Settings):
    """The structures of a volume by name, in the order of their labels; of two the first stays."""

    error = VolumeError

    structures: Mapping[str, StructureSeeds] = setting(
        description="how each is found, by name; artery, vein, nerve and bone get their colours"
    )
    description: str = setting(description="for a person", default="")

    def check(self) -> None:
        """Refuse no structures, too many, and names that are none."""
        if not 1 <= len(self.structures) <= _MOST:
            raise self.make_error("structures", f"are {len(self.structures)}; give 1 to {_MOST}")
        for name in self.structures:
            if problem := check_name(name):
                raise self.make_error("structures", problem)


def read_seeds(path: Path) -> SegmentationSettings:
    """Read a file of seeds.

    Raises:
        VolumeError: it cannot be read, or a key or value will not do.
    """
    document = read_yaml(path, VolumeError)
    return SettingsReader(str(path), None, VolumeError).read(SegmentationSettings, document)


@dataclass(frozen=True)
class SegmentRequest(Settings):
    """Structures of a case, and their surfaces.

    They come from a file of labels or from seeds; without either the surfaces of the labels that a
    case has are made anew.
    """

    error = VolumeError

    case: Path = setting(description="folder of a case")
    labels: Path | None = setting(
        description="labels from this file: .seg.nrrd of 3D Slicer, NRRD, MHA or NIfTI",
        default=None,
    )
    names: tuple[str, ...] = setting(
        description="names of labels, such as 3=gallbladder", default=()
    )
    seeds: Path | None = setting(
        description="structures from seeds: this YAML file, or an installed one's name",
        default=None,
    )

    def check(self) -> None:
        """Refuse two sources, names without a file of labels, and names that are none."""
        if self.labels is not None and self.seeds is not None:
            raise self.make_error("seeds", "and --labels are two sources of labels: keep one")
        if self.names and self.labels is None:
            raise self.make_error("names", "is for --labels only")
        self.given_names()

    def given_names(self) -> dict[int, str]:
        """Return the names of labels that the person gives.

        Raises:
            VolumeError: one is not written NUMBER=NAME, is given twice, or is no name.
        """
        names: dict[int, str] = {}
        for text in self.names:
            match = re.fullmatch(r"(\d{1,3})=(.+)", text)
            if match is None or int(match[1]) not in range(1, 256):
                raise self.make_error("names", f"{text!r}: write LABEL=NAME, e.g. 3=gallbladder")
            if problem := check_name(match[2]):
                raise self.make_error("names", problem)
            if int(match[1]) in names or match[2] in names.values():
                raise self.make_error("names", f"{text!r}: label or name is given twice")
            names[int(match[1])] = match[2]
        return names
