"""Sizes of labelled structures in an image, as a sonographer would trace them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from us_sim.errors import VolumeError


def label_area(
    label_image: NDArray[np.uint8], label: int, pixel_area: float, *, largest_part: bool = False
) -> float:
    """The area in m² that a label covers in an image; 0 where it does not appear.

    Args:
        label_image: (rows, columns) labels.
        label: the label's number.
        pixel_area: m², of one pixel.
        largest_part: count only the largest connected part (pixels with an edge in common), so that
            stray pixels of a structure's other branches do not add up.

    Raises:
        VolumeError: the image is not two-dimensional, or the pixel area is not above zero.
    """
    if label_image.ndim != 2:
        raise VolumeError(
            f"an area needs a two-dimensional label image, not one of shape {label_image.shape}"
        )
    if not (np.isfinite(pixel_area) and pixel_area > 0.0):
        raise VolumeError(f"the area of a pixel must be above zero, not {pixel_area} m²")
    covered = label_image == label
    if largest_part:
        parts, count = ndimage.label(covered)
        pixels = int(np.bincount(parts.ravel())[1:].max()) if count else 0
    else:
        pixels = int(np.count_nonzero(covered))
    return pixels * pixel_area
