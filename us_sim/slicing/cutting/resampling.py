"""Places of an image's pixels at rest, and the volume's values there.

>>> import numpy as np
>>> from us_sim.slicing.cutting.resampling import LocatedPixels
>>> shift = np.array([[[5.0, 1, 0], [5, 0, 0], [0, 0, 1]]])  # five voxels along the first two axes
>>> maps = np.concatenate([shift, shift])
>>> located = LocatedPixels(np.zeros((2, 3), np.int32), maps, np.array([7]))
>>> located.compute_rest_index()[1, 2]
array([7., 5., 1.])
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.kernels import njit
from us_sim.slicing.cutting.cut_polygons import END_SHIFT, NO_OUTLINE
from us_sim.slicing.cutting.span_sampling import (
    MOST_VOXELS,
    MOST_VOXELS_A_SIDE,
    SLACK,
    sample_spans,
)
from us_sim.slicing.probe.plane import SlicePlane

if TYPE_CHECKING:
    from collections.abc import Callable

    from us_sim.volume.volume import Volume


def run_rows_in_parallel(threads: int, rows: int, work: Callable[[int, int], object]) -> None:
    """Do ``work(first_row, end_row)`` for all rows in parallel, one run of them a thread.

    Args:
        threads: how many, the caller's own among them.
        rows: how many.
        work: a kernel that does not hold the interpreter's lock.
    """
    rows_each = -(-rows // threads)
    others = [
        _pool(threads - 1).submit(work, first, min(first + rows_each, rows))
        for first in range(rows_each, rows, rows_each)
    ]
    # The caller is a thread too: waking one fewer saves some 50 µs.
    work(0, min(rows_each, rows))
    for other in others:
        other.result()


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="rows")


BLACK = -1  # the element of a pixel that shows nothing, as where tissue moved away


class LocatedPixels(NamedTuple):
    """The E tetrahedra that an image shows, and which of them each pixel lies in."""

    elements: NDArray[np.int32]  # (rows, columns) number of a map; E outside the mesh, or BLACK
    maps: NDArray[np.float64]  # (E + 1, 3, 3) from (1, column, row) to voxel indices at rest
    tetrahedra: NDArray[np.intp]  # (E,) the mesh's own numbers of those that maps are of

    def compute_rest_index(self) -> NDArray[np.float64]:
        """Return (rows, columns, 3) voxel indices of where each pixel's tissue lies at rest.

        Outside the mesh that is the pixel itself; NaN where nothing is shown.
        """
        rows, columns = self.elements.shape
        column, row = np.meshgrid(np.arange(columns), np.arange(rows))
        pixel = np.stack([np.ones(column.shape), column, row], axis=-1)
        index = np.einsum("rcij,rcj->rci", self.maps[self.elements], pixel)
        index[self.elements == BLACK] = np.nan
        return np.asarray(index)

    def take_every(self, steps: tuple[int, int]) -> LocatedPixels:
        """Return every n-th row and column of the elements (n by ``steps``), with the same maps."""
        elements = np.ascontiguousarray(self.elements[:: steps[0], :: steps[1]])
        return LocatedPixels(elements, self.maps, self.tetrahedra)


def evaluate_affine(
    maps: NDArray[np.float64], elements: NDArray[np.int32], *, threads: int = 1
) -> NDArray[np.float32]:
    """Evaluate functions (rows, columns, K) that are affine in (column, row) in each tetrahedron.

    Args:
        maps: (E, K, 3) coefficients of (1, column, row).
        elements: (rows, columns) as `LocatedPixels.elements`.
        threads: how many work.

    Returns:
        NaN wherever no tetrahedron is.
    """
    values = np.empty((*elements.shape, maps.shape[1]), dtype=np.float32)
    maps = np.ascontiguousarray(maps, dtype=np.float64)
    run_rows_in_parallel(
        threads, len(elements), lambda first, end: _evaluate(maps, elements, first, end, values)
    )
    return values


@njit(cache=True, nogil=True, error_model="numpy")
def _evaluate(maps, elements, first_row, end_row, values):
    """Fill rows of ``values`` (rows, columns, K) a run of pixels of one tetrahedron at a time."""
    columns = elements.shape[1]
    for row in range(first_row, end_row):
        line = elements[row]
        start = 0
        while start < columns:
            element = line[start]
            end = start + 1
            while end < columns and line[end] == element:
                end += 1
            for k in range(values.shape[2]):
                if element < 0 or element >= len(maps):
                    for i in range(start, end):
                        values[row, i, k] = np.nan
                    continue
                constant = maps[element, k, 0] + maps[element, k, 2] * row
                slope = maps[element, k, 1]
                for i in range(start, end):
                    values[row, i, k] = constant + slope * i
            start = end


def sample_plane(volume: Volume, plane: SlicePlane, *, threads: int = 1) -> NDArray[np.uint8]:
    """Sample the image (rows, columns) on a plane through the volume as it is, without tissue.

    Values are those of `span_sampling`, and do not depend on the number of threads.

    Raises:
        VolumeError: the volume has too many voxels.
    """
    voxels, shape = get_grey_voxels(volume)
    runs = make_full_runs(plane) if plane.spans is None else plane.spans
    # One map holds on whole rows, so that no pixel is left to lie outside a mesh.
    spans = np.full((plane.rows, 1), plane.columns << END_SHIFT, dtype=np.int64)
    used = np.ones(plane.rows, dtype=np.int32)
    maps, inside = compute_pixel_to_index(volume, plane)[None], np.zeros(1, dtype=np.bool_)
    image = np.empty((plane.rows, plane.columns), dtype=np.uint8)

    def draw(first_row: int, end_row: int) -> None:
        sample_spans(
            voxels, shape, maps, inside, 0, spans, used, runs, True, *NO_OUTLINE,
            first_row, end_row, image,
        )  # fmt: skip

    run_rows_in_parallel(threads, plane.rows, draw)
    return image


def sample_labels(volume: Volume, plane: SlicePlane, *, threads: int = 1) -> NDArray[np.uint8]:
    """Sample the label image (rows, columns) on a plane through the volume as it is.

    Raises:
        VolumeError: the volume has no labels.
    """
    voxels, shape = get_label_voxels(volume)
    maps = compute_pixel_to_index(volume, plane)[None]
    elements = np.zeros((plane.rows, plane.columns), dtype=np.int32)
    if plane.spans is not None:
        elements[~plane.make_shown_mask()] = BLACK
    image = np.empty(elements.shape, dtype=np.uint8)
    run_rows_in_parallel(
        threads, plane.rows, lambda a, b: sample_nearest(voxels, shape, maps, elements, a, b, image)
    )
    return image


def make_full_runs(plane: SlicePlane) -> NDArray[np.int32]:
    """Make (rows, 2, 2) spans, as `SlicePlane.spans`, of an image that fills its grid."""
    runs = np.zeros((plane.rows, 2, 2), dtype=np.int32)
    runs[:, 0, 1] = plane.columns
    runs.flags.writeable = False  # as a plane's own are, or numba would compile the kernels twice
    return runs


def compute_pixel_to_index(volume: Volume, plane: SlicePlane) -> NDArray[np.float64]:
    """Compute the (3, 3) map from (1, column, row) to voxel indices, on a plane in the volume."""
    to_index = volume.patient_to_index
    steps = np.column_stack([plane.origin, plane.column_step, plane.row_step])
    steps = to_index[:3, :3] @ steps
    steps[:, 0] += to_index[:3, 3]
    return steps


def flatten_voxels(array: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Return voxels as the kernels take them, flat and read-only, and their shape (3,)."""
    # Read-only always, since numba would compile the kernels again for memory-mapped volumes.
    flat = np.asarray(array).reshape(-1)
    flat.flags.writeable = False
    return flat, np.array(array.shape, dtype=np.int64)


def get_grey_voxels(volume: Volume) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Return the grey values' voxels as `sample_spans` takes them, and their shape (3,).

    Raises:
        VolumeError: there are too many.
    """
    intensities = volume.intensities
    if max(intensities.shape) > MOST_VOXELS_A_SIDE or intensities.size > MOST_VOXELS:
        raise VolumeError(
            f"the volume has {intensities.shape} voxels: cut or coarsen it to at most "
            f"{MOST_VOXELS_A_SIDE} a side and {MOST_VOXELS} in all"
        )
    voxels, shape = flatten_voxels(intensities)
    if intensities.shape[2] == 1:
        # Nothing follows the last voxel of a row; a volume so thin is small.
        voxels, _ = flatten_voxels(np.repeat(intensities, 2, axis=2))
    return voxels, shape


def get_label_voxels(volume: Volume) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Return the labels' voxels as the kernels take them, and their shape (3,).

    Raises:
        VolumeError: the volume has no labels.
    """
    if volume.labels is None:
        raise VolumeError("the volume has no labels: give one with a segmentation")
    return flatten_voxels(volume.labels)


@njit(cache=True, nogil=True, error_model="numpy")
def sample_nearest(voxels, shape, maps, elements, first_row, last_row, image):
    """Fill rows ``first_row`` to ``last_row - 1`` of an image with the nearest voxels' labels.

    Shapes and units:
        voxels: (I*J*K,) uint8, shape: (3,) its sides.
        maps: (E, 3, 3) from (1, column, row) to voxel indices.
        elements: (rows, columns) int32, which map holds at a pixel; negative for none (0).
        image: (rows, columns) uint8, filled here.
    """
    for row in range(first_row, last_row):
        for i in range(elements.shape[1]):
            element = elements[row, i]
            image[row, i] = 0
            if element < 0:
                continue
            m = maps[element]
            x = (m[0, 0] + m[0, 2] * row) + m[0, 1] * i
            y = (m[1, 0] + m[1, 2] * row) + m[1, 1] * i
            z = (m[2, 0] + m[2, 2] * row) + m[2, 1] * i
            if _is_within(x, shape[0]) and _is_within(y, shape[1]) and _is_within(z, shape[2]):
                ix = np.int64(min(max(x, 0.0), shape[0] - 1.0) + 0.5)
                iy = np.int64(min(max(y, 0.0), shape[1] - 1.0) + 0.5)
                iz = np.int64(min(max(z, 0.0), shape[2] - 1.0) + 0.5)
                image[row, i] = voxels[np.uint64((ix * shape[1] + iy) * shape[2] + iz)]


@njit(inline="always", error_model="numpy")
def _is_within(index, count):
    """Return True if an index lies between the outer faces of the outermost voxels."""
    return index >= -0.5 - SLACK and index <= count - 0.5 + SLACK
