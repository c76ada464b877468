"""The part of a volume in which one structure is looked for, and its masks, in metres."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray
from scipy import ndimage

from us_sim.errors import VolumeError

Index = tuple[int, int, int]
_TOUCHING = np.ones((3, 3, 3), bool)


@dataclass(frozen=True, eq=False)
class Region:
    """Grey values around a structure's seeds."""

    grey: NDArray[np.float32]  # (i, j, k), 0 to 255, smoothed as was asked
    spacing: NDArray[np.float64]  # (3,) m
    seeds: tuple[Index, ...]  # in the structure, each once
    outside: tuple[Index, ...]  # known not to be in it
    name: str  # of the structure, for sentences
    progress: Callable[[float, str], None] = lambda *_: None
    """Is told the fraction done and the work in progress, where it takes long."""

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


def ball_closed(
    mask: NDArray[np.bool_], radius: float, spacing: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """The mask with all places filled that a ball of that radius (m) outside it cannot reach."""
    return _by_ball(sitk.BinaryMorphologicalClosing, mask, radius, spacing, 1.0, True)


def ball_opened(
    mask: NDArray[np.bool_], radius: float, spacing: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """The places of the mask that a ball of that radius (m) inside it can reach."""
    return _by_ball(sitk.BinaryMorphologicalOpening, mask, radius, spacing)


def ball_eroded(
    mask: NDArray[np.bool_], radius: float, spacing: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """The mask without its parts within that radius (m) of its border, or of the array's."""
    return _by_ball(sitk.BinaryErode, mask, radius, spacing, 0.0, 1.0, False)


def _by_ball(
    operation: Callable[..., sitk.Image],
    mask: NDArray[np.bool_],
    radius: float,
    spacing: NDArray[np.float64],
    *more: float,
) -> NDArray[np.bool_]:
    reach = [int(count) for count in np.rint(radius / spacing)]
    if not any(reach) or not mask.any():
        return mask
    image = sitk.GetImageFromArray(np.ascontiguousarray(mask.transpose(2, 1, 0)).view(np.uint8))
    made = sitk.GetArrayFromImage(operation(image, reach, sitk.sitkBall, *more))
    return np.asarray(made.view(np.bool_).transpose(2, 1, 0))


def largest_part(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The largest of the parts whose voxels touch, also at corners."""
    parts, count = ndimage.label(mask, _TOUCHING)
    if count < 2:
        return mask
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    return np.asarray(parts == sizes.argmax())


def parts_with(mask: NDArray[np.bool_], seeds: Iterable[Index]) -> NDArray[np.bool_]:
    """The parts that hold one of some voxels, which may lie beside the mask."""
    parts, _ = ndimage.label(mask, _TOUCHING)
    inside = [
        seed for seed in seeds if all(0 <= n < m for n, m in zip(seed, mask.shape, strict=True))
    ]
    return np.isin(parts, sorted({int(parts[seed]) for seed in inside} - {0}))


def parts_at_least(mask: NDArray[np.bool_], voxels: float) -> NDArray[np.bool_]:
    """The parts that have so many voxels or more."""
    if voxels <= 1 or not mask.any():
        return mask
    parts, _ = ndimage.label(mask, _TOUCHING)
    large = np.bincount(parts.ravel()) >= voxels
    large[0] = False
    return np.asarray(large[parts])
