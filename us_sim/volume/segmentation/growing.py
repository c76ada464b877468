"""Structures by their grey values: thresholds, seeded growing, and growing by confidence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting
from us_sim.volume.segmentation.region import Region, array_of

_GREY = Quantity("number", 0.0, 255.0)


@dataclass(frozen=True)
class Threshold(Settings):
    """All voxels whose grey value lies in a range; with seeds, the parts that hold one."""

    error = VolumeError

    lower: float = setting(_GREY, "least grey value", default=0.0)
    upper: float = setting(_GREY, "largest grey value", default=255.0)

    def check(self) -> None:
        """Refuse a range that holds nothing."""
        if self.lower > self.upper:
            raise self.refused("upper", f"{self.upper:g} is below lower, {self.lower:g}: swap them")

    def found_in(self, region: Region) -> NDArray[np.bool_]:
        """(i, j, k) where the structure is."""
        return (region.grey >= self.lower) & (region.grey <= self.upper)


@dataclass(frozen=True)
class SeededGrowing(Threshold):
    """What hangs together with a seed through grey values in a range (ITK's ConnectedThreshold)."""

    def found_in(self, region: Region) -> NDArray[np.bool_]:
        """(i, j, k) where the structure is.

        Raises:
            VolumeError: there is no seed, or one lies outside the range.
        """
        region.need_seeds("growing")
        for number, seed in enumerate(region.seeds):
            value = float(region.grey[seed])
            if not self.lower <= value <= self.upper:
                raise VolumeError(
                    f"structures.{region.name}: seed {number + 1} has the grey value {value:.0f}, "
                    f"outside {self.lower:g} to {self.upper:g}, so nothing grows from it: move it, "
                    f"or widen the range"
                )
        grown = sitk.ConnectedThreshold(region.image, list(region.seeds), self.lower, self.upper)
        return array_of(grown).astype(bool)


@dataclass(frozen=True)
class ConfidenceConnected(Settings):
    """Growing into what is like what was grown: mean and deviation, several times over.

    It is ITK's ConfidenceConnected: the first mean is that around the seeds.
    """

    error = VolumeError

    multiplier: float = setting(
        Quantity("number", 0.1, 10.0), "deviations that still belong to it", default=2.5
    )
    iterations: int = setting(Quantity("number", 0, 50), "how often it grows anew", default=4)
    radius: int = setting(
        Quantity("number", 0, 20), "voxels around a seed that are taken for like it", default=2
    )

    def found_in(self, region: Region) -> NDArray[np.bool_]:
        """(i, j, k) where the structure is.

        Raises:
            VolumeError: there is no seed.
        """
        region.need_seeds("confidence")
        grown = sitk.ConfidenceConnected(
            region.image, list(region.seeds), self.iterations, self.multiplier, self.radius
        )
        return array_of(grown).astype(bool)
