"""Settings of freehand reconstructions: of a sweep, and live while a probe scans."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting

METHODS = ("nearest", "linear")
"""How a pixel is inserted: into the nearest voxel, or into the eight around it by their weights."""

COMPOUNDINGS = ("mean", "median", "max", "latest", "plus_mean")
"""Combinations of several pixels in one voxel; ``plus_mean`` is Plus' running mean, which is made
a whole number after every pixel and so comes out 2 grey levels darker."""

_PIXEL = Quantity("image distance", -1e5, 1e5)


@dataclass(frozen=True)
class Compounding(Settings):
    """How the pixels of many images become voxels."""

    error = VolumeError

    spacing: float | None = setting(
        Quantity("length", 1e-5, 0.02),
        "side of a voxel; not given: that of a pixel, or coarser for 134 million voxels at most",
        default=None,
    )
    method: str = setting(description="of insertion", choices=METHODS, default="linear")
    compounding: str = setting(
        description="of several pixels in one voxel", choices=COMPOUNDINGS, default="mean"
    )
    plus_rounding: bool = setting(
        description="round the places of pixels as Plus does, to 1/16384 of a voxel: for "
        "comparison with its volumes",
        default=False,
    )
    hole_radius: float | None = setting(
        Quantity("length", 0.0, 0.05),
        "of the largest hole between voxels that pixels hit that is filled; 0: none; not given: "
        "two voxels",
        default=None,
    )


@dataclass(frozen=True)
class ImagePart(Settings):
    """The part of an image that is used, in pixels of the image turned to MF."""

    error = VolumeError

    clip: tuple[float, float, float, float] | None = setting(
        _PIXEL, "rectangle that is used: first column, first row, columns, rows", default=None
    )
    fan_origin: tuple[float, float] | None = setting(
        _PIXEL, "where the beams of a fan meet: column, row", default=None
    )
    fan_radius: tuple[float, float] | None = setting(
        Quantity("image distance", 0.0, 1e5), "where its beams begin and end", default=None
    )
    fan_angles: tuple[float, float] | None = setting(
        Quantity("angle", -3.2, 3.2),
        "its first and last beam, from straight down towards the image's right",
        default=None,
    )

    def check(self) -> None:
        """Refuse a fan of which something is missing or the wrong way round."""
        fan = {"fan_origin": self.fan_origin, "fan_radius": self.fan_radius}
        fan["fan_angles"] = self.fan_angles
        missing = [name for name, value in fan.items() if value is None]
        if 0 < len(missing) < len(fan):
            raise self.refused(missing[0], "is missing; a fan has origin, radius and angles")
        for name in ("fan_radius", "fan_angles"):
            pair = getattr(self, name)
            if pair is not None and not pair[0] < pair[1]:
                raise self.refused(name, f"{pair[0]:g} must be less than {pair[1]:g}")
        if self.clip is not None and min(self.clip[2:]) <= 0.0:
            raise self.refused("clip", "must have columns and rows above zero")


LIVE_COMPOUNDINGS = ("mean", "max", "latest")  # those that need no image twice

_PLACE = Quantity("length", -100.0, 100.0)
VOLUME_ENDINGS = (".nrrd", ".mha", ".nii", ".nii.gz")
"""Of the names of files that volumes are written to."""


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
        if not self.file.lower().endswith(VOLUME_ENDINGS):
            raise self.refused("file", f"{self.file}: must end in {', '.join(VOLUME_ENDINGS)}")

    @property
    def image_to_probe(self) -> NDArray[np.float64]:
        """(4, 4) m, from (column, row, 0, 1) to frame ``probe``."""
        across, down = self.pixel_size
        matrix = np.zeros((4, 4))
        matrix[0, 0], matrix[1, 2], matrix[2, 1], matrix[3, 3] = across, across, down, 1.0
        matrix[0, 3], matrix[2, 3] = self.first_pixel
        return matrix
