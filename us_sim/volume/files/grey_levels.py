"""Numbers of any kind as grey values from 0 to 255, image by image.

Whole numbers of 8 bits are taken as they are. All others are spread, so that the least finite one
becomes 0 and the greatest 255; what is no number becomes 0, and infinities the end on their side.

>>> import numpy as np
>>> from us_sim.volume.files.grey_levels import GreyLevels
>>> images = [np.array([[-100, 0]]), np.array([[100, 50]])]
>>> levels = GreyLevels.over("a.nrrd", images)
>>> [levels(image).tolist() for image in images]
[[[0, 128]], [[255, 191]]]
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError


@dataclass(frozen=True)
class GreyLevels:
    """What becomes black and what becomes white."""

    low: float = 0.0
    high: float = 255.0
    missing: int = 0  # how many are no numbers
    infinite: int = 0  # how many are +Inf or -Inf

    @classmethod
    def over(cls, path: Path | str, images: Iterable[NDArray[Any]]) -> GreyLevels:
        """The levels of images, read once; errors name the path.

        Raises:
            VolumeError: there is no finite value.
        """
        low, high, missing, infinite = math.inf, -math.inf, 0, 0
        for image in images:
            values = image
            if image.dtype.kind == "f":
                missing += int(np.count_nonzero(np.isnan(image)))
                infinite += int(np.count_nonzero(np.isinf(image)))
                values = image[np.isfinite(image)]
            if values.size:
                low, high = min(low, float(values.min())), max(high, float(values.max()))
        if low > high:
            raise VolumeError(f"{path}: holds no finite value")
        return cls(low, high, missing, infinite)

    def __call__(self, image: NDArray[Any]) -> NDArray[np.uint8]:
        """An image as grey values."""
        if image.dtype == np.uint8 and (self.low, self.high) == (0.0, 255.0):
            return np.array(image, dtype=np.uint8)
        # Halves, since the whole range of a float64 image may exceed what float64 can hold.
        height = image.astype(np.float64) / 2 - self.low / 2
        level = height / ((self.high / 2 - self.low / 2) or 1.0)
        level = np.clip(np.nan_to_num(level, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)
        return np.asarray(np.floor(level * 255.0 + 0.5).astype(np.uint8))

    def said(self, bits: int) -> list[str]:
        """What is made of the numbers, for a person."""
        said = [f"{bits}-bit values spread over 0 to 255"]
        if self.missing:
            said.append(f"{self.missing} values that are no number are black")
        if self.infinite:
            said.append(f"{self.infinite} infinite values are white (+Inf) or black (-Inf)")
        return said
