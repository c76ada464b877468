"""The part of a volume that is looked at for one structure, as SimpleITK takes it.

>>> import numpy as np
>>> from us_sim.volume.segmentation.region import Region
>>> grey = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
>>> region = Region(grey, np.array([0.5e-3, 1e-3, 1e-3]), ((1, 2, 3),), (), "vein")
>>> region.image.GetSize(), region.image.GetSpacing(), region.image[1, 2, 3]
((2, 3, 4), (0.5, 1.0, 1.0), 23.0)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray

from us_sim.errors import VolumeError

Index = tuple[int, int, int]


@dataclass(frozen=True, eq=False)
class Region:
    """Grey values around a structure's seeds."""

    grey: NDArray[np.float32]  # (i, j, k), 0 to 255, smoothed as was asked
    spacing: NDArray[np.float64]  # (3,) m
    seeds: tuple[Index, ...]  # in the structure, each once
    outside: tuple[Index, ...]  # known not to be in it
    name: str  # of the structure, for sentences
    progress: Callable[[float, str], None] = lambda *_: None
    """Is told the fraction done, and what is being done, by what takes long."""

    @cached_property
    def image(self) -> sitk.Image:
        """The same for SimpleITK, in millimetres, its axes along the grid's."""
        return image_of(self.grey, self.spacing)

    def need_seeds(self, method: str) -> None:
        """Refuse a structure without seeds.

        Raises:
            VolumeError: it has none.
        """
        if not self.seeds:
            raise VolumeError(
                f"structures.{self.name}: {method} needs seeds: give `seeds_mm` or `seeds_voxel`"
            )


def image_of(array: NDArray[np.generic], spacing: NDArray[np.float64]) -> sitk.Image:
    """An image of an array (i, j, k) with that spacing (3,) in m."""
    image = sitk.GetImageFromArray(np.ascontiguousarray(array.transpose(2, 1, 0)))
    image.SetSpacing((np.asarray(spacing) * 1e3).tolist())
    return image


def array_of(image: sitk.Image) -> NDArray[np.generic]:
    """The array (i, j, k) of an image."""
    return np.asarray(sitk.GetArrayFromImage(image).transpose(2, 1, 0))
