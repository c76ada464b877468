"""Grey values and labels of a volume along an affine map from pixels to voxels.

Voxel centres lie at whole indices. A point within half a voxel of the outermost centres takes
their value, so that the volume ends at the faces of its voxels and not half a voxel inside; beyond
those faces everything is 0. Grey values are trilinear and rounded half up; labels are those of
the nearest voxel.

>>> import numpy as np
>>> from us_sim.pose import Pose
>>> from us_sim.slicing.probe import LinearProbe
>>> from us_sim.slicing.resampling import sample_plane
>>> from us_sim.volume.volume import Volume
>>> ramp = np.tile(np.arange(50, dtype=np.uint8), (40, 3, 1))
>>> millimetres = np.diag([1e-3, 1e-3, 1e-3, 1.0])
>>> volume = Volume(ramp, millimetres, None, {})
>>> plane = LinearProbe(aperture=0.02, depth=0.01, columns=4, rows=5).plane(Pose([0.01, 0, 0]))
>>> sample_plane(volume, plane)[:, 0]
array([1, 3, 5, 7, 9], dtype=uint8)
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from numpy.typing import NDArray

from us_sim.errors import VolumeError
from us_sim.slicing.plane import SlicePlane

if TYPE_CHECKING:
    from us_sim.volume.volume import Volume

__all__ = [
    "label_voxels",
    "pixel_to_index",
    "sample_labels",
    "sample_linear",
    "sample_nearest",
    "sample_plane",
    "voxels_of",
]

# Voxels by which a point may miss the volume's outer faces: rounding of the map, no more.
_SLACK = 1e-6


def sample_plane(volume: Volume, plane: SlicePlane) -> NDArray[np.uint8]:
    """The image (rows, columns) on a plane through the volume as it is, without tissue."""
    image = np.empty((plane.rows, plane.columns), dtype=np.uint8)
    maps, elements = _one_rigid_map(volume, plane)
    sample_linear(*voxels_of(volume.intensities), maps, elements, 0, plane.rows, image)
    return image


def sample_labels(volume: Volume, plane: SlicePlane) -> NDArray[np.uint8]:
    """The label image (rows, columns) on a plane through the volume as it is.

    Raises:
        VolumeError: the volume has no labels.
    """
    image = np.empty((plane.rows, plane.columns), dtype=np.uint8)
    maps, elements = _one_rigid_map(volume, plane)
    sample_nearest(*label_voxels(volume), maps, elements, 0, plane.rows, image)
    return image


def pixel_to_index(volume: Volume, plane: SlicePlane) -> NDArray[np.float64]:
    """(3, 3) map from (1, column, row) to voxel indices, for a plane through the rigid volume."""
    to_index = volume.patient_to_index
    steps = np.column_stack([plane.origin, plane.column_step, plane.row_step])
    steps = to_index[:3, :3] @ steps
    steps[:, 0] += to_index[:3, 3]
    return steps


def voxels_of(array: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """A volume's voxels as the kernels take them: flat and read-only, and their shape (3,)."""
    # Read-only always, since numba would compile the kernels again for memory-mapped volumes.
    flat = np.asarray(array).reshape(-1)
    flat.flags.writeable = False
    return flat, np.array(array.shape, dtype=np.int64)


def label_voxels(volume: Volume) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """The labels' voxels as the kernels take them.

    Raises:
        VolumeError: the volume has no labels.
    """
    if volume.labels is None:
        raise VolumeError("the volume has no labels: give one with a segmentation")
    return voxels_of(volume.labels)


def _one_rigid_map(
    volume: Volume, plane: SlicePlane
) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    elements = np.zeros((plane.rows, plane.columns), dtype=np.int32)
    return pixel_to_index(volume, plane)[None], elements


@njit(cache=True, nogil=True, error_model="numpy")
def sample_linear(voxels, shape, maps, elements, first_row, last_row, image):
    """Trilinear grey values of rows ``first_row`` to ``last_row - 1`` of an image.

    Args:
        voxels: (I*J*K,) uint8, shape: (3,) its sides.
        maps: (E, 3, 3) from (1, column, row) to voxel indices.
        elements: (rows, columns) int32, which map holds at a pixel; negative for none (0).
        image: (rows, columns) uint8, filled here.
    """
    columns = elements.shape[1]
    stride_x = shape[1] * shape[2]
    stride_y = shape[2]
    half = np.float32(0.5)
    for row in range(first_row, last_row):
        first = 0
        while first < columns:
            element = elements[row, first]
            last = first
            while last + 1 < columns and elements[row, last + 1] == element:
                last += 1
            if element < 0:
                for i in range(first, last + 1):
                    image[row, i] = 0
                first = last + 1
                continue
            m = maps[element]
            x0 = m[0, 0] + m[0, 2] * row
            y0 = m[1, 0] + m[1, 2] * row
            z0 = m[2, 0] + m[2, 2] * row
            gx = m[0, 1]
            gy = m[1, 1]
            gz = m[2, 1]
            # The map is affine, so a run whose ends lie among the voxel centres does throughout.
            if (
                _among_centres(x0, gx, first, last, shape[0])
                and _among_centres(y0, gy, first, last, shape[1])
                and _among_centres(z0, gz, first, last, shape[2])
            ):
                for i in range(first, last + 1):
                    x = x0 + gx * i
                    y = y0 + gy * i
                    z = z0 + gz * i
                    value = _blend(
                        voxels, x, y, z, np.int64(x), np.int64(y), np.int64(z),
                        stride_x, stride_y, np.int64(1), stride_x, stride_y,
                    )  # fmt: skip
                    image[row, i] = np.uint8(value + half)
            else:
                for i in range(first, last + 1):
                    x = x0 + gx * i
                    y = y0 + gy * i
                    z = z0 + gz * i
                    if (
                        _inside(x, shape[0])
                        and _inside(y, shape[1])
                        and _inside(z, shape[2])
                    ):  # fmt: skip
                        x = min(max(x, 0.0), shape[0] - 1.0)
                        y = min(max(y, 0.0), shape[1] - 1.0)
                        z = min(max(z, 0.0), shape[2] - 1.0)
                        ix = np.int64(x)
                        iy = np.int64(y)
                        iz = np.int64(z)
                        value = _blend(
                            voxels, x, y, z, ix, iy, iz,
                            stride_x if ix + 1 < shape[0] else 0,
                            stride_y if iy + 1 < shape[1] else 0,
                            1 if iz + 1 < shape[2] else 0,
                            stride_x, stride_y,
                        )  # fmt: skip
                        image[row, i] = np.uint8(value + half)
                    else:
                        image[row, i] = 0
            first = last + 1


@njit(cache=True, nogil=True, error_model="numpy")
def sample_nearest(voxels, shape, maps, elements, first_row, last_row, image):
    """Labels of the nearest voxels; arguments as for `sample_linear`."""
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
            if _inside(x, shape[0]) and _inside(y, shape[1]) and _inside(z, shape[2]):
                ix = np.int64(min(max(x, 0.0), shape[0] - 1.0) + 0.5)
                iy = np.int64(min(max(y, 0.0), shape[1] - 1.0) + 0.5)
                iz = np.int64(min(max(z, 0.0), shape[2] - 1.0) + 0.5)
                image[row, i] = voxels[np.uint64((ix * shape[1] + iy) * shape[2] + iz)]


@njit(inline="always", error_model="numpy")
def _among_centres(start, slope, first, last, count):
    """Whether a run stays at or above index 0 and below the last index."""
    a = start + slope * first
    b = start + slope * last
    return min(a, b) >= 0.0 and max(a, b) < count - 1


@njit(inline="always", error_model="numpy")
def _inside(index, count):
    """Whether an index lies between the outer faces of the outermost voxels."""
    return index >= -0.5 - _SLACK and index <= count - 0.5 + _SLACK


@njit(inline="always", error_model="numpy")
def _blend(voxels, x, y, z, ix, iy, iz, to_x, to_y, to_z, stride_x, stride_y):
    """Trilinear value between the voxel (ix, iy, iz) and its neighbours to_x, to_y, to_z on."""
    fx = np.float32(x - ix)
    fy = np.float32(y - iy)
    fz = np.float32(z - iz)
    # Unsigned, since numba tests a signed index for counting from the end.
    near = ix * stride_x + iy * stride_y + iz
    far = near + to_x
    a = np.float32(voxels[np.uint64(near)])
    b = np.float32(voxels[np.uint64(near + to_z)])
    c00 = a + fz * (b - a)
    a = np.float32(voxels[np.uint64(near + to_y)])
    b = np.float32(voxels[np.uint64(near + to_y + to_z)])
    c01 = a + fz * (b - a)
    a = np.float32(voxels[np.uint64(far)])
    b = np.float32(voxels[np.uint64(far + to_z)])
    c10 = a + fz * (b - a)
    a = np.float32(voxels[np.uint64(far + to_y)])
    b = np.float32(voxels[np.uint64(far + to_y + to_z)])
    c11 = a + fz * (b - a)
    c0 = c00 + fy * (c01 - c00)
    c1 = c10 + fy * (c11 - c10)
    return c0 + fx * (c1 - c0)
