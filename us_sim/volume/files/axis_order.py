"""Between the order of axes in memory, where the last index is fastest, and in image files.

A volume in memory is (i, j, k), and a file has its slices one after another: (k, j, i). NumPy turns
one into the other element by element across memory; OpenCV, plane by plane and in blocks that fit
the cache, takes a tenth of the time.

>>> import numpy as np
>>> from us_sim.volume.files.axis_order import file_order, volume_of_slices
>>> voxels = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
>>> slices = file_order(voxels)
>>> slices.shape, bool((slices == voxels.transpose(2, 1, 0)).all())
((4, 3, 2), True)
>>> bool((volume_of_slices(slices, 4) == voxels).all())
True
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

_SLAB = 1 << 23  # bytes that are turned at a time


def file_order(voxels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(k, j, i) C-contiguous, of a part (i, j, k) of a volume."""
    made = np.empty(voxels.shape[::-1], np.uint8)
    for j in range(voxels.shape[1]):
        made[:, j, :] = cv2.transpose(voxels[:, j, :])
    return made


def volume_of_slices(
    slices: Iterable[NDArray[np.uint8]],
    count: int,
    progress: Callable[[float, str], None] | None = None,
) -> NDArray[np.uint8]:
    """A volume (i, j, k) of ``count`` slices (j, i), of which a few are in memory at a time.

    Args:
        slices: in order; the first is read before memory is taken for all.
        count: how many come.
        progress: told the fraction that is there.
    """
    voxels: NDArray[np.uint8] | None = None
    slab: list[NDArray[np.uint8]] = []
    for k, image in enumerate(slices, start=1):
        if voxels is None:
            voxels = np.empty((*image.shape[::-1], count), np.uint8)
        slab.append(image)
        if len(slab) * image.size >= _SLAB or k == count:
            stack = np.stack(slab)
            for j in range(stack.shape[1]):
                voxels[:, j, k - len(slab) : k] = cv2.transpose(stack[:, j, :])
            slab.clear()
            if progress:
                progress(k / count, f"{k} of {count} images")
    assert voxels is not None
    return voxels
