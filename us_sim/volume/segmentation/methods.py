"""Methods that find a structure: thresholds, growing, watershed, tubes, the scanned part."""

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
    ball_eroded,
    ball_opened,
    image_of,
    largest_part,
    parts_at_least,
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


_VESSEL_DIAMETER = Quantity("length", 5e-4, 0.05)
_PART = Quantity("number", 0.0, 1.0)

_VOXELS_ACROSS = 3.0  # the thinnest vessel on the grid that is worked on
_TUBE_PERCENTILE = 98.0  # of the tissue's response to the search for tubes, from which on one is
_LEAST_LENGTH = 15.0
"""Diameters of the thinnest vessel whose length is proposed; of a thicker one it may be shorter."""
_BRIGHT, _FAINTEST = 90.0, 0.65
"""A percentile of the levels around places that is tissue for certain, and how much fainter other
tissue may be."""
_LEAST_TUBE = 0.15
"""Fraction of a vessel that is dark and like a tube; of a shadow it is a few percent."""


@dataclass(frozen=True)
class DarkVessels(Settings):
    """Dark tubes that brighter tissue surrounds, found without a seed; with seeds, those parts.

    Blood hardly echoes, and neither do shadows, air, bone, and depth that no beam reaches: a place
    is proposed only if it is darker than its surroundings on all sides (a closing by a ball that no
    vessel can hold), and connected to a place that looks like a tube (`tubeness`).
    """

    error = VolumeError

    thinnest: float = setting(_VESSEL_DIAMETER, "least diameter of a vessel", default=3e-3)
    thickest: float = setting(_VESSEL_DIAMETER, "largest diameter of a vessel", default=16e-3)
    contrast: float = setting(
        _PART, "how much darker than its surroundings a vessel's middle is", default=0.37
    )
    edge_contrast: float = setting(_PART, "likewise, at its edge", default=0.29)
    margin: float = setting(
        Quantity("length", 0.0, 0.05),
        "what is nearer to the border of the data is left out",
        default=4e-3,
    )

    def check(self) -> None:
        """Refuse settings in the wrong order."""
        if self.thinnest > self.thickest:
            raise self.refused("thickest", "is less than thinnest: swap them")
        if self.edge_contrast > self.contrast:
            raise self.refused("edge_contrast", "is more than contrast: swap them")

    def found_in(self, region: Region) -> NDArray[np.bool_]:
        """(i, j, k) where vessels are."""
        factor = np.maximum(1, (self.thinnest / _VOXELS_ACROSS / region.spacing).astype(int))
        region.progress(0.0, "where data are")
        grey = _shrunk(region.grey, factor)
        has_data = _shrunk((region.grey >= 1.0).astype(np.float32), factor)
        data = covered_part(has_data, region.spacing * factor, lower=0.5)
        if not data.any():
            return np.zeros(region.grey.shape, bool)
        found = self._search(grey, data, region.spacing * factor, region.progress)
        if (factor == 1).all():
            return found
        return _grown(found.astype(np.float32), factor, region.grey.shape) > 0.5

    def _search(
        self,
        grey: NDArray[np.float32],
        data: NDArray[np.bool_],
        spacing: NDArray[np.float64],
        progress: Callable[[float, str], None],
    ) -> NDArray[np.bool_]:
        """The same on the grid that is worked on."""
        progress(0.1, "what surrounds each place")
        level = _filled(grey, data, self.thinnest / 4.0, spacing)
        around = _closed(level, self.thickest / 2.0, spacing)
        relative = level / np.maximum(around, 0.05)
        tissue = ball_eroded(data, self.margin, spacing) & (around > _least_of_tissue(around[data]))
        if not tissue.any():
            return tissue
        # A closing keeps the peaks of speckle, so tissue itself is fainter than its surroundings.
        contrast = 1.0 - relative / np.median(relative[tissue])
        tubes = tubeness(
            image_of(np.log(level + 0.05), spacing),
            tube_scales(self.thinnest, self.thickest / 1.4),
            bright=False,
            progress=lambda done, part: progress(0.35 + 0.45 * done, part),
        )
        progress(0.8, "parts")
        edge = ball_opened(tissue & (contrast > self.edge_contrast), self.thinnest / 3.0, spacing)
        clear = edge & (contrast > self.contrast)
        clear &= tubes > np.percentile(tubes[tissue], _TUBE_PERCENTILE)
        parts, count = ndimage.label(edge, np.ones((3, 3, 3)))
        fraction = ndimage.mean(clear, parts, np.arange(count + 1))
        fraction[0] = 0.0
        least = _LEAST_LENGTH * np.pi / 4.0 * self.thinnest**3
        return parts_at_least((fraction >= _LEAST_TUBE)[parts], least / float(np.prod(spacing)))


def _shrunk(grey: NDArray[np.float32], factor: NDArray[np.int64]) -> NDArray[np.float32]:
    """Means of blocks of voxels."""
    if (factor == 1).all():
        return grey
    # So many that whole blocks cover all; the last ones repeat the border.
    missing = [(0, int(-size % by)) for size, by in zip(grey.shape, factor, strict=True)]
    image = image_of(np.pad(grey, missing, mode="edge"), np.ones(3))
    return array_of(sitk.BinShrink(image, factor.tolist())).astype(np.float32)


def _grown(
    coarse: NDArray[np.float32], factor: NDArray[np.int64], shape: tuple[int, ...]
) -> NDArray[np.float32]:
    """Shrunk values on the fine grid; a coarse centre lies amid the voxels of its block."""
    offset = -(factor - 1.0) / (2.0 * factor)
    return np.asarray(
        ndimage.affine_transform(
            coarse, np.diag(1.0 / factor), offset, output_shape=shape, order=1, mode="nearest"
        )
    )


def _filled(
    grey: NDArray[np.float32],
    data: NDArray[np.bool_],
    smoothing: float,
    spacing: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Levels from 0 to 1, smoothed over data alone and gone on beyond them.

    The square root stands for the compression that an image without enough of it lacks: vessels and
    deep tissue differ more in it.
    """
    level = np.sqrt(grey / np.float32(255.0))
    weight = data.astype(np.float32)

    def smooth(width: float) -> NDArray[np.float32]:
        sigma = width / spacing
        above = ndimage.gaussian_filter(level * weight, sigma, truncate=3.0)
        below = ndimage.gaussian_filter(weight, sigma, truncate=3.0)
        mean = np.float32(level[data].mean())
        return np.asarray(np.where(below > 1e-3, above / np.maximum(below, 1e-3), mean))

    # A place without data gets the grey of its neighbours within 8 mm.
    return np.where(data, smooth(smoothing), smooth(8e-3)).astype(np.float32)


def _closed(
    level: NDArray[np.float32], radius: float, spacing: NDArray[np.float64]
) -> NDArray[np.float32]:
    """A closing by a ball of that radius (m); half as fine, since a large ball takes long."""
    factor = np.array([2, 2, 2])
    coarse = image_of(_shrunk(level, factor), spacing * factor)
    reach = np.maximum(1, np.rint(radius / (spacing * factor))).astype(int)
    closed = sitk.GrayscaleMorphologicalClosing(coarse, reach.tolist(), sitk.sitkBall)
    return _grown(array_of(closed).astype(np.float32), factor, level.shape)


def _least_of_tissue(levels: NDArray[np.float32]) -> float:
    """The level that parts tissue from places without echoes (N. Otsu, 1979).

    Where there is nothing but tissue that would part it in two, so it is never near its own level.
    """
    from skimage.filters import threshold_otsu

    bright = float(np.percentile(levels, _BRIGHT))
    if np.ptp(levels) == 0.0:
        return _FAINTEST * bright
    return min(float(threshold_otsu(levels)), _FAINTEST * bright)
