"""The grid of voxels that a sweep's images are inserted into, and the pixels that are inserted."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.volume.files.stored_image import LARGEST_VOLUME
from us_sim.volume.reconstruction.settings import ImagePart


@dataclass(frozen=True, eq=False)
class Grid:
    """Cubic voxels in rows; the centre of voxel (i, j, k) lies at that whole index."""

    index_to_reference: NDArray[np.float64]  # (4, 4), m
    shape: tuple[int, int, int]

    @property
    def spacing(self) -> float:
        """m, from a voxel to the next."""
        return float(np.linalg.norm(self.index_to_reference[:3, 0]))


def fit_grid(points: NDArray[np.float64], spacing: float) -> Grid:
    """Return the grid, ``spacing`` m fine, whose outer voxels hold the outermost points (N, 3) m.

    Raises:
        VolumeError: it would have more voxels than are read from a file, or just one layer of them.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    # As Plus counts them, so that its grids come out: the last voxel may end before the last point.
    counts = np.floor((high - low) / spacing + 0.5) + 1.0
    if math.prod(counts) > LARGEST_VOLUME:
        asked, size = 1e3 * spacing, 1e3 * (high - low)
        possible = 1e3 * (math.prod(high - low) / LARGEST_VOLUME) ** (1 / 3)
        raise VolumeError(
            f"voxels of {asked:g} mm in the {' × '.join(f'{s:.0f}' for s in size)} mm that the "
            f"sweep covers are {math.prod(counts):.3g}, where {LARGEST_VOLUME} are possible: give "
            f"--spacing '{1.05 * possible:.2g} mm' or more"
        )
    if min(counts) < 2:
        raise VolumeError(
            f"voxels of {1e3 * spacing:g} mm are larger than the "
            f"{1e3 * (high - low).min():.3g} mm that the sweep covers along an axis: give a "
            f"smaller --spacing, or a sweep that moves"
        )
    matrix = np.eye(4)
    matrix[:3, :3] *= spacing
    matrix[:3, 3] = low
    i, j, k = (int(count) for count in counts)
    return Grid(matrix, (i, j, k))


def propose_spacing(points: NDArray[np.float64], pixel: float) -> float:
    """Return m: a pixel's size, or as much more as 134 million voxels around the points need."""
    size = np.maximum(np.ptp(points, axis=0), pixel)
    needed = (math.prod(size) / (1 << 27)) ** (1 / 3)
    return pixel if needed <= pixel else math.ceil(1e5 * needed * 1.01) / 1e5


def make_image_mask(part: ImagePart, columns: int, rows: int) -> NDArray[np.bool_]:
    """(rows, columns) whether a pixel is used.

    A rectangle holds the pixels whose centres lie in it or on its border. A fan holds those that
    lie a pixel along the row or more inside its beams and its outer radius, since those on the
    border mix tissue with its surroundings. Both are as Plus has them.

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


def find_outline(part: ImagePart, used: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(N, 4) column, row, 0, 1 of points around the used pixels (rows, columns).

    The corners of the rectangle where there is one, as Plus has them, else the first and last
    pixel of every row.
    """
    if part.clip is not None:
        left, top, wide, high = part.clip
        columns = np.clip([left, left, left + wide, left + wide], 0, used.shape[1] - 1)
        rows = np.clip([top, top + high] * 2, 0, used.shape[0] - 1)
    else:
        rows = np.tile(np.flatnonzero(used.any(axis=1)), 2)
        half = used[rows[: len(rows) // 2]]
        last = used.shape[1] - 1 - half[:, ::-1].argmax(axis=1)
        columns = np.concatenate([half.argmax(axis=1), last])
    return np.column_stack([columns, rows, np.zeros(len(rows)), np.ones(len(rows))])
