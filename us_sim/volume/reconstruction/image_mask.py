"""Which pixels of an image are tissue: those in a rectangle, in a fan, or in both.

>>> from us_sim.volume.reconstruction.image_mask import image_mask
>>> from us_sim.volume.reconstruction.settings import ImagePart
>>> image_mask(ImagePart(clip=[1, 0, 3, 2]), columns=5, rows=3).astype(int)
array([[0, 1, 1, 1, 1],
       [0, 1, 1, 1, 1],
       [0, 1, 1, 1, 1]])
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.reconstruction.settings import ImagePart


def image_mask(part: ImagePart, columns: int, rows: int) -> NDArray[np.bool_]:
    """(rows, columns) whether a pixel is used.

    A rectangle holds the pixels whose centres lie in it or on its border. A fan holds those that
    lie a pixel along the row or more inside its beams and its outer radius, since those on the
    border mix tissue with what is beside it. Both are as Plus has them.

    Raises:
        VolumeError: no pixel is.
    """
    column, row = np.arange(columns), np.arange(rows)[:, None]
    used = np.ones((rows, columns), dtype=bool)
    if part.clip is not None:
        left, top, wide, high = part.clip
        used &= (column >= left) & (column <= left + wide) & (row >= top) & (row <= top + high)
    if part.fan_origin is not None and part.fan_radius is not None and part.fan_angles is not None:
        across, down = column - part.fan_origin[0], row - part.fan_origin[1]
        beyond = np.hypot(np.abs(across) + 1.0, down)
        used &= (part.fan_radius[0] < beyond) & (beyond <= part.fan_radius[1])
        used &= part.fan_angles[0] <= np.arctan2(across - 1.0, down)
        used &= np.arctan2(across + 1.0, down) <= part.fan_angles[1]
    if not used.any():
        raise VolumeError(
            f"the clip rectangle and fan hold no pixel of images of {columns} × {rows}: give them "
            f"in pixels, counted from the first column and row"
        )
    return used


def outline(part: ImagePart, used: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(N, 4) column, row, 0, 1 of what is around the used pixels (rows, columns).

    The corners of the rectangle where there is one, else the first and last pixel of every row.
    """
    if part.clip is not None:
        left, top, wide, high = part.clip
        columns = np.clip([left, left + wide], 0, used.shape[1] - 1)
        rows_of_it = np.clip([top, top + high], 0, used.shape[0] - 1)
        return np.array([[c, r, 0.0, 1.0] for c in columns for r in rows_of_it])
    rows = np.flatnonzero(used.any(axis=1))
    first = used[rows].argmax(axis=1)
    last = used.shape[1] - 1 - used[rows, ::-1].argmax(axis=1)
    ends = np.zeros((2 * len(rows), 4))
    ends[:, 0] = np.concatenate([first, last])
    ends[:, 1] = np.tile(rows, 2)
    ends[:, 3] = 1.0
    return ends
