"""Grey values of an image from its spans, a row of pixels at a time.

Coordinates at rest are written span after span and only then sampled, so that short spans of a fine
mesh stop neither loads nor arithmetic. They are fixed-point numbers, accurate to a ten-thousandth
of a voxel, and grey values are blended in 16 bits, 32 pixels at a time with vectors of 512 bits, to
a tenth of a level. Two vector operations that numba lacks are written in LLVM's instructions.

Voxel centres lie at whole indices. A point within half a voxel of the outermost centres takes
their value; beyond that everything is 0. Values are rounded half up.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from us_sim.kernels import njit
from us_sim.slicing.cutting.cut_polygons import CUT_SHIFT, END_SHIFT, mark_covered

SLACK = 1e-6
"""Voxels by which a point may miss the volume's outer faces: rounding of the map, no more."""

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
def sample_spans(  # noqa: PLR0913
    voxels, shape, maps, inside, rigid, spans, used, runs,
    is_covered, outlines, points, turns, outline_number, first_row, end_row, image,
):  # fmt: skip
    """Fill rows ``first_row`` to ``end_row - 1`` of an image with trilinear grey values.

    Shapes and units:
        voxels: (I*J*K,) uint8, shape: (3,) its sides; where K is 1 each voxel is there twice.
        maps, inside: as `cut_polygons.Cuts`; the map with the number ``rigid`` is that of pixels
            outside the mesh.
        spans, used, runs: as for `cut_polygons.convert_cuts`.
        is_covered: whether the spans are known to leave no pixel out; then there need be no
            outline. outlines … outline_number: as `cut_polygons.Outline`.
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
                _blacken_nowhere(x[first:end], line[first:end])


@njit(cache=True, nogil=True, error_model="numpy")
def _blacken_nowhere(x, line):
    """Set the pixels without a place at rest to 0."""
    for i in range(len(x)):
        if x[i] < 0:
            line[i] = 0


@njit(cache=True, nogil=True, error_model="numpy")
def fill_elements(  # noqa: PLR0913
    spans, used, runs, rigid, black, outlines, points, turns, outline_number, steps, columns,
    elements,
):  # fmt: skip
    """Fill ``elements`` int32 with the numbers of the maps of every n-th row and column.

    Shapes and units:
        rigid: the number of the map outside the mesh. black: the number for no map.
        spans … outline_number: as for `sample_spans`.
        steps: (2,) rows and columns of the image from one element to the next.
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
    """Write rest coordinates of the pixels of a span that lies well among the voxels' centres."""
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
    """Return True if both ends of a span, and so all of it, lie well among the voxels' centres."""
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
    """Write rest coordinates of the pixels of a span, held at the volume's borders."""
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
            x[i] = _clamp_index(m[0, 0] + m[0, 2] * row + m[0, 1] * i, shape[0])
            y[i] = _clamp_index(m[1, 0] + m[1, 2] * row + m[1, 1] * i, shape[1])
            z[i] = _clamp_index(m[2, 0] + m[2, 2] * row + m[2, 1] * i, shape[2])
        else:
            x[i] = _NOWHERE
            y[i] = z[i] = 0


@njit(inline="always", error_model="numpy")
def _clamp_index(index, count):
    last = max(count - 1, 0) * _ONE - 1.0
    return np.int32(max(0.0, min(index * _ONE, last)))


@njit(cache=True, nogil=True, error_model="numpy")
def _write_rigid(m, shape, row, first, end, covered, x, y, z):  # noqa: PLR0913
    """Place the pixels that are still open by the rigid map, or nowhere if covered at rest."""
    i = first
    while i < end:
        start = i
        while i < end and x[i] == _OPEN and not covered[i]:
            i += 1
        if start < i:
            _write_clipped(m, shape, row, start, i, x, y, z)
        elif x[i] == _OPEN:
            x[i] = _NOWHERE
            y[i] = z[i] = 0
            i += 1
        else:
            i += 1


@njit(cache=True, nogil=True, error_model="numpy")
def _between(least, most, start, slope, first, end):
    """Return first and end column of a span where an index lies from ``least`` to ``most``."""
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
    least = np.int32(0)
    for k in range(len(x)):
        least = min(least, x[k])
    return least


@njit(inline="always", error_model="numpy")
def _sample(voxels, shape, x, y, z, room, line):
    """Fill a row with trilinear values; pixels that lie nowhere get any value.

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
    """Blend a pair of grey values, in 64ths; ``weight`` is the second's, in 32768ths."""
    low = np.int16(pair & np.uint16(255))
    to_high = np.int16(np.int16(pair >> np.uint16(8)) - low)
    step = np.int16((np.int32(np.int16(to_high << np.int16(7))) * np.int32(weight)) >> np.int32(16))
    return np.int16(np.int16(low << np.int16(6)) + step)


@njit(inline="always", error_model="numpy")
def _blend(low, high, weight):
    """Blend two values, all in 64ths; ``weight`` is the second's, in 32768ths."""
    to_high = np.int16(np.int16(high - low) << np.int16(1))
    return np.int16(low + np.int16((np.int32(to_high) * np.int32(weight)) >> np.int32(16)))


LANES = 16
"""Numbers that are read or written at once: arrays need room for as many beyond their last one."""

_NUMBER = ir.IntType(32)
_VECTOR = ir.VectorType(_NUMBER, LANES)
_PAIR = ir.IntType(16)
_PAIRS = ir.VectorType(_PAIR, LANES)
_INDEX = ir.IntType(64)


def _write_ramp(_: Any, array: Any, index: Any, start: Any, step: Any, count: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array, index, *numbers = arguments
        data = context.make_array(signature.args[0])(context, builder, array).data
        start, step, count = (_broadcast(builder, number) for number in numbers)
        lane = ir.Constant(_VECTOR, list(range(LANES)))
        ramp = builder.add(start, builder.mul(step, lane))
        place = builder.bitcast(builder.gep(data, [index]), _VECTOR.as_pointer())
        before = builder.load(place)
        before.align = 1
        within = builder.icmp_signed("<", lane, count)
        builder.store(builder.select(within, ramp, before), place).align = 1
        return context.get_dummy_value()

    # Indices and numbers of any type are converted.
    numbers = [types.int32 for _ in (start, step, count)]
    return types.void(array, index, *numbers), generate


def _load_pairs(  # noqa: PLR0913
    _: Any, voxels: Any, near: Any, first: Any, to_y: Any, to_x: Any, p00: Any, p01: Any,
    p10: Any, p11: Any,
) -> Any:  # fmt: skip
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def data(argument: int) -> Any:
            array = context.make_array(signature.args[argument])
            return array(context, builder, arguments[argument]).data

        _, _, first, to_y, to_x, *_ = arguments
        origin = data(0)
        corners = [
            builder.gep(origin, [step])
            for step in (ir.Constant(_INDEX, 0), to_y, to_x, builder.add(to_x, to_y))
        ]
        pairs = [ir.Constant(_PAIRS, ir.Undefined)] * 4
        places = builder.gep(data(1), [first])
        for lane in range(LANES):
            place = builder.load(builder.gep(places, [ir.Constant(_INDEX, lane)]))
            place = builder.zext(place, _INDEX)
            for k, corner in enumerate(corners):
                pair = builder.load(
                    builder.bitcast(builder.gep(corner, [place]), _PAIR.as_pointer())
                )
                pair.align = 1
                pairs[k] = builder.insert_element(pairs[k], pair, ir.Constant(_NUMBER, lane))
        for k, loaded in enumerate(pairs):
            place = builder.bitcast(builder.gep(data(5 + k), [first]), _PAIRS.as_pointer())
            builder.store(loaded, place).align = 1
        return context.get_dummy_value()

    index = types.uint64
    numbers = [index for _ in (first, to_y, to_x)]
    return types.void(voxels, near, *numbers, p00, p01, p10, p11), generate


def _broadcast(builder: Any, number: Any) -> Any:
    empty = ir.Constant(_VECTOR, ir.Undefined)
    one = builder.insert_element(empty, number, ir.Constant(_NUMBER, 0))
    return builder.shuffle_vector(one, empty, ir.Constant(_VECTOR, [0] * LANES))


write_ramp: Any = intrinsic(_write_ramp)
"""``write_ramp(array, index, start, step, count)`` writes start, start + step, … to an int32 array.

It writes ``count`` numbers from ``array[index]`` on, at most `LANES` of them, without a loop: one
of so few rounds is not vectorised, or does most of them in its tail.
"""

load_pairs: Any = intrinsic(_load_pairs)
"""``load_pairs(voxels, near, first, to_y, to_x, p00, p01, p10, p11)`` loads for `LANES` pixels.

From the voxel ``near[first]`` (uint32) of a uint8 array, the one ``to_y`` further, the one ``to_x``
further, and the one both further: each with the next one times 256, as one uint16. They are put
together in registers, since a store of each would take longer than its load.
"""
