"""Parts of a graph that hang together, by NumPy alone: who only looks at meshes needs no SciPy.

Each vertex points to one with a lower number, and edges and pointers are followed together until
nothing changes, which takes few rounds however long the parts are (Shiloach and Vishkin, *An
O(log n) parallel connectivity algorithm*, 1982).

>>> from us_sim.geometry.connected_parts import connected_parts
>>> connected_parts(5, [0, 3], [2, 4])
array([0, 1, 0, 2, 2])
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def connected_parts(count: int, one: ArrayLike, other: ArrayLike) -> NDArray[np.int64]:
    """(``count``,) the part of each vertex, from 0 in the order of their first vertices.

    Args:
        count: of vertices.
        one, other: (E,) the vertices that each edge joins.
    """
    ends = np.concatenate([np.asarray(one, np.int64), np.asarray(other, np.int64)])
    others = np.roll(ends, len(ends) // 2)
    lowest = np.arange(count)
    while True:
        before = lowest.copy()
        reached = before[others]
        np.minimum.at(lowest, before[ends], reached)  # the root of a vertex, to its neighbour's
        np.minimum.at(lowest, ends, reached)
        lowest = lowest[lowest]
        if np.array_equal(lowest, before):
            return np.unique(lowest, return_inverse=True)[1].astype(np.int64)
