"""Methods that find a structure: thresholds, growing, watershed, tubes, and the scanned part."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray
from scipy import ndimage

from us_sim.errors import VolumeError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting
from us_sim.volume.segmentation.region import (
    Index,
    Region,
    array_of,
    ball_closed,
    image_of,
    largest_part,
)

_GREY = Quantity("number", 0.0, 255.0)
_DIAMETER = Quantity("length", 2e-4, 0.05)
_INSIDE, _OUTSIDE = 1, 2


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
    """The part connected with a seed through grey values in a range (ITK's ConnectedThreshold)."""

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
    """Growing into voxels like the grown ones by mean and deviation, several times over.

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


@dataclass(frozen=True)
class Watershed(Settings):
    """From the seeds up to the strongest edge before what is outside.

    Outside are `outside_mm`, the seeds of other structures, and the border of what is looked at.
    S. Beucher and F. Meyer, "The morphological approach to segmentation: the watershed
    transformation", 1993; ITK's MorphologicalWatershedFromMarkers.
    """

    error = VolumeError

    marker: float = setting(
        Quantity("length", 0.0, 0.05),
        "radius of a ball around each seed that is in it",
        default=1e-3,
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
        for mark, seeds in ((_OUTSIDE, region.outside), (_INSIDE, region.seeds)):
            for seed in seeds:
                self._mark(markers, region, seed, mark)
        edges = sitk.GradientMagnitudeRecursiveGaussian(region.image, self.edge * 1e3)
        flooded = sitk.MorphologicalWatershedFromMarkers(
            edges, image_of(markers, region.spacing), markWatershedLine=False
        )
        return array_of(flooded) == _INSIDE

    def _mark(self, markers: NDArray[np.uint8], region: Region, seed: Index, mark: int) -> None:
        reach = np.floor(self.marker / region.spacing).astype(int)
        first = np.maximum(np.array(seed) - reach, 0)
        last = np.minimum(np.array(seed) + reach + 1, markers.shape)
        box = tuple(slice(a, b) for a, b in zip(first, last, strict=True))
        away = np.moveaxis(np.asarray(np.mgrid[box]), 0, -1) - np.array(seed)
        near = np.linalg.norm(away * region.spacing, axis=-1) <= self.marker
        markers[box][near] = mark


@dataclass(frozen=True)
class Vesselness(Settings):
    """Tubes that are darker (or brighter) than what is around them."""

    error = VolumeError

    bright: bool = setting(description="brighter than what is around, not darker", default=False)
    thinnest: float = setting(_DIAMETER, "least diameter of a tube", default=2e-3)
    thickest: float = setting(_DIAMETER, "largest diameter of a tube", default=8e-3)
    least: float = setting(
        Quantity("number", 0.0, 1.0), "response of a tube, of the strongest ones", default=0.2
    )

    def check(self) -> None:
        """Refuse diameters in the wrong order."""
        if self.thinnest > self.thickest:
            raise self.refused("thickest", "is less than thinnest: swap them")

    def found_in(self, region: Region) -> NDArray[np.bool_]:
        """(i, j, k) where the structure is."""
        scales = tube_scales(self.thinnest, self.thickest)
        response = tubeness(region.image, scales, bright=self.bright, progress=region.progress)
        there = response[response > 0]
        if not there.size:
            return np.zeros(response.shape, bool)
        # The strongest few are stray echoes.
        return np.asarray(response > self.least * np.percentile(there, 99.5))


def tube_scales(thinnest: float, thickest: float) -> NDArray[np.float64]:
    """Standard deviations, m, of Gaussians at which tubes of these diameters, m, respond most.

    They are the radius over √2, at most a factor of two apart.
    """
    count = int(np.ceil(np.log2(thickest / thinnest) - 1e-9)) + 1
    return np.geomspace(thinnest, thickest, count) / np.sqrt(8.0)


def tubeness(
    image: sitk.Image,
    scales: NDArray[np.float64],
    *,
    bright: bool,
    progress: Callable[[float, str], None] = lambda *_: None,
) -> NDArray[np.float32]:
    """(i, j, k) how much a tube the surroundings of each voxel are, the most of all scales (m).

    A. Frangi and others, "Multiscale vessel enhancement filtering", MICCAI 1998, as ITK's
    ObjectnessMeasure has it (L. Antiga, Insight Journal 2007): by the Hessian of grey values.
    """
    most = np.zeros(image.GetSize(), np.float32)
    for done, scale in enumerate(scales):
        sigma = float(scale * 1e3)
        progress(done / len(scales), f"tubes {sigma * np.sqrt(8.0):.1f} mm wide")
        smooth = sitk.SmoothingRecursiveGaussian(sitk.Cast(image, sitk.sitkFloat32), sigma)
        # A smooth image is as well known on a grid of its standard deviation, in less time.
        steps = [max(1, int(sigma / side)) for side in image.GetSpacing()]
        found = sitk.ObjectnessMeasure(
            sitk.Shrink(smooth, steps),
            alpha=0.5,
            beta=0.5,
            gamma=5.0,
            objectDimension=1,
            brightObject=bright,
        )
        if max(steps) > 1:
            found = sitk.Resample(found, smooth, sitk.Transform(), sitk.sitkLinear, 0.0)
        np.maximum(most, array_of(found).astype(np.float32) * sigma**2, out=most)
    return most


@dataclass(frozen=True)
class Covered(Settings):
    """All that has data: the largest part above a grey value, with its holes filled."""

    error = VolumeError

    lower: float = setting(_GREY, "least grey value of data", default=1.0)
    gap: float = setting(
        Quantity("length", 0.0, 0.02), "gaps up to twice as wide are closed", default=2e-3
    )

    def found_in(self, region: Region) -> NDArray[np.bool_]:
        """(i, j, k) where there are data."""
        return covered_part(region.grey, region.spacing, self.lower, self.gap)


def covered_part(
    grey: NDArray[np.number[Any]],
    spacing: NDArray[np.float64],
    lower: float = 1.0,
    gap: float = 2e-3,
) -> NDArray[np.bool_]:
    """(i, j, k) the largest part of at least that grey value, gaps (m) closed and holes filled."""
    closed = ball_closed(np.asarray(grey >= lower), gap, spacing)
    if not closed.any():
        return closed
    return np.asarray(ndimage.binary_fill_holes(largest_part(closed)))
