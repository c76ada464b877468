"""The settings of the ultrasound volume in a scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from us_sim.errors import VolumeError
from us_sim.geometry.placement import Placement
from us_sim.settings.quantity import Quantity
from us_sim.settings.registry import PHANTOMS
from us_sim.settings.setting import Settings, setting

__all__ = ["SEED", "VOXEL_SIZE", "VolumeSettings"]

SEED = Quantity("number", 0, 2**31)
VOXEL_SIZE = Quantity("length", 2e-4, 5e-3)
"""Voxel size of a phantom; the finest takes 1.1 GB while it is made."""


@dataclass(frozen=True)
class VolumeSettings(Settings):
    """The ultrasound volume: a file, or a procedural phantom made from a seed."""

    section = "volume"
    error = VolumeError
    alternatives = MappingProxyType({"file": (), "phantom": ("seed", "voxel_size")})

    file: str | None = setting(description="MHA, NRRD or NIfTI", default=None, file=True)
    phantom: str | None = setting(
        description="procedural phantom in place of a file", choice=PHANTOMS, default=None
    )
    seed: int = setting(SEED, "of the phantom", default=1)
    voxel_size: float = setting(VOXEL_SIZE, "of the phantom", default=0.3e-3)
    pose: Placement = setting(
        description="of the volume's own frame in `patient`", default=Placement()
    )

    def check(self) -> None:
        """Refuse both a file and a phantom, or neither."""
        if self.file and self.phantom:
            raise self.refused("", "has both `file` and `phantom`; keep one")
        if not self.file and not self.phantom:
            raise self.refused("file", "is missing; name a file there, or give one with --volume")

    @property
    def name(self) -> str:
        """The file's name or the phantom's, for a person."""
        return Path(self.file).name if self.file else f"phantom {self.phantom}, seed {self.seed}"
