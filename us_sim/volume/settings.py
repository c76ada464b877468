"""The settings of the ultrasound volume in a scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from us_sim.errors import VolumeError
from us_sim.geometry.pose import Placement
from us_sim.settings.quantity import Quantity
from us_sim.settings.registry import PHANTOMS
from us_sim.settings.setting import Settings, setting

SEED = Quantity("number", 0, 2**31)
VOXEL_SIZE = Quantity("length", 2e-4, 5e-3)
"""Voxel size of a phantom; the finest takes 1.1 GB while it is made."""


@dataclass(frozen=True)
class VolumeSettings(Settings):
    """The ultrasound volume: a file, a case, or a procedural phantom made from a seed."""

    section = "volume"
    error = VolumeError
    alternatives = MappingProxyType({"file": (), "case": (), "phantom": ("seed", "voxel_size")})

    file: str | None = setting(description="MHA, NRRD, NIfTI or DICOM", default=None, file=True)
    case: str | None = setting(
        description="case, or its name, in place of a file: its volume and its labels",
        default=None,
        file=True,
    )
    phantom: str | None = setting(
        description="procedural phantom in place of a file", choice=PHANTOMS, default=None
    )
    seed: int = setting(SEED, "of the phantom", default=1)
    voxel_size: float = setting(VOXEL_SIZE, "of the phantom", default=0.3e-3)
    pose: Placement = setting(
        description="of the volume's own frame in `patient`", default=Placement()
    )

    def check(self) -> None:
        """Refuse several of a file, a case and a phantom, or none."""
        given = [key for key in ("file", "case", "phantom") if getattr(self, key)]
        if len(given) > 1:
            raise self.make_error("", f"has both `{given[0]}` and `{given[1]}`; keep one")
        if not given:
            raise self.make_error(
                "file", "is missing; name a file in the scene file, or give one with --volume"
            )

    @property
    def name(self) -> str:
        """The file's name, the case's or the phantom's, for a person."""
        if self.case:
            return f"case {Path(self.case).name}"
        return Path(self.file).name if self.file else f"phantom {self.phantom}, seed {self.seed}"
