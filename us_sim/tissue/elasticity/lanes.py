"""Rows of sixty-four numbers, one a cell or a tetrahedron, which neo-Hookean loops run along.

Row r of a buffer begins at r * `LANES`. These functions are inlined into the loops that call them,
so that the row is a constant there.

>>> import numpy as np
>>> from us_sim.tissue.elasticity.lanes import LANES, in_lanes, three
>>> lanes = in_lanes(np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]))
>>> lanes.shape == (1, 3 * LANES), lanes[0, :3], lanes[0, LANES : LANES + 3]
(True, array([1., 4., 0.]), array([2., 5., 0.]))
>>> three(lanes[0], 0, 1) == (4.0, 5.0, 6.0)
True
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit
from us_sim.tissue.elasticity.neo_hookean_point import INLINED

LANES = 64
"""Numbers in a row: a few vectors of the widest kind, so that all rows stay in the L1 cache."""


def in_lanes(table: NDArray) -> NDArray:
    """(chunks, R * LANES) from (M, R): one row after the other of LANES lines of the table."""
    chunks = -(-len(table) // LANES)
    padded = np.zeros((chunks * LANES, table.shape[1]), dtype=table.dtype)
    padded[: len(table)] = table
    lanes = padded.reshape(chunks, LANES, -1).transpose(0, 2, 1)
    return np.ascontiguousarray(lanes).reshape(chunks, -1)


@njit(**INLINED)
def three(rows, row, w):
    """Three rows from ``row`` on: a vector."""
    v = row * LANES + w
    return rows[v], rows[v + LANES], rows[v + 2 * LANES]


@njit(**INLINED)
def five(rows, row, w):
    """Five rows from ``row`` on, of the five tetrahedra of a cell."""
    v = row * LANES + w
    return (
        rows[v],
        rows[v + LANES],
        rows[v + 2 * LANES],
        rows[v + 3 * LANES],
        rows[v + 4 * LANES],
    )


@njit(**INLINED)
def nine(rows, row, w):
    """Nine rows from ``row`` on: a matrix, row by row."""
    v = row * LANES + w
    return (
        rows[v],
        rows[v + LANES],
        rows[v + 2 * LANES],
        rows[v + 3 * LANES],
        rows[v + 4 * LANES],
        rows[v + 5 * LANES],
        rows[v + 6 * LANES],
        rows[v + 7 * LANES],
        rows[v + 8 * LANES],
    )


@njit(**INLINED)
def put_six(values, rows, row, w):
    """Fill six rows from ``row`` on: a symmetric matrix, xx, xy, xz, yy, yz, zz."""
    v = row * LANES + w
    rows[v] = values[0]
    rows[v + LANES] = values[1]
    rows[v + 2 * LANES] = values[2]
    rows[v + 3 * LANES] = values[3]
    rows[v + 4 * LANES] = values[4]
    rows[v + 5 * LANES] = values[5]


@njit(**INLINED)
def put_nine(values, rows, row, w):
    """Fill nine rows from ``row`` on: a matrix, row by row."""
    v = row * LANES + w
    rows[v] = values[0]
    rows[v + LANES] = values[1]
    rows[v + 2 * LANES] = values[2]
    rows[v + 3 * LANES] = values[3]
    rows[v + 4 * LANES] = values[4]
    rows[v + 5 * LANES] = values[5]
    rows[v + 6 * LANES] = values[6]
    rows[v + 7 * LANES] = values[7]
    rows[v + 8 * LANES] = values[8]
