"""Two ways to find a structure: growing from seeds, and a search for dark vessels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray
from scipy import ndimage

from us_sim.errors import VolumeError

Index = tuple[int, int, int]
Progress = Callable[[float, str], None]

_CONTRAST, _EDGE_CONTRAST = 0.37, 0.29
"""How much darker than its surroundings a vessel's middle is, and its edge."""
_MARGIN = 4e-3  # m: what is nearer to the border of the data is left out
_VOXELS_ACROSS = 3.0  # the thinnest vessel on the grid that is worked on
_GAP = 2e-3  # m, gaps in the data up to twice as wide are closed
_TUBE_PERCENTILE = 98.0  # of the tissue's response to the search for tubes, from which on one is
_LEAST_LENGTH = 15.0
"""Diameters of the thinnest vessel whose length is proposed; of a thicker one it may be shorter."""
_BRIGHT, _FAINTEST = 90.0, 0.65
"""A percentile of the levels around places that is tissue for certain, and how much fainter other
tissue may be."""
_LEAST_TUBE = 0.15
"""Fraction of a vessel that is dark and like a tube; of a shadow it is a few percent."""


def image_of(array: NDArray[np.generic], spacing: NDArray[np.float64]) -> sitk.Image:
    """An image of an array (i, j, k) with that spacing (3,) in m; an image's is in mm."""
    image = sitk.GetImageFromArray(np.ascontiguousarray(array.transpose(2, 1, 0)))
    image.SetSpacing((spacing * 1e3).tolist())
    return image


def array_of(image: sitk.Image) -> NDArray[Any]:
    """The array (i, j, k) of an image."""
    return np.asarray(sitk.GetArrayFromImage(image).transpose(2, 1, 0))


def in_voxels(length: float, image: sitk.Image) -> list[int]:
    """A length, m, along each axis, as the radius of a ball."""
    return [round(length * 1e3 / side) for side in image.GetSpacing()]


def grow(image: sitk.Image, seeds: Sequence[Index], lower: float, upper: float) -> sitk.Image:
    """Find the part connected with a seed through grey values in a range, as 1 in an image.

    Raises:
        VolumeError: a seed lies outside the range.
    """
    for number, seed in enumerate(seeds):
        if not lower <= (value := image[seed]) <= upper:
            raise VolumeError(
                f"seed {number + 1} has the grey value {value:.0f}, outside {lower:g} to "
                f"{upper:g}, so nothing grows from it: move it, or widen the range"
            )
    return sitk.ConnectedThreshold(image, list(seeds), lower, upper)


def dark_vessels(
    image: sitk.Image, progress: Progress, thinnest: float = 3e-3, thickest: float = 16e-3
) -> sitk.Image:
    """Find dark tubes that brighter tissue surrounds, without a seed, as 1 in an image.

    Blood hardly echoes, and neither do shadows, air, bone, and depth that no beam reaches: a place
    is proposed only if it is darker than its surroundings on all sides (a closing by a ball that no
    vessel can hold), and connected to a place that looks like a tube (`tubeness`).

    Args:
        image: of grey values, spacing in mm.
        progress: told how far it is.
        thinnest: m, least diameter of a vessel.
        thickest: m, largest diameter of a vessel.
    """
    progress(0.0, "where data are")
    finest = thinnest * 1e3 / _VOXELS_ACROSS
    factor = [max(1, int(finest / side)) for side in image.GetSpacing()]
    data = sitk.BinShrink(sitk.Cast(image >= 1.0, sitk.sitkFloat32), factor) >= 0.5
    data = sitk.BinaryMorphologicalClosing(data, in_voxels(_GAP, data), sitk.sitkBall)
    parts = sitk.RelabelComponent(sitk.ConnectedComponent(data, True))
    data = sitk.BinaryFillhole(parts == 1)
    if not array_of(data).any():
        return image < 0.0
    vessels = _search(sitk.BinShrink(image, factor), data, thinnest, thickest, progress)
    return _resampled(sitk.Cast(vessels, sitk.sitkFloat32), image) > 0.5


def _search(
    grey: sitk.Image, data: sitk.Image, thinnest: float, thickest: float, progress: Progress
) -> sitk.Image:
    """The same on the grid that is worked on."""
    progress(0.1, "what surrounds each place")
    level = _filled(grey, data, thinnest / 4.0)
    # A closing by a large ball takes long, so half as fine.
    coarse = sitk.BinShrink(level, [2, 2, 2])
    reach = [max(1, count) for count in in_voxels(thickest / 2.0, coarse)]
    closed = sitk.GrayscaleMorphologicalClosing(coarse, reach, sitk.sitkBall)
    around = array_of(_resampled(closed, level))
    inner = sitk.BinaryErode(data, in_voxels(_MARGIN, data), sitk.sitkBall, 0.0, 1.0, False)
    tissue = array_of(inner).astype(bool)
    tissue &= around > _least_of_tissue(around[array_of(data) > 0])
    if not tissue.any():
        return data < 0
    # A closing keeps the peaks of speckle, so tissue itself is fainter than its surroundings.
    relative = array_of(level) / np.maximum(around, 0.05)
    contrast = 1.0 - relative / np.median(relative[tissue])
    tubes = tubeness(
        sitk.Log(level + 0.05),
        thinnest,
        thickest / 1.4,
        lambda done, part: progress(0.35 + 0.45 * done, part),
    )
    progress(0.8, "parts")
    spacing = np.array(level.GetSpacing()) * 1e-3
    edge = image_of((tissue & (contrast > _EDGE_CONTRAST)).astype(np.uint8), spacing)
    edge = sitk.BinaryMorphologicalOpening(edge, in_voxels(thinnest / 3.0, edge), sitk.sitkBall)
    clear = (contrast > _CONTRAST) & (tubes > np.percentile(tubes[tissue], _TUBE_PERCENTILE))
    parts, count = ndimage.label(array_of(edge), np.ones((3, 3, 3)))
    least = _LEAST_LENGTH * np.pi / 4.0 * thinnest**3 / float(np.prod(spacing))
    vessels = ndimage.mean(clear, parts, np.arange(count + 1)) >= _LEAST_TUBE
    vessels &= np.bincount(parts.ravel(), minlength=count + 1) >= least
    vessels[0] = False
    made = image_of(vessels[parts].astype(np.uint8), spacing)
    made.CopyInformation(level)
    return made


def tubeness(
    image: sitk.Image, thinnest: float, thickest: float, progress: Progress
) -> NDArray[np.float32]:
    """(i, j, k) how much a dark tube of these diameters (m) the surroundings of each voxel are.

    A. Frangi and others, "Multiscale vessel enhancement filtering", MICCAI 1998, as ITK's
    ObjectnessMeasure has it (L. Antiga, Insight Journal 2007): by the Hessian of grey values. A
    tube responds most to a Gaussian of its radius over √2; the scales are a factor of two apart.
    """
    most = np.zeros(image.GetSize(), np.float32)
    count = int(np.ceil(np.log2(thickest / thinnest) - 1e-9)) + 1
    for done, sigma in enumerate(np.geomspace(thinnest, thickest, count) * 1e3 / np.sqrt(8.0)):
        progress(done / count, f"tubes {sigma * np.sqrt(8.0):.1f} mm wide")
        smooth = sitk.SmoothingRecursiveGaussian(image, float(sigma))
        # A smooth image is as well known on a grid of its standard deviation, in less time.
        steps = [max(1, int(sigma / side)) for side in image.GetSpacing()]
        found = sitk.ObjectnessMeasure(
            sitk.Shrink(smooth, steps),
            alpha=0.5,
            beta=0.5,
            gamma=5.0,
            objectDimension=1,
            brightObject=False,
        )
        if max(steps) > 1:
            found = sitk.Resample(found, smooth, sitk.Transform(), sitk.sitkLinear, 0.0)
        np.maximum(most, array_of(found).astype(np.float32) * sigma**2, out=most)
    return most


def _resampled(coarse: sitk.Image, fine: sitk.Image) -> sitk.Image:
    """A shrunk image on the fine grid; beyond its outermost centres it stays as it is there."""
    return sitk.Resample(
        coarse,
        fine,
        sitk.Transform(),
        sitk.sitkLinear,
        0.0,
        coarse.GetPixelID(),
        useNearestNeighborExtrapolator=True,
    )


def _filled(grey: sitk.Image, data: sitk.Image, smoothing: float) -> sitk.Image:
    """Levels from 0 to 1, smoothed (m) over data alone and gone on beyond them.

    The square root stands for the compression that an image without enough of it lacks: vessels and
    deep tissue differ more in it.
    """
    level = np.sqrt(array_of(grey) / np.float32(255.0))
    there = array_of(data).astype(bool)
    weight = there.astype(np.float32)

    def smooth(width: float) -> NDArray[np.float32]:
        sigma = width * 1e3 / np.array(grey.GetSpacing())
        above = ndimage.gaussian_filter(level * weight, sigma, truncate=3.0)
        below = ndimage.gaussian_filter(weight, sigma, truncate=3.0)
        mean = level[there].mean()
        return np.asarray(np.where(below > 1e-3, above / np.maximum(below, 1e-3), mean))

    # A place without data gets the grey of its neighbours within 8 mm.
    filled = np.where(there, smooth(smoothing), smooth(8e-3)).astype(np.float32)
    made = image_of(filled, np.ones(3))
    made.CopyInformation(grey)
    return made


def _least_of_tissue(levels: NDArray[Any]) -> float:
    """The level that parts tissue from places without echoes (N. Otsu, 1979).

    Where there is nothing but tissue that would part it in two, so it is never near its own level.
    """
    from skimage.filters import threshold_otsu

    bright = float(np.percentile(levels, _BRIGHT))
    if np.ptp(levels) == 0.0:
        return _FAINTEST * bright
    return min(float(threshold_otsu(levels)), _FAINTEST * bright)
