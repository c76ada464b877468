"""Grey values of an image from its spans, a row of pixels at a time.

Where the pixels of a row lie at rest is written span after span, and only then are they sampled,
so that neither the loads nor the arithmetic stop at the short spans of a fine mesh. Coordinates
are fixed-point numbers, accurate to a ten-thousandth of a voxel, and grey values are blended in
16 bits, 32 pixels at a time on a processor with vectors of 512 bits, to a tenth of a level.

Voxel centres lie at whole indices. A point within half a voxel of the outermost centres takes
their value; beyond that everything is 0. Values are rounded half up.
"""

from __future__ import annotations

import numpy as np

from us_sim.kernels import njit
from us_sim.slicing.cutting.rest_outline import mark_covered
from us_sim.slicing.cutting.simd import LANES, load_pairs, write_ramp
from us_sim.slicing.cutting.spans import CUT_SHIFT, END_SHIFT
from us_sim.slicing.cutting.trilinear import SLACK

_FRACTION = 17  # bits behind the point of a coordinate
_DROPPED = 2  # number of these bits that a blend leaves out
_ONE = float(1 << _FRACTION)

MOST_VOXELS_A_SIDE = 1 << 31 - _FRACTION
MOST_VOXELS = 1 << 32

INNER_MARGIN = 1e-3
"""Voxels from the outermost centres beyond which rounding cannot lead a coordinate outside."""

_OPEN = -1  # first coordinate of a pixel that has not been written yet
_NOWHERE = -2  # first coordinate of a pixel without a place at rest

_COLUMN = (1 << END_SHIFT) - 1


@njit(cache=True, nogil=True, error_model="numpy")
def sample_spans(
    voxels, shape, maps, inside, rigid, spans, used, runs,
    is_covered, outlines, points, turns, outline_number, first_row, end_row, image,
):  # fmt: skip
    """Trilinear grey values of rows ``first_row`` to ``end_row - 1`` of an image.

    Args:
        voxels: (I*J*K,) uint8, shape: (3,) its sides; where K is 1 each voxel is there twice.
        maps, inside: as `cut_polygons.Cuts`; the map with the number ``rigid`` is that of pixels
            outside the mesh.
        spans, used, runs: as for `spans.convert_cuts`.
        is_covered: whether the spans are known to leave no pixel out; then there need be no
            outline. outlines … outline_number: as `rest_outline.Outline`.
        image: (rows, columns) uint8, filled here.
    """
    columns = image.shape[1]
    # With lines of a multiple of 4096 bytes, loads would wait for stores to other lines.
    room = np.empty((11, (columns + LANES + 671) // 1024 * 1024 + 352), dtype=np.int32)
    x = room[0]
    y = room[1]
    z = room[2]
    # Pixels are loaded in groups: the last one, beyond the row's end, needs valid places too.
    room[3] = 0
    winding = np.empty(columns + 1, dtype=np.int32)
    covered = np.empty(columns, dtype=np.bool_)
    for row in range(first_row, end_row):
        # Some pixels may be negative: open, or nowhere.
        doubtful = not is_covered
        if doubtful:
            x[:columns] = _OPEN
        for k in range(used[row]):
            span = spans[row, k]
            q = np.uint64(span >> CUT_SHIFT)
            first = span & _COLUMN
            end = span >> END_SHIFT & _COLUMN
            if inside[q] or _is_inner(maps[q], shape, row, first, end):
                _write_span(maps[q], row, first, end, x, y, z)
            else:
                _write_clipped(maps[q], shape, row, first, end, x, y, z)
                doubtful = True
        line = image[row]
        if runs[row, 0, 1] - runs[row, 0, 0] < columns:
            line[:] = 0
        for k in range(2):
            first = np.int64(runs[row, k, 0])
            end = np.int64(runs[row, k, 1])
            if first >= end:
                continue
            negative = doubtful and _least(x[first:end]) < 0
            if negative and not is_covered:
                mark_covered(outlines, points, turns, outline_number, row, winding, covered)
                _write_rigid(maps[rigid], shape, row, first, end, covered, x, y, z)
            _sample(voxels, shape, x[first:end], y[first:end], z[first:end], room, line[first:end])
            if negative:
                for i in range(first, end):
                    if x[i] < 0:
                        line[i] = 0


@njit(cache=True, nogil=True, error_model="numpy")
def fill_elements(
    spans, used, runs, rigid, black, outlines, points, turns, outline_number, elements
):
    """Which map holds at each pixel: fills ``elements`` (rows, columns) int32.

    Args:
        rigid: the number of the map outside the mesh. black: the number for no map.
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
def fill_some_elements(
    spans, used, runs, rigid, black, outlines, points, turns, outline_number, steps, columns,
    elements,
):  # fmt: skip
    """As `fill_elements`, of every so many-th row and column of an image.

    Args:
        steps: (2,) rows and columns of the image from one element to the next.
        columns: of the image.
    """
    rows, places = elements.shape
    row_step = steps[0]
    step = np.uint32(steps[1])  # divides much faster than with a sign
    before = np.uint32(step - 1)
    winding = np.empty(columns + 1, dtype=np.int32)
    covered = np.empty(columns, dtype=np.bool_)
    for number in range(rows):
        row = number * row_step
        line = elements[number]
        line[:] = black
        for k in range(2):
            first = (np.uint32(runs[row, k, 0]) + before) // step
            end = (np.uint32(runs[row, k, 1]) + before) // step
            if first < end:
                line[np.int64(first) : np.int64(end)] = rigid
        for k in range(used[row]):
            span = spans[row, k]
            first = (np.uint32(span & _COLUMN) + before) // step
            end = (np.uint32(span >> END_SHIFT & _COLUMN) + before) // step
            element = np.int32(span >> CUT_SHIFT)
            for i in range(np.int64(first), np.int64(end)):
                line[np.uint64(i)] = element
        open_places = 0
        for i in range(places):
            open_places += line[i] == rigid
        if open_places:
            mark_covered(outlines, points, turns, outline_number, row, winding, covered)
            for i in range(places):
                if line[i] == rigid and covered[i * steps[1]]:
                    line[i] = black


@njit(inline="always", error_model="numpy")
def _write_span(m, row, first, end, x, y, z):
    """Rest coordinates of the pixels of a span, which lie well among the voxels' centres."""
    gx = m[0, 1] * _ONE
    gy = m[1, 1] * _ONE
    gz = m[2, 1] * _ONE
    x0 = (m[0, 0] + m[0, 2] * row) * _ONE
    y0 = (m[1, 0] + m[1, 2] * row) * _ONE
    z0 = (m[2, 0] + m[2, 2] * row) * _ONE
    column = first
    while column < end:
        at = np.uint64(column)
        left = np.int32(end - column)
        write_ramp(x, at, np.int32(x0 + gx * column), np.int32(gx), left)
        write_ramp(y, at, np.int32(y0 + gy * column), np.int32(gy), left)
        write_ramp(z, at, np.int32(z0 + gz * column), np.int32(gz), left)
        column += LANES


@njit(inline="always", error_model="numpy")
def _is_inner(m, shape, row, first, end):
    """Whether both ends of a span lie well among the voxels' centres, and so all of it."""
    inner = True
    for a in range(3):
        start = m[a, 0] + m[a, 2] * row
        at_first = start + m[a, 1] * first
        at_last = start + m[a, 1] * (end - 1)
        inner &= min(at_first, at_last) >= INNER_MARGIN
        inner &= max(at_first, at_last) <= shape[a] - 1 - INNER_MARGIN
    return inner


@njit(cache=True, nogil=True, error_model="numpy")
def _write_clipped(m, shape, row, first, end, x, y, z):
    """Rest coordinates of the pixels of a span, held at the volume's borders."""
    low = first
    high = end
    for a in range(3):
        start = m[a, 0] + m[a, 2] * row
        low, high = _between(
            -0.5 - SLACK, shape[a] - 0.5 + SLACK, start, m[a, 1], low, high
        )  # fmt: skip
    inner = low
    outer = high
    for a in range(3):
        start = m[a, 0] + m[a, 2] * row
        inner, outer = _between(
            INNER_MARGIN, shape[a] - 1 - INNER_MARGIN, start, m[a, 1], inner, outer
        )  # fmt: skip
    for i in range(first, end):
        if i == inner and inner < outer:
            _write_span(m, row, inner, outer, x, y, z)
        if inner <= i < outer:
            continue
        if low <= i < high:
            x[i] = _held(m[0, 0] + m[0, 2] * row + m[0, 1] * i, shape[0])
            y[i] = _held(m[1, 0] + m[1, 2] * row + m[1, 1] * i, shape[1])
            z[i] = _held(m[2, 0] + m[2, 2] * row + m[2, 1] * i, shape[2])
        else:
            x[i] = _NOWHERE
            y[i] = 0
            z[i] = 0


@njit(inline="always", error_model="numpy")
def _held(index, count):
    """A coordinate from the first to just below the last voxel's centre."""
    last = max(count - 1, 0) * _ONE - 1.0
    return np.int32(max(0.0, min(index * _ONE, last)))


@njit(cache=True, nogil=True, error_model="numpy")
def _write_rigid(m, shape, row, first, end, covered, x, y, z):
    """Places the pixels that are still open by the rigid map, or nowhere if covered at rest."""
    i = first
    while i < end:
        start = i
        while i < end and x[i] == _OPEN and not covered[i]:
            i += 1
        if start < i:
            _write_clipped(m, shape, row, start, i, x, y, z)
        elif x[i] == _OPEN:
            x[i] = _NOWHERE
            y[i] = 0
            z[i] = 0
            i += 1
        else:
            i += 1


@njit(cache=True, nogil=True, error_model="numpy")
def _between(least, most, start, slope, first, end):
    """First and end column of a span where an index lies from ``least`` to ``most``."""
    if first >= end:
        return first, first
    at_first = start + slope * first
    at_last = start + slope * (end - 1)
    if min(at_first, at_last) >= least and max(at_first, at_last) <= most:
        return first, end
    # Guess by a division, which is rounded; then test.
    low = np.float64(first)
    high = np.float64(end - 1)
    if slope > 0.0:
        low = max(low, np.floor((least - start) / slope))
        high = min(high, np.ceil((most - start) / slope))
    elif slope < 0.0:
        low = max(low, np.floor((most - start) / slope))
        high = min(high, np.ceil((least - start) / slope))
    if not low <= high:
        return first, first
    one = np.int64(low)
    last = np.int64(high)
    while one <= last and not least <= start + slope * one <= most:
        one += 1
    while last >= one and not least <= start + slope * last <= most:
        last -= 1
    return one, last + 1


@njit(cache=True, nogil=True, error_model="numpy")
def _least(x):
    """The least of some numbers, or 0."""
    least = np.int32(0)
    for k in range(len(x)):
        least = min(least, x[k])
    return least


@njit(inline="always", error_model="numpy")
def _sample(voxels, shape, x, y, z, room, line):
    """Trilinear values of the pixels of a row; any value for those that lie nowhere.

    ``room``: (11, …) int32, of which the last eight lines are used.
    """
    # All loops here count from 0 and indices are unsigned: numba lets a signed index count from
    # the end, and a test for that keeps a loop from being vectorised.
    near = room[3].view(np.uint32)
    fx = room[4].view(np.int16)
    fy = room[5].view(np.int16)
    fz = room[6].view(np.int16)
    rows_of_pairs = np.int32(shape[1])
    pairs = np.int32(max(shape[2], 2))
    to_y = np.uint64(pairs if shape[1] > 1 else 0)
    to_x = np.uint64(shape[1] * pairs if shape[0] > 1 else 0)
    farthest = np.uint32(np.uint64(len(voxels) - 2) - to_x - to_y)
    weight = np.int32((1 << _FRACTION - _DROPPED) - 1)
    for k in range(len(line)):
        across = np.int32(np.int32(x[k] >> _FRACTION) * rows_of_pairs)
        across = np.int32(np.int32(across + np.int32(y[k] >> _FRACTION)) * pairs)
        at = np.uint32(across + np.int32(z[k] >> _FRACTION))
        near[k] = min(at, farthest)
        fx[k] = np.int16(x[k] >> _DROPPED & weight)
        fy[k] = np.int16(y[k] >> _DROPPED & weight)
        fz[k] = np.int16(z[k] >> _DROPPED & weight)
    p00 = room[7].view(np.uint16)
    p01 = room[8].view(np.uint16)
    p10 = room[9].view(np.uint16)
    p11 = room[10].view(np.uint16)
    for k in range(0, len(line), LANES):
        load_pairs(voxels, near, np.uint64(k), to_y, to_x, p00, p01, p10, p11)
    for k in range(len(line)):
        c0 = _blend(_blend_pair(p00[k], fz[k]), _blend_pair(p01[k], fz[k]), fy[k])
        c1 = _blend(_blend_pair(p10[k], fz[k]), _blend_pair(p11[k], fz[k]), fy[k])
        line[k] = np.uint8(np.int16(_blend(c0, c1, fx[k]) + np.int16(32)) >> np.int16(6))


@njit(inline="always", error_model="numpy")
def _blend_pair(pair, weight):
    """The blend of a pair of grey values, in 64ths; ``weight`` is the second's, in 32768ths."""
    low = np.int16(pair & np.uint16(255))
    to_high = np.int16(np.int16(pair >> np.uint16(8)) - low)
    step = np.int16((np.int32(np.int16(to_high << np.int16(7))) * np.int32(weight)) >> np.int32(16))
    return np.int16(np.int16(low << np.int16(6)) + step)


@njit(inline="always", error_model="numpy")
def _blend(low, high, weight):
    """The linear blend of two values, all in 64ths; ``weight`` is the second's, in 32768ths."""
    to_high = np.int16(np.int16(high - low) << np.int16(1))
    return np.int16(low + np.int16((np.int32(to_high) * np.int32(weight)) >> np.int32(16)))
