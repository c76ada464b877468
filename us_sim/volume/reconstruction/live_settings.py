"""What can be set of a volume that grows while a probe scans."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting
from us_sim.volume.reconstruction.settings import METHODS

LIVE_COMPOUNDINGS = ("mean", "max", "latest")
"""Those that need no image twice."""

_PLACE = Quantity("length", -100.0, 100.0)
_VOLUMES = (".nrrd", ".mha", ".nii", ".nii.gz")


@dataclass(frozen=True)
class LiveBox(Settings):
    """The box that is filled, and how."""

    error = VolumeError

    lower: tuple[float, float, float] = setting(
        _PLACE, "corner of the box in frame `patient`", default=(-0.06, -0.06, -0.01)
    )
    upper: tuple[float, float, float] = setting(
        _PLACE, "its opposite corner", default=(0.06, 0.06, 0.11)
    )
    spacing: float = setting(Quantity("length", 1e-5, 0.02), "side of a voxel", default=0.5e-3)
    method: str = setting(description="of insertion", choices=METHODS, default="nearest")
    compounding: str = setting(
        description="of several pixels in one voxel", choices=LIVE_COMPOUNDINGS, default="mean"
    )
    hole_radius: float = setting(
        Quantity("length", 0.0, 0.05), "of the largest hole that is filled", default=1e-3
    )

    def check(self) -> None:
        """Refuse a box that is inside out."""
        for low, high in zip(self.lower, self.upper, strict=True):
            if not low < high:
                raise self.refused("upper", "must lie beyond `lower` along each axis")


@dataclass(frozen=True)
class LiveVolume(Settings):
    """Where the volume goes, and where the pixels of an image lie on the probe."""

    error = VolumeError

    file: str = setting(
        description="to save to: .nrrd, .mha or .nii.gz; a number is added where it is taken",
        default="volume.nrrd",
    )
    pixel_size: tuple[float, float] = setting(
        Quantity("length", 1e-6, 0.01),
        "of an image, across and down, until `ultrasound/image_to_probe` says it",
        default=(0.2e-3, 0.2e-3),
    )
    first_pixel: tuple[float, float] = setting(
        Quantity("length", -1.0, 1.0),
        "where the first one lies in frame `probe`, along x and z, likewise",
        default=(0.0, 0.0),
    )

    def check(self) -> None:
        """Refuse a file that could not be written at the end."""
        if not self.file.lower().endswith(_VOLUMES):
            raise self.refused("file", f"{self.file}: must end in {', '.join(_VOLUMES)}")

    @property
    def image_to_probe(self) -> NDArray[np.float64]:
        """(4, 4) m, from (column, row, 0, 1) to frame ``probe``."""
        across, down = self.pixel_size
        matrix = np.zeros((4, 4))
        matrix[0, 0], matrix[1, 2], matrix[2, 1], matrix[3, 3] = across, across, down, 1.0
        matrix[0, 3], matrix[2, 3] = self.first_pixel
        return matrix
