"""Scan conversion: which columns of each row of an image lie in which cut.

A row belongs to a side of a polygon from its upper end to just above its lower end, and a column
to a polygon from its left side to just before its right side. Since two tetrahedra compute the
side between them from the same corners, no pixel is missed there and none is written twice.
"""

from __future__ import annotations

import numpy as np

from us_sim.kernels import njit

CUT_SHIFT, END_SHIFT = 26, 13
"""A span is one number: bits by which its cut and its end are shifted there. The lowest bits are
its first column. A column is at most 4096."""

_CLOSE = 1e-8
"""Pixels from an outline within which a place is on it: rounding of positions."""


@njit(cache=True, nogil=True, error_model="numpy")
def convert_cuts(
    corners, sides, count, outlines, points, owner, pieces, runs, first_row, end_row, spans, used
):  # fmt: skip
    """Fills the spans of rows ``first_row`` to ``end_row - 1``; returns the most that a row has.

    Where that is more than there is room for, the rest is lost. Where spans overlap the later one
    holds.

    Args:
        corners … pieces: as `cut_polygons.Cuts`, with how many there are.
        runs: (rows, 2, 2) int32, first and end columns that show something.
        spans: (rows, room) int64. used: (rows,) int32, how many of them a row has.
    """
    low = np.empty(end_row - first_row, dtype=np.int64)
    high = np.empty(end_row - first_row, dtype=np.int64)
    columns = np.int64(0)
    kinds = np.uint64(1)
    for row in range(first_row, end_row):
        used[row] = 0
        columns = max(columns, max(np.int64(runs[row, 0, 1]), np.int64(runs[row, 1, 1])))
        if runs[row, 1, 1] > runs[row, 1, 0]:
            kinds = np.uint64(2)
    for q in range(pieces):
        top = np.inf
        bottom = -np.inf
        for k in range(points[q]):
            top = min(top, outlines[q, k, 1])
            bottom = max(bottom, outlines[q, k, 1])
        for row in range(up_to(top - _CLOSE, first_row, end_row),
                         min(up_to(bottom + _CLOSE, first_row, end_row) + 1, end_row)):  # fmt: skip
            first, end = closed_columns(outlines[q], points[q], row, columns)
            _add(owner[q], first, end, row, runs, kinds, spans, used)
    for q in range(count):
        if sides[q] == 0:
            continue
        top = np.inf
        bottom = -np.inf
        for k in range(sides[q]):
            top = min(top, corners[q, k, 1])
            bottom = max(bottom, corners[q, k, 1])
        above = up_to(top, first_row, end_row)
        below = up_to(bottom, first_row, end_row)
        for row in range(above, below):
            low[np.uint64(row - first_row)] = columns
            high[np.uint64(row - first_row)] = 0
        for k in range(sides[q]):
            other = k + 1 if k + 1 < sides[q] else 0
            a, b = (k, other) if corners[q, k, 1] < corners[q, other, 1] else (other, k)
            column = corners[q, a, 0]
            start = corners[q, a, 1]
            slope = (corners[q, b, 0] - column) / (corners[q, b, 1] - start)
            for row in range(
                up_to(start, first_row, end_row), up_to(corners[q, b, 1], first_row, end_row)
            ):
                at = up_to(column + (row - start) * slope, 0, columns)
                line = np.uint64(row - first_row)
                low[line] = min(low[line], at)
                high[line] = max(high[line], at)
        for row in range(above, below):
            line = np.uint64(row - first_row)
            _add(q, low[line], high[line], row, runs, kinds, spans, used)
    most = 0
    for row in range(first_row, end_row):
        most = max(most, used[row])
    return most


@njit(inline="always", error_model="numpy")
def up_to(value, least, most):
    """The least whole number not below a value, held between two others; the first if not one."""
    held = value if value > least else np.float64(least)
    held = held if held < most else np.float64(most)
    return np.int64(np.ceil(held))


@njit(inline="always", error_model="numpy")
def _add(q, first, end, row, runs, kinds, spans, used):
    """Adds a span of cut ``q``, as far as the row shows something."""
    line = np.uint64(row)
    for k in range(kinds):
        a = max(first, np.int64(runs[line, k, 0]))
        b = min(end, np.int64(runs[line, k, 1]))
        # An empty span is written too, and overwritten: faster than to test for it.
        place = np.uint64(used[line])
        if place < np.uint64(spans.shape[1]):
            spans[line, place] = np.int64(q) << CUT_SHIFT | b << END_SHIFT | a
        used[line] += a < b


@njit(inline="always", error_model="numpy")
def closed_columns(outline, points, row, columns):
    """First and end column of a row that lie on a closed point, segment or triangle."""
    left = np.inf
    right = -np.inf
    for k in range(points):
        other = k + 1 if k + 1 < points else 0
        a, b = (k, other) if outline[k, 1] <= outline[other, 1] else (other, k)
        start = outline[a, 1]
        height = outline[b, 1] - start
        if row + _CLOSE < start or row - _CLOSE > start + height:
            continue
        t = 0.0
        u = 1.0
        if height > 0.0:
            t = max(0.0, (row - _CLOSE - start) / height)
            u = min(1.0, (row + _CLOSE - start) / height)
        from_a = outline[a, 0] + t * (outline[b, 0] - outline[a, 0])
        to_b = outline[a, 0] + u * (outline[b, 0] - outline[a, 0])
        left = min(left, min(from_a, to_b))
        right = max(right, max(from_a, to_b))
    first = up_to(left - _CLOSE, 0, columns)
    end = up_to(right + _CLOSE, 0, columns)
    # The end is just beyond the last column that is not right of the outline.
    if right + _CLOSE >= 0.0 and np.floor(right + _CLOSE) < columns and end <= right + _CLOSE:
        end += 1
    return first, end
