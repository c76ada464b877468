"""Tubes by the Hessian of grey values at several scales.

A. Frangi and others, "Multiscale vessel enhancement filtering", MICCAI 1998, as ITK's
ObjectnessMeasure has it (L. Antiga, Insight Journal 2007).

>>> import numpy as np
>>> from us_sim.volume.segmentation.vesselness import tube_scales
>>> (1e3 * tube_scales(3e-3, 12e-3)).round(2)  # mm
array([1.06, 2.12, 4.24])
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting
from us_sim.volume.segmentation.region import Region, array_of

_DIAMETER = Quantity("length", 2e-4, 0.05)
_STEP = 1.0
"""Standard deviations between voxels of the grid on which the Hessian is taken."""

_STRONG = 99.5
"""Percentile of the tubes' response that counts as 1: the strongest few are stray echoes."""


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
        response = tubeness(
            region.image,
            tube_scales(self.thinnest, self.thickest),
            bright=self.bright,
            progress=region.progress,
        )
        there = response[response > 0]
        if not there.size:
            return np.zeros(response.shape, bool)
        return np.asarray(response > self.least * np.percentile(there, _STRONG))


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
    """(i, j, k) how much a tube the surroundings of each voxel are, the most of all scales (m)."""
    most = np.zeros(image.GetSize(), np.float32)
    for done, scale in enumerate(scales):
        sigma = float(scale * 1e3)
        progress(done / len(scales), f"tubes {sigma * np.sqrt(8.0):.1f} mm wide")
        smooth = sitk.SmoothingRecursiveGaussian(sitk.Cast(image, sitk.sitkFloat32), sigma)
        # What is smooth is as well known on a coarser grid, on which it takes a fraction.
        steps = [max(1, int(sigma / side / _STEP)) for side in image.GetSpacing()]
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
