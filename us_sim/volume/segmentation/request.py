"""What is asked of `us-sim segment`: each field is an option of it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from us_sim.errors import VolumeError
from us_sim.settings.setting import Settings, setting
from us_sim.volume.structure_terms import problem_with
from us_sim.volume.surfaces.settings import SURFACE_FORMATS


@dataclass(frozen=True)
class SegmentRequest(Settings):
    """Structures of a case or of a volume file, and their surfaces.

    They come from a file of labels, from seeds, or from a search for vessels; without any of these
    the surfaces of the labels that a case has are made anew.
    """

    error = VolumeError

    case: Path = setting(description="folder of a case, or a volume file")
    labels: Path | None = setting(
        description="labels from this file: .seg.nrrd of 3D Slicer, NRRD, MHA or NIfTI",
        default=None,
    )
    label_table: Path | None = setting(
        description="names and colours of labels: .ctbl of 3D Slicer, ITK-SNAP's, or CSV",
        default=None,
    )
    names: tuple[str, ...] = setting(
        description="names of labels, such as 3=gallbladder", default=()
    )
    seeds: Path | None = setting(
        description="structures from seeds: this YAML file, or an installed one's name",
        default=None,
    )
    vessels: str | None = setting(
        description="propose vessels without seeds", choices=("dark",), default=None
    )
    resample: bool = setting(
        description="take the nearest voxel of labels on another grid", default=False
    )
    formats: tuple[str, ...] = setting(
        description="of the surfaces", choices=SURFACE_FORMATS, default=("stl",)
    )
    report: bool = setting(
        description="also write segmentation.md, with a table and what was remarked",
        default=False,
    )
    out: Path | None = setting(
        description="folder to make, where a volume file is segmented", default=None
    )

    def check(self) -> None:
        """Refuse several sources, options of one that is not asked for, and names that are none."""
        asked = [key for key in ("labels", "seeds", "vessels") if getattr(self, key) is not None]
        if len(asked) > 1:
            raise self.refused(asked[1], f"and --{asked[0]} are two sources of labels: keep one")
        for key in ("label_table", "names", "resample"):
            if getattr(self, key) and self.labels is None:
                raise self.refused(key, "is for --labels only")
        self.given_names()

    def given_names(self) -> dict[int, str]:
        """The names of labels that the person gives.

        Raises:
            VolumeError: one is not written NUMBER=NAME, is given twice, or is no name.
        """
        names: dict[int, str] = {}
        for text in self.names:
            match = re.fullmatch(r"(\d{1,3})=(.+)", text)
            if match is None or int(match[1]) not in range(1, 256):
                raise self.refused("names", f"{text!r}: write LABEL=NAME, e.g. 3=gallbladder")
            if problem := problem_with(match[2]):
                raise self.refused("names", f"{text!r}: the name {problem}")
            if int(match[1]) in names or match[2] in names.values():
                raise self.refused("names", f"{text!r}: label or name is given twice")
            names[int(match[1])] = match[2]
        return names
