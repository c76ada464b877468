"""The lumens of groups of sixty-four cells or tetrahedra, of which most groups have none.

What `emptying` says of a tetrahedron is added to what the loops over solids have found, in a loop
of its own, so that a tissue without vessels takes no longer.

>>> import numpy as np
>>> from us_sim.tissue.elasticity.lumen import CONSTANTS
>>> from us_sim.tissue.elasticity.lumen_lanes import in_groups
>>> table = np.zeros((200, 1, CONSTANTS))  # one tetrahedron a line
>>> table[150] = 1.0
>>> rows, constants = in_groups(table, np.float32)
>>> rows.tolist(), constants.shape
([-1, -1, 0, -1], (1, 384))
"""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike, NDArray

from us_sim.kernels import njit
from us_sim.tissue.elasticity.cell_lanes import gradients
from us_sim.tissue.elasticity.lanes import LANES, in_lanes
from us_sim.tissue.elasticity.lumen import emptying
from us_sim.tissue.elasticity.neo_hookean_point import INLINED, volume_change


def in_groups(table: NDArray, dtype: DTypeLike) -> tuple[NDArray[np.int32], NDArray]:
    """(C,) which row of the other array each group of `LANES` lines has, or -1 if it has no lumen;
    and (L, CONSTANTS * K * LANES) the constants of those that have one.

    Args:
        table: (R, K, CONSTANTS), volumes times those of `lumen_table`, of K tetrahedra a line.
        dtype: of the constants.
    """
    groups = -(-len(table) // LANES)
    padded = np.zeros((groups * LANES, *table.shape[1:]))
    padded[: len(table)] = table
    padded[..., 5] = np.where(padded[..., 0] > 0, padded[..., 5], 1.0)  # no division by zero
    there = padded[..., 0].reshape(groups, -1).any(axis=1)
    row = np.where(there, np.cumsum(there) - 1, -1).astype(np.int32)
    lines = padded.transpose(0, 2, 1).reshape(len(padded), -1)
    return row, in_lanes(lines).astype(dtype)[there]


@njit(**INLINED)
def emptied(h, lumen, v, step):
    """`emptying` of a tetrahedron, times its volume; its constants are at v and so many apart."""
    return emptying(
        volume_change(h),
        (
            lumen[v],
            lumen[v + step],
            lumen[v + 2 * step],
            lumen[v + 3 * step],
            lumen[v + 4 * step],
            lumen[v + 5 * step],
        ),
    )


@njit(**INLINED)
def add_lumens(field, rows, lumen, entry, row, lanes):
    """Add to the five rows from ``row`` on an entry of `emptied` of each tetrahedron of cells."""
    for w in range(LANES):
        p, q, r, s, t = gradients(field, rows, w)
        v = row * LANES + w
        lanes[v] += emptied(p, lumen, w, 5 * LANES)[entry]
        lanes[v + LANES] += emptied(q, lumen, w + LANES, 5 * LANES)[entry]
        lanes[v + 2 * LANES] += emptied(r, lumen, w + 2 * LANES, 5 * LANES)[entry]
        lanes[v + 3 * LANES] += emptied(s, lumen, w + 3 * LANES, 5 * LANES)[entry]
        lanes[v + 4 * LANES] += emptied(t, lumen, w + 4 * LANES, 5 * LANES)[entry]
