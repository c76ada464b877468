"""Settings of freehand reconstructions."""

from __future__ import annotations

from dataclasses import dataclass

from us_sim.errors import VolumeError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting

_PIXEL = Quantity("image distance", -1e5, 1e5)


@dataclass(frozen=True)
class Compounding(Settings):
    """The way in which the pixels of many images become voxels."""

    error = VolumeError

    spacing: float | None = setting(
        Quantity("length", 1e-5, 0.02),
        "side of a voxel; not given: that of a pixel, or coarser for 134 million voxels at most",
        default=None,
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
            raise self.make_error(missing[0], "is missing; a fan has origin, radius and angles")
        for name in ("fan_radius", "fan_angles"):
            pair = getattr(self, name)
            if pair is not None and not pair[0] < pair[1]:
                raise self.make_error(name, f"{pair[0]:g} must be less than {pair[1]:g}")
        if self.clip is not None and min(self.clip[2:]) <= 0.0:
            raise self.make_error("clip", "must have columns and rows above zero")
