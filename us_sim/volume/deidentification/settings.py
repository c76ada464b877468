"""Settings of an import, and the rectangle of pixels that it may keep."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import NamedTuple

from us_sim.errors import VolumeError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting


class PixelRectangle(NamedTuple):
    """From a first column and row to last ones that belong to it, as in DICOM's regions."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows."""
        return self.right - self.left + 1, self.bottom - self.top + 1

    @property
    def slices(self) -> tuple[slice, slice]:
        """Slices that cut the rectangle out of an image (rows, columns)."""
        return slice(self.top, self.bottom + 1), slice(self.left, self.right + 1)

    def intersect(self, other: PixelRectangle) -> PixelRectangle | None:
        """Return the part that both have; None where they have none."""
        first, last = map(max, self[:2], other[:2]), map(min, self[2:], other[2:])
        made = PixelRectangle(*first, *last)
        return made if min(made.size) > 0 else None

    def __str__(self) -> str:
        return ",".join(map(str, self))


@dataclass(frozen=True)
class ImportSettings(Settings):
    """The part of scanners' images that goes on."""

    error = VolumeError

    crop: str | None = setting(
        description="X0,Y0,X1,Y1: only these columns and rows of every image, the last ones "
        "included",
        default=None,
    )
    keep_whole_image: bool = setting(
        description="keep what lies outside the ultrasound regions, too: nothing is burned in",
        default=False,
    )
    volume: int = setting(
        Quantity("number", 1, 10000), "which one where there are several in time", default=1
    )
    spacing: str | None = setting(
        description="X,Y,Z: mm between voxels, of files that do not say it", default=None
    )

    def check(self) -> None:
        """Refuse a crop that is no rectangle, and a spacing that is none."""
        if self.crop is not None and (self.part is None or min(self.part.size) < 1):
            why = "is no rectangle with a pixel; write X0,Y0,X1,Y1, the last ones included"
            raise self.make_error("crop", why)
        if self.spacing is not None and not self.spacing_mm:
            raise self.make_error("spacing", "is no three numbers of mm; write 0.3,0.3,1")

    @property
    def spacing_mm(self) -> tuple[float, ...]:
        """(3,) mm, of files that do not state it; empty where it is not given."""
        try:
            found = tuple(float(word) for word in (self.spacing or "").split(","))
        except ValueError:
            return ()
        return found if len(found) == 3 and all(1e-4 <= each <= 100 for each in found) else ()

    @property
    def part(self) -> PixelRectangle | None:
        """The rectangle that is kept."""
        words = re.fullmatch(r"\s*(\d+)\s*,\s*(\d+)\s*,\s*(\d+)\s*,\s*(\d+)\s*", self.crop or "")
        return PixelRectangle(*map(int, words.groups())) if words else None
