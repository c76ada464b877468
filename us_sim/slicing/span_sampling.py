"""Grey values of an image from its spans, a row of pixels at a time.

Where the pixels of a row lie at rest is written span after span, and only then are they sampled,
so that neither the loads nor the arithmetic stop at the short spans of a fine mesh.

Voxel centres lie at whole indices. A point within half a voxel of the outermost centres takes
their value; beyond that everything is 0. Values are rounded half up.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from us_sim.slicing.rest_outline import mark_covered
from us_sim.slicing.spans import CUT_SHIFT, END_SHIFT
from us_sim.slicing.trilinear import inside_volume

__all__ = ["fill_elements", "sample_spans"]

# Pixels that are written at once: a vector of float32. What is too much is masked.
_LANES = 16
# First coordinates of pixels that have no place at rest, and of those not written yet.
_NOTHING = np.float32(-2.0)
_OPEN = np.float32(-4.0)

_COLUMN = (1 << END_SHIFT) - 1


@njit(cache=True, nogil=True, error_model="numpy")
def sample_spans(
    pairs, shape, maps, inside, rigid, spans, used, runs,
    outlines, points, turns, outline_number, first_row, end_row, image,
):  # fmt: skip
    """Trilinear grey values of rows ``first_row`` to ``end_row - 1`` of an image.

    Args:
        pairs: uint16, each voxel with the next one along the last axis. shape: (3,) voxels.
        maps, inside: as `cut_polygons.Cuts`; the map with the number ``rigid`` is that of pixels
            outside the mesh.
        spans, used, runs: as for `spans.convert_cuts`.
        outlines … outline_number: as `rest_outline.Outline`.
        image: (rows, columns) uint8, filled here.
    """
    columns = image.shape[1]
    x = np.empty(columns + _LANES, dtype=np.float32)
    y = np.empty(columns + _LANES, dtype=np.float32)
    z = np.empty(columns + _LANES, dtype=np.float32)
    offsets = np.empty(columns + _LANES, dtype=np.int64)
    corners = np.empty((4, columns + _LANES), dtype=np.uint16)
    winding = np.empty(columns + 1, dtype=np.int32)
    covered = np.empty(columns, dtype=np.bool_)
    for row in range(first_row, end_row):
        x[:] = _OPEN
        for k in range(used[row]):
            span = spans[row, k]
            q = span >> CUT_SHIFT
            end = span >> END_SHIFT & _COLUMN
            first = span & _COLUMN
            _place(maps[q], inside[q], shape, row, first, end, x, y, z)
        image[row] = 0
        for k in range(2):
            first = np.int64(runs[row, k, 0])
            end = np.int64(runs[row, k, 1])
            if first >= end:
                continue
            if _has_open(x[first:end]):
                mark_covered(outlines, points, turns, outline_number, row, winding, covered)
                _place_rigid(maps[rigid], shape, row, first, end, covered, x, y, z)
            _sample(
                pairs, shape, x[first:end], y[first:end], z[first:end], offsets, corners,
                image[row, first:end],
            )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def fill_elements(
    spans, used, runs, rigid, black, outlines, points, turns, outline_number, elements
):
    """Which map holds at each pixel: fills ``elements`` (rows, columns) int32.

    Args:
        rigid: the number of the map outside the mesh. black: what stands for no map.
        spans … outline_number: as for `sample_spans`.
    """
    rows, columns = elements.shape
    winding = np.empty(columns + 1, dtype=np.int32)
    covered = np.empty(columns, dtype=np.bool_)
    for row in range(rows):
        elements[row] = black
        for k in range(2):
            elements[row, runs[row, k, 0] : runs[row, k, 1]] = rigid
        for k in range(used[row]):
            span = spans[row, k]
            elements[row, span & _COLUMN : span >> END_SHIFT & _COLUMN] = span >> CUT_SHIFT
        if (elements[row] == rigid).any():
            mark_covered(outlines, points, turns, outline_number, row, winding, covered)
            for i in range(columns):
                if elements[row, i] == rigid and covered[i]:
                    elements[row, i] = black


@njit(cache=True, nogil=True, error_model="numpy")
def _has_open(x):
    """Whether a pixel has not been written."""
    least = np.float32(0.0)
    for k in range(len(x)):
        least = min(least, x[k])
    return least == _OPEN


@njit(cache=True, nogil=True, error_model="numpy")
def _place_rigid(m, shape, row, first, end, covered, x, y, z):
    """Places the pixels that are still open by the rigid map, or nowhere if covered at rest."""
    i = first
    while i < end:
        if x[i] != _OPEN:
            i += 1
            continue
        if covered[i]:
            x[i] = _NOTHING
            i += 1
            continue
        start = i
        while i < end and x[i] == _OPEN and not covered[i]:
            i += 1
        _place(m, False, shape, row, start, i, x, y, z)


@njit(inline="always", error_model="numpy")
def _place(m, inside, shape, row, first, end, x, y, z):
    """Rest coordinates (voxels) of the pixels of a span."""
    x0 = m[0, 0] + m[0, 2] * row
    y0 = m[1, 0] + m[1, 2] * row
    z0 = m[2, 0] + m[2, 2] * row
    low = first
    high = end
    if not inside:
        low, high = _within(x0, m[0, 1], low, high, shape[0])
        low, high = _within(y0, m[1, 1], low, high, shape[1])
        low, high = _within(z0, m[2, 1], low, high, shape[2])
        for i in range(first, low):
            x[i] = _NOTHING
        for i in range(high, end):
            x[i] = _NOTHING
    # The start of a span is exact to float32 in the volume, and its steps are small.
    fx = np.float32(x0 + m[0, 1] * low)
    fy = np.float32(y0 + m[1, 1] * low)
    fz = np.float32(z0 + m[2, 1] * low)
    gx = np.float32(m[0, 1])
    gy = np.float32(m[1, 1])
    gz = np.float32(m[2, 1])
    count = high - low
    for c in range(0, count, _LANES):
        px = x[low + c : low + c + _LANES]
        py = y[low + c : low + c + _LANES]
        pz = z[low + c : low + c + _LANES]
        for k in range(_LANES):
            step = np.float32(np.int32(c + k))
            within = np.int32(c + k) < np.int32(count)
            px[k] = fx + gx * step if within else px[k]
            py[k] = fy + gy * step if within else py[k]
            pz[k] = fz + gz * step if within else pz[k]


@njit(cache=True, nogil=True, error_model="numpy")
def _within(start, slope, first, end, count):
    """First and end column of a span whose index lies between the volume's outer faces."""
    if first >= end or (
        inside_volume(start + slope * first, count)
        and inside_volume(start + slope * (end - 1), count)
    ):
        return first, end
    # Guess by a division, which is rounded; then test.
    low = np.float64(first)
    high = np.float64(end - 1)
    if slope > 0.0:
        low = max(low, np.floor((-0.5 - start) / slope))
        high = min(high, np.ceil((count - 0.5 - start) / slope))
    elif slope < 0.0:
        low = max(low, np.floor((count - 0.5 - start) / slope))
        high = min(high, np.ceil((-0.5 - start) / slope))
    if not low <= high:
        return end, end
    first = np.int64(low)
    last = np.int64(high)
    while first <= last and not inside_volume(start + slope * first, count):
        first += 1
    while last >= first and not inside_volume(start + slope * last, count):
        last -= 1
    return (first, last + 1) if first <= last else (end, end)


@njit(cache=True, nogil=True, error_model="numpy")
def _sample(pairs, shape, x, y, z, offsets, corners, line):
    """Trilinear values of pixels of a row; 0 for those that have no place."""
    # All loops here count from 0 and indices are unsigned: numba lets a signed index count from
    # the end, and a test for that keeps a loop from being vectorised.
    last_x = np.float32(shape[0] - 1)
    last_y = np.float32(shape[1] - 1)
    last_z = np.float32(shape[2] - 1)
    lower_x = np.int32(max(shape[0] - 2, 0))
    lower_y = np.int32(max(shape[1] - 2, 0))
    lower_z = np.int32(max(shape[2] - 2, 0))
    zero = np.float32(0.0)
    for k in range(len(line)):
        a = x[k] if x[k] > zero else zero
        b = y[k] if y[k] > zero else zero
        c = z[k] if z[k] > zero else zero
        a = a if a < last_x else last_x
        b = b if b < last_y else last_y
        c = c if c < last_z else last_z
        i = min(np.int32(a), lower_x)
        j = min(np.int32(b), lower_y)
        n = min(np.int32(c), lower_z)
        offsets[k] = (np.int64(i) * shape[1] + np.int64(j)) * shape[2] + n
        y[k] = b - np.float32(j)
        z[k] = c - np.float32(n)
        # The sign tells black pixels from others.
        x[k] = a - np.float32(i) if x[k] > _NOTHING else _NOTHING
    to_y = np.uint64(shape[2] if shape[1] > 1 else 0)
    to_x = np.uint64(shape[1] * shape[2] if shape[0] > 1 else 0)
    p00 = corners[0]
    p01 = corners[1]
    p10 = corners[2]
    p11 = corners[3]
    for k in range(len(line)):
        near = np.uint64(offsets[k])
        p00[k] = pairs[near]
        p01[k] = pairs[near + to_y]
        p10[k] = pairs[near + to_x]
        p11[k] = pairs[near + to_x + to_y]
    for k in range(len(line)):
        fz = z[k]
        c00 = _blend_pair(p00[k], fz)
        c01 = _blend_pair(p01[k], fz)
        c10 = _blend_pair(p10[k], fz)
        c11 = _blend_pair(p11[k], fz)
        c0 = c00 + y[k] * (c01 - c00)
        c1 = c10 + y[k] * (c11 - c10)
        value = c0 + x[k] * (c1 - c0)
        line[k] = np.uint8(np.int32(value + np.float32(0.5))) if x[k] >= zero else np.uint8(0)


@njit(inline="always", error_model="numpy")
def _blend_pair(pair, way):
    """The value between the two voxels of a pair."""
    low = np.float32(pair & np.uint16(255))
    return low + way * (np.float32(pair >> np.uint16(8)) - low)
