"""Between the order of axes in memory, where the last index is fastest, and in image files.

A volume in memory is (i, j, k), and a file has its slices one after another: (k, j, i). NumPy turns
one into the other element by element across memory; OpenCV, plane by plane and in blocks that fit
the cache, takes a tenth of the time.

>>> import numpy as np
>>> from us_sim.volume.files.axis_order import file_order, fill_from_slices
>>> voxels = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
>>> slices = file_order(voxels)
>>> slices.shape, bool((slices == voxels.transpose(2, 1, 0)).all())
((4, 3, 2), True)
>>> again = np.zeros_like(voxels)
>>> fill_from_slices(again, 0, slices)
>>> bool((again == voxels).all())
True
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["file_order", "fill_from_slices"]


def file_order(voxels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(k, j, i) C-contiguous, of a part (i, j, k) of a volume."""
    made = np.empty(voxels.shape[::-1], np.uint8)
    for j in range(voxels.shape[1]):
        made[:, j, :] = cv2.transpose(voxels[:, j, :])
    return made


def fill_from_slices(voxels: NDArray[np.uint8], first: int, slices: NDArray[np.uint8]) -> None:
    """Put slices (k, j, i) into a volume (i, j, k), from the slice ``first`` on."""
    for j in range(voxels.shape[1]):
        voxels[:, j, first : first + len(slices)] = cv2.transpose(slices[:, j, :])
