"""Fewer triangles by merging vertices that are close together at rest.

Vertices are merged in the cells of a grid (J. Rossignac and P. Borrel, "Multi-resolution 3D
approximations for rendering complex scenes", 1993), each cell into the vertex nearest to their
mean. So what is left are vertices of the surface itself, and where they are in a deformed state
needs no more than to pick them. A closed surface stays closed: as a sum of oriented triangles it
has no edge left over before, and so none after.

>>> import numpy as np
>>> from us_sim.viewer.meshes.clustering import clustered
>>> square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [1.01, 1.01, 0], [0, 1, 0]])
>>> fan = np.array([[0, 1, 2], [1, 3, 2], [2, 3, 4], [0, 2, 4]])
>>> clustered(square, fan, cell=0.1)
array([[0, 1, 2],
       [0, 2, 4]])
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_TRIALS = 12
"""Each halves the range in which the cell's size lies."""
_SMALLEST, _LARGEST = 0.2, 20.0
"""Cells over the mean length of edges."""


def clustered(
    vertices: NDArray[np.floating], triangles: NDArray[np.integer], cell: float
) -> NDArray[np.integer]:
    """(F, 3) triangles of the same vertices, those that are left when vertices are merged.

    Args:
        vertices: (V, 3) m. triangles: (T, 3).
        cell: m, side of the cells of the grid.
    """
    used, corners = np.unique(triangles, return_inverse=True)
    points = vertices[used]
    grid = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    _, cells = np.unique(grid @ _strides(grid), return_inverse=True)
    cells = cells.ravel()
    count = np.bincount(cells)
    mean = np.column_stack([np.bincount(cells, points[:, axis]) / count for axis in range(3)])
    distance = np.linalg.norm(points - mean[cells], axis=1)
    order = np.lexsort((distance, cells))
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    kept = used[order[first]]  # of each cell the vertex nearest to the mean
    merged = kept[cells[corners.ravel()]].reshape(-1, 3)
    apart = (merged != np.roll(merged, 1, axis=1)).all(axis=1)
    return _without_pairs(merged[apart])


def at_most(
    vertices: NDArray[np.floating], triangles: NDArray[np.integer], count: int
) -> NDArray[np.integer]:
    """About ``count`` triangles or fewer of a surface, all where it has no more.

    Args:
        vertices: (V, 3) m. triangles: (T, 3).
    """
    if len(triangles) <= count:
        return triangles
    sides = vertices[triangles] - vertices[np.roll(triangles, 1, axis=1)]
    length = float(np.linalg.norm(sides, axis=2).mean())
    low, high = np.log(_SMALLEST * length), np.log(_LARGEST * length)
    best = clustered(vertices, triangles, float(np.exp(high)))
    for _ in range(_TRIALS):
        middle = (low + high) / 2
        tried = clustered(vertices, triangles, float(np.exp(middle)))
        if len(tried) > count:
            low = middle
        else:
            best, high = tried, middle
    return best


def _strides(grid: NDArray[np.int64]) -> NDArray[np.int64]:
    """(3,) that give every cell of the grid a number of its own."""
    shape = grid.max(axis=0) + 1
    return np.array([shape[1] * shape[2], shape[2], 1])


def _without_pairs(triangles: NDArray[np.integer]) -> NDArray[np.integer]:
    """Triangles without those that lie on each other and face opposite ways, first node smallest.

    So many of the same three nodes are left as face one way more than the other.
    """
    smallest = triangles.argmin(axis=1)[:, None]
    turned = np.take_along_axis(triangles, (smallest + np.arange(3)) % 3, axis=1)
    is_even = turned[:, 1] < turned[:, 2]
    nodes = np.column_stack([turned[:, 0], np.sort(turned[:, 1:], axis=1)])
    nodes, which = np.unique(nodes, axis=0, return_inverse=True)
    balance = np.bincount(which.ravel(), np.where(is_even, 1, -1), minlength=len(nodes)).astype(int)
    nodes[balance < 0, 1:] = nodes[balance < 0, :0:-1]
    return np.repeat(nodes, np.abs(balance), axis=0)
