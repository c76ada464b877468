"""Settings of an import, and the rectangle of pixels that it may keep."""

from __future__ import annotations

import re
from dataclasses import dataclass

from us_sim.errors import VolumeError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting


@dataclass(frozen=True)
class Rectangle:
    """From a first column and row to last ones that belong to it, as in DICOM's regions."""

    left: int
    top: int
    right: int
    bottom: int

    @classmethod
    def read(cls, text: str) -> Rectangle:
        """From ``X0,Y0,X1,Y1``.

        Raises:
            ValueError: it is written otherwise, or holds no pixel.
        """
        words = [word.strip() for word in text.split(",")]
        if len(words) != 4 or not all(re.fullmatch(r"[0-9]{1,5}", word) for word in words):
            raise ValueError(
                f"{text[:80]!r} is no rectangle; write X0,Y0,X1,Y1: its first column and row and "
                f"its last ones, counted from 0"
            )
        made = cls(*map(int, words))
        if min(made.size) < 1:
            raise ValueError(f"{text[:80]!r} holds no pixel: X1 and Y1 are the last ones")
        return made

    @property
    def size(self) -> tuple[int, int]:
        """Columns and rows."""
        return self.right - self.left + 1, self.bottom - self.top + 1

    @property
    def slices(self) -> tuple[slice, slice]:
        """Of (rows, columns)."""
        return slice(self.top, self.bottom + 1), slice(self.left, self.right + 1)

    def common(self, other: Rectangle) -> Rectangle | None:
        """Return the part that both have; None where they have none."""
        left, top = max(self.left, other.left), max(self.top, other.top)
        right, bottom = min(self.right, other.right), min(self.bottom, other.bottom)
        return Rectangle(left, top, right, bottom) if left <= right and top <= bottom else None

    def __str__(self) -> str:
        return f"{self.left},{self.top},{self.right},{self.bottom}"


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
        description="X,Y,Z: mm between voxels, or X,Y between pixels, of files that do not say it",
        default=None,
    )
    name: str | None = setting(
        description="of a new case; never the patient's; not given: the name of its folder",
        default=None,
    )

    def check(self) -> None:
        """Refuse a crop that is no rectangle, and a spacing that is none."""
        if self.crop is not None:
            try:
                Rectangle.read(self.crop)
            except ValueError as error:
                raise self.refused("crop", str(error)) from error
        if self.spacing is not None and not self.spacing_mm:
            raise self.refused("spacing", "is no two or three numbers of mm; write 0.3,0.3,1")

    @property
    def spacing_mm(self) -> tuple[float, ...]:
        """(3,) or (2,) mm, of files that do not state it; empty where it is not given."""
        try:
            found = tuple(float(word) for word in (self.spacing or "").split(","))
        except ValueError:
            return ()
        return found if len(found) in (2, 3) and all(1e-4 <= each <= 100 for each in found) else ()

    @property
    def part(self) -> Rectangle | None:
        """The rectangle that is kept."""
        return None if self.crop is None else Rectangle.read(self.crop)
