"""Structures up to the strongest edge between their seeds and others: the watershed from markers.

S. Beucher and F. Meyer, "The morphological approach to segmentation: the watershed transformation",
1993; ITK's MorphologicalWatershedFromMarkers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting
from us_sim.volume.segmentation.region import Index, Region, array_of, image_of

_LENGTH = Quantity("length", 0.0, 0.05)
_INSIDE, _OUTSIDE = 1, 2


@dataclass(frozen=True)
class Watershed(Settings):
    """From the seeds up to the strongest edge before what is outside.

    Outside are `outside_mm`, the seeds of other structures, and the border of what is looked at.
    """

    error = VolumeError

    marker: float = setting(
        _LENGTH, "radius of a ball around each seed that is in it", default=1e-3
    )
    edge: float = setting(
        Quantity("length", 1e-4, 0.02), "width of the edges that are looked for", default=1e-3
    )
    border: bool = setting(
        description="what lies at the border of the region, or has no data, is outside",
        default=True,
    )

    def found_in(self, region: Region) -> NDArray[np.bool_]:
        """(i, j, k) where the structure is.

        Raises:
            VolumeError: there is no seed, or nothing to tell it from.
        """
        region.need_seeds("watershed")
        if not (self.border or region.outside):
            raise VolumeError(
                f"structures.{region.name}: watershed needs something outside: give `outside_mm`, "
                f"another structure with seeds, or `border: true`"
            )
        markers = np.zeros(region.grey.shape, np.uint8)
        if self.border:
            for axis in range(3):
                face = np.moveaxis(markers, axis, 0)
                face[0] = face[-1] = _OUTSIDE
        for seed in region.outside:
            self._mark(markers, region, seed, _OUTSIDE)
        for seed in region.seeds:
            self._mark(markers, region, seed, _INSIDE)
        edges = sitk.GradientMagnitudeRecursiveGaussian(region.image, self.edge * 1e3)
        flooded = sitk.MorphologicalWatershedFromMarkers(
            edges, image_of(markers, region.spacing), markWatershedLine=False
        )
        return array_of(flooded) == _INSIDE

    def _mark(self, markers: NDArray[np.uint8], region: Region, seed: Index, mark: int) -> None:
        """Put a ball around a seed into markers."""
        reach = np.floor(self.marker / region.spacing).astype(int)
        first = np.maximum(np.array(seed) - reach, 0)
        last = np.minimum(np.array(seed) + reach + 1, markers.shape)
        box = tuple(slice(a, b) for a, b in zip(first, last, strict=True))
        grid = np.meshgrid(*[np.arange(s.start, s.stop) for s in box], indexing="ij")
        away = np.stack(grid, axis=-1) - np.array(seed)
        near = np.linalg.norm(away * region.spacing, axis=-1) <= self.marker
        markers[box][near] = mark
