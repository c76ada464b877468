"""Trilinear grey values of a volume along affine maps, a row of pixels at a time.

Voxel centres lie at whole indices. A point within half a voxel of the outermost centres takes
their value; beyond that everything is 0. Values are rounded half up.
"""

from __future__ import annotations

import numpy as np

from us_sim.kernels import njit

SLACK = 1e-6
"""Voxels by which a point may miss the volume's outer faces: rounding of the map, no more."""


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
    strides = np.array([shape[1] * shape[2], shape[2]])
    nearest = np.empty(columns, dtype=np.int64)
    wx = np.empty(columns, dtype=np.float32)
    wy = np.empty(columns, dtype=np.float32)
    wz = np.empty(columns, dtype=np.float32)
    corners = np.empty((8, columns), dtype=np.uint8)
    for row in range(first_row, last_row):
        line = image[row]
        # Pixels from here up to the current run are placed in the volume, but not yet loaded.
        waiting = np.int64(0)  # a literal would have the callees compiled for it, too
        first = np.int64(0)
        while first < columns:
            element = elements[row, first]
            last = first
            while last + 1 < columns and elements[row, last + 1] == element:
                last += 1
            if element < 0:
                _blend_span(voxels, strides, waiting, first, nearest, wx, wy, wz, corners, line)
                for i in range(first, last + 1):
                    line[i] = 0
                waiting = last + 1
                first = last + 1
                continue
            m = maps[element]
            x0 = m[0, 0] + m[0, 2] * row
            y0 = m[1, 0] + m[1, 2] * row
            z0 = m[2, 0] + m[2, 2] * row
            gx = m[0, 1]
            gy = m[1, 1]
            gz = m[2, 1]
            # The map is affine, so the part of a run among the voxel centres is in one piece.
            low, high = _among_centres(x0, gx, first, last, shape[0])
            low, high = _among_centres(y0, gy, low, high, shape[1])
            low, high = _among_centres(z0, gz, low, high, shape[2])
            if low > first:
                _blend_span(voxels, strides, waiting, first, nearest, wx, wy, wz, corners, line)
                for i in range(first, low):
                    line[i] = _linear_at_edge(voxels, shape, x0 + gx * i, y0 + gy * i, z0 + gz * i)
                waiting = low
            _place_run(
                x0, gx, y0, gy, z0, gz, low, high + 1 - low, strides,
                nearest[low:], wx[low:], wy[low:], wz[low:],
            )  # fmt: skip
            if high < last:
                _blend_span(voxels, strides, waiting, high + 1, nearest, wx, wy, wz, corners, line)
                for i in range(high + 1, last + 1):
                    line[i] = _linear_at_edge(voxels, shape, x0 + gx * i, y0 + gy * i, z0 + gz * i)
                waiting = last + 1
            first = last + 1
        _blend_span(voxels, strides, waiting, columns, nearest, wx, wy, wz, corners, line)


@njit(cache=True, nogil=True, error_model="numpy")
def _among_centres(start, slope, first, last, count):
    """The columns of a run with an index of 0 to below the last one: (first, last).

    Where there are none, the last is less than the first.
    """
    at_first = start + slope * first
    at_last = start + slope * last
    if min(at_first, at_last) >= 0.0 and max(at_first, at_last) < count - 1:
        return first, last
    low = np.float64(first)
    high = np.float64(last)
    if slope > 0.0:
        low = max(low, np.ceil(-start / slope))
        high = min(high, np.floor((count - 1 - start) / slope))
    elif slope < 0.0:
        low = max(low, np.ceil((count - 1 - start) / slope))
        high = min(high, np.floor(-start / slope))
    if not low <= high:
        return last + 1, last
    # The division is rounded; what the loads rely on is tested.
    first = np.int64(low)
    last = np.int64(high)
    while first <= last and not 0.0 <= start + slope * first < count - 1:
        first += 1
    while last >= first and not 0.0 <= start + slope * last < count - 1:
        last -= 1
    return first, last


@njit(cache=True, nogil=True, error_model="numpy")
def _place_run(x0, gx, y0, gy, z0, gz, first, count, strides, nearest, fx, fy, fz):
    """Lower corners and weights of ``count`` pixels from column ``first``, among voxel centres."""
    for k in range(count):
        x = x0 + gx * (first + k)
        y = y0 + gy * (first + k)
        z = z0 + gz * (first + k)
        ix = np.int64(x)
        iy = np.int64(y)
        iz = np.int64(z)
        fx[k] = np.float32(x - ix)
        fy[k] = np.float32(y - iy)
        fz[k] = np.float32(z - iz)
        nearest[k] = ix * strides[0] + iy * strides[1] + iz


@njit(cache=True, nogil=True, error_model="numpy")
def _linear_at_edge(voxels, shape, x, y, z):
    """Trilinear grey value anywhere: held in the outer half voxel, 0 beyond."""
    if not (
        inside_volume(x, shape[0]) and inside_volume(y, shape[1]) and inside_volume(z, shape[2])
    ):
        return np.uint8(0)
    x = min(max(x, 0.0), shape[0] - 1.0)
    y = min(max(y, 0.0), shape[1] - 1.0)
    z = min(max(z, 0.0), shape[2] - 1.0)
    ix = np.int64(x)
    iy = np.int64(y)
    iz = np.int64(z)
    near = (ix * shape[1] + iy) * shape[2] + iz
    to_x = shape[1] * shape[2] if ix + 1 < shape[0] else 0
    to_y = shape[2] if iy + 1 < shape[1] else 0
    to_z = 1 if iz + 1 < shape[2] else 0
    value = _blend(
        voxels[near], voxels[near + to_z],
        voxels[near + to_y], voxels[near + to_y + to_z],
        voxels[near + to_x], voxels[near + to_x + to_z],
        voxels[near + to_x + to_y], voxels[near + to_x + to_y + to_z],
        np.float32(x - ix), np.float32(y - iy), np.float32(z - iz),
    )  # fmt: skip
    return np.uint8(np.int32(value + np.float32(0.5)))


@njit(inline="always", error_model="numpy")
def inside_volume(index, count):
    """Whether an index lies between the outer faces of the outermost voxels."""
    return index >= -0.5 - SLACK and index <= count - 0.5 + SLACK


@njit(cache=True, nogil=True, error_model="numpy")
def _blend_span(voxels, strides, first, end, nearest, wx, wy, wz, corners, line):
    """Trilinear values of the pixels ``first`` to ``end - 1`` of a row, all among voxel centres.

    The loads stand apart from the arithmetic, which is vectorised without them: two and a half
    times as fast. ``nearest`` (columns,) int64 are the lower corners, ``wx``, ``wy`` and ``wz``
    (columns,) float32 the offsets from them, and ``corners`` (8, columns) uint8 is room to work in.
    """
    # All loops here count from 0 and the voxels' indices are unsigned: numba lets a signed index
    # count from the end, and a test for that keeps the loop from being vectorised.
    count = end - first
    lower = nearest[first:end]
    one = np.uint64(1)
    to_x = np.uint64(strides[0])
    to_y = np.uint64(strides[1])
    v000 = corners[0]
    v001 = corners[1]
    v010 = corners[2]
    v011 = corners[3]
    v100 = corners[4]
    v101 = corners[5]
    v110 = corners[6]
    v111 = corners[7]
    for k in range(count):
        near = np.uint64(lower[k])
        far = near + to_x
        v000[k] = voxels[near]
        v001[k] = voxels[near + one]
        v010[k] = voxels[near + to_y]
        v011[k] = voxels[near + to_y + one]
        v100[k] = voxels[far]
        v101[k] = voxels[far + one]
        v110[k] = voxels[far + to_y]
        v111[k] = voxels[far + to_y + one]
    fx = wx[first:end]
    fy = wy[first:end]
    fz = wz[first:end]
    out = line[first:end]
    for k in range(count):
        value = _blend(
            v000[k], v001[k], v010[k], v011[k], v100[k], v101[k], v110[k], v111[k],
            fx[k], fy[k], fz[k],
        )  # fmt: skip
        out[k] = np.uint8(np.int32(value + np.float32(0.5)))


@njit(inline="always", error_model="numpy")
def _blend(v000, v001, v010, v011, v100, v101, v110, v111, fx, fy, fz):
    """Trilinear value between eight voxels; the last digit counts along z."""
    a = np.float32(v000)
    c00 = a + fz * (np.float32(v001) - a)
    a = np.float32(v010)
    c01 = a + fz * (np.float32(v011) - a)
    a = np.float32(v100)
    c10 = a + fz * (np.float32(v101) - a)
    a = np.float32(v110)
    c11 = a + fz * (np.float32(v111) - a)
    c0 = c00 + fy * (c01 - c00)
    c1 = c10 + fy * (c11 - c10)
    return c0 + fx * (c1 - c0)
