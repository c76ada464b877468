"""A proposal for vessels in an ultrasound volume: dark tubes within brighter tissue.

Blood hardly echoes, and neither do shadows, air, bone, and depth that no beam reaches: a place is
proposed only if it is darker than its surroundings on all sides, and hangs together with a place
that looks like a tube. The surroundings of a place are taken from a closing of the grey values by a
ball that no vessel can hold; tubes are found by `tubeness`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray
from scipy import ndimage

from us_sim.errors import VolumeError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting
from us_sim.volume.segmentation.methods import covered_part, tube_scales, tubeness
from us_sim.volume.segmentation.region import (
    Region,
    array_of,
    ball_eroded,
    ball_opened,
    image_of,
    parts_at_least,
)

_DIAMETER = Quantity("length", 5e-4, 0.05)
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
    """Dark tubes that brighter tissue surrounds, found without a seed; with seeds, those parts."""

    error = VolumeError

    thinnest: float = setting(_DIAMETER, "least diameter of a vessel", default=3e-3)
    thickest: float = setting(_DIAMETER, "largest diameter of a vessel", default=16e-3)
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
