"""Masks opened, closed and parted, in metres.

>>> import numpy as np
>>> from us_sim.volume.segmentation.morphology import ball_opened
>>> mask = np.zeros((20, 20, 20), bool)
>>> mask[5:15, 5:15, 5:15] = mask[:5, 9, 9] = True  # a block and a thread
>>> int(ball_opened(mask, 1e-3, np.full(3, 1e-3))[:5].sum())
0
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray
from scipy import ndimage

_TOUCHING = np.ones((3, 3, 3), bool)


def ball_closed(
    mask: NDArray[np.bool_], radius: float, spacing: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """The mask with all places filled that a ball of that radius (m) outside it cannot reach."""
    reach = _reach(radius, spacing)
    if not any(reach) or not mask.any():
        return mask
    return _back(sitk.BinaryMorphologicalClosing(_image(mask), reach, sitk.sitkBall, 1.0, True))


def ball_opened(
    mask: NDArray[np.bool_], radius: float, spacing: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """The places of the mask that a ball of that radius (m) inside it can reach."""
    reach = _reach(radius, spacing)
    if not any(reach) or not mask.any():
        return mask
    return _back(sitk.BinaryMorphologicalOpening(_image(mask), reach, sitk.sitkBall))


def ball_eroded(
    mask: NDArray[np.bool_], radius: float, spacing: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """The mask without what is within that radius (m) of its border, or of the array's."""
    reach = _reach(radius, spacing)
    if not any(reach) or not mask.any():
        return mask
    return _back(sitk.BinaryErode(_image(mask), reach, sitk.sitkBall, 0.0, 1.0, False))


def _reach(radius: float, spacing: NDArray[np.float64]) -> list[int]:
    """A radius in voxels along each axis."""
    return [int(count) for count in np.rint(radius / spacing)]


def _image(mask: NDArray[np.bool_]) -> sitk.Image:
    return sitk.GetImageFromArray(np.ascontiguousarray(mask.transpose(2, 1, 0)).view(np.uint8))


def _back(image: sitk.Image) -> NDArray[np.bool_]:
    return np.asarray(sitk.GetArrayFromImage(image).view(np.bool_).transpose(2, 1, 0))


def largest_part(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The largest of the parts whose voxels touch, also at corners."""
    parts, count = ndimage.label(mask, _TOUCHING)
    if count < 2:
        return mask
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    return np.asarray(parts == sizes.argmax())


def parts_with(mask: NDArray[np.bool_], seeds: Iterable[tuple[int, int, int]]) -> NDArray[np.bool_]:
    """The parts that hold one of some voxels, which may lie beside the mask."""
    parts, _ = ndimage.label(mask, _TOUCHING)
    inside = [
        seed for seed in seeds if all(0 <= n < m for n, m in zip(seed, mask.shape, strict=True))
    ]
    held = {int(parts[seed]) for seed in inside} - {0}
    return np.isin(parts, sorted(held))


def parts_at_least(mask: NDArray[np.bool_], voxels: float) -> NDArray[np.bool_]:
    """The parts that have so many voxels or more."""
    if voxels <= 1 or not mask.any():
        return mask
    parts, _ = ndimage.label(mask, _TOUCHING)
    large = np.bincount(parts.ravel()) >= voxels
    large[0] = False
    return np.asarray(large[parts])
