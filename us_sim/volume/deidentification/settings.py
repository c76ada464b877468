"""What an import can be told."""

from __future__ import annotations

from dataclasses import dataclass

from us_sim.errors import VolumeError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting
from us_sim.volume.deidentification.rectangle import Rectangle

__all__ = ["ImportSettings"]


@dataclass(frozen=True)
class ImportSettings(Settings):
    """What of scanners' images goes on."""

    error = VolumeError

    crop: str | None = setting(
        description="X0,Y0,X1,Y1: only these columns and rows of every image, the last ones "
        "included",
        default=None,
    )
    keep_whole_image: bool = setting(
        description="keep all of every image: nothing is burned in", default=False
    )
    blank_text: bool = setting(
        description="blank what may be text within what is kept, too; look at the picture of "
        "--report first",
        default=False,
    )
    volume: int = setting(
        Quantity("number", 1, 10000), "which one where there are several in time", default=1
    )
    name: str | None = setting(
        description="of a new case; never the patient's; not given: the name of its folder",
        default=None,
    )

    def check(self) -> None:
        """Either a part is kept or all."""
        if self.crop is not None:
            if self.keep_whole_image:
                raise self.refused("crop", "cannot be given with --keep-whole-image; keep one")
            try:
                Rectangle.read(self.crop)
            except VolumeError as error:
                raise self.refused("crop", str(error).removeprefix("crop: ")) from error

    @property
    def part(self) -> Rectangle | None:
        """The rectangle that is kept."""
        return None if self.crop is None else Rectangle.read(self.crop)
