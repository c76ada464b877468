"""Distances from points to a surface of triangles.

>>> import numpy as np
>>> from us_sim.volume.surfaces.surface_distance import distances_to
>>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
>>> distances_to(np.array([[0.25, 0.25, 0.5], [2.0, 0, 0]]), corners, np.array([[0, 1, 2]]))
array([0.5, 1. ])
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from us_sim.kernels import njit

_NEAREST = 6
"""Samples of the surface whose triangles are looked at."""

_FINEST = 48
"""Parts into which an edge of a triangle is divided at most."""


def distances_to(
    points: NDArray[np.float64],
    vertices: NDArray[np.float64],
    triangles: NDArray[np.integer],
    spacing: float | None = None,
) -> NDArray[np.float64]:
    """(P,) m, from each point to the nearest of the triangles whose samples are nearest to it.

    Where another triangle is nearer still, a distance is too large, by less than the square of the
    spacing over the distance.

    Args:
        points: (P, 3) m.
        vertices: (V, 3) m.
        triangles: (T, 3) indices into vertices.
        spacing: m, between samples of the surface; the mean edge of its triangles where not given.
    """
    corners = vertices[triangles]  # (T, 3, 3)
    edges = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    samples, owners = _samples(corners, edges.max(axis=1) / (spacing or float(edges.mean())))
    _, near = cKDTree(samples).query(points, k=min(_NEAREST, len(samples)))
    around = owners[near].reshape(len(points), -1)
    found = np.empty(len(points))
    _measure(np.ascontiguousarray(points, dtype=np.float64), corners, around, found)
    return found


def _samples(
    corners: NDArray[np.float64], lengths: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Points (S, 3) in triangles (T, 3, 3), and whose they are (S,).

    Args:
        corners: of the triangles.
        lengths: (T,) of their longest edges, in units of the points' spacing.
    """
    parts = np.clip(np.ceil(lengths), 1, _FINEST).astype(np.int64)
    points, owners = [], []
    for count in np.unique(parts):
        which = np.flatnonzero(parts == count)
        i, j = (grid.ravel() for grid in np.indices((count, count)))
        inside = i + j < count
        one, other = (i[inside] + 1 / 3) / count, (j[inside] + 1 / 3) / count
        weights = np.stack([1.0 - one - other, one, other])  # (3, samples)
        points.append(np.einsum("tvx,vs->tsx", corners[which], weights).reshape(-1, 3))
        owners.append(np.repeat(which, inside.sum()))
    return np.concatenate(points), np.concatenate(owners)


@njit(cache=True, nogil=True, error_model="numpy")
def _measure(points, corners, around, found):
    """Fills found (P,) with distances to the triangles around (P, K) of corners (T, 3, 3)."""
    for p in range(len(points)):
        least = np.inf
        for n in range(around.shape[1]):
            least = min(least, _squared_distance(points[p], corners[around[p, n]]))
        found[p] = np.sqrt(least)


@njit(cache=True, nogil=True, error_model="numpy")
def _squared_distance(point, corners):
    """m², from a point (3,) to a triangle (3, 3): Ericson, Real-Time Collision Detection, 5.1.5."""
    a = corners[0]
    b = corners[1]
    c = corners[2]
    d1 = d2 = d3 = d4 = d5 = d6 = 0.0
    for x in range(3):
        d1 += (b[x] - a[x]) * (point[x] - a[x])
        d2 += (c[x] - a[x]) * (point[x] - a[x])
        d3 += (b[x] - a[x]) * (point[x] - b[x])
        d4 += (c[x] - a[x]) * (point[x] - b[x])
        d5 += (b[x] - a[x]) * (point[x] - c[x])
        d6 += (c[x] - a[x]) * (point[x] - c[x])
    va = d3 * d6 - d5 * d4
    vb = d5 * d2 - d1 * d6
    vc = d1 * d4 - d3 * d2
    along_b = along_c = 0.0
    if d1 <= 0.0 and d2 <= 0.0:
        pass  # nearest is corner a
    elif d3 >= 0.0 and d4 <= d3:
        along_b = 1.0
    elif d6 >= 0.0 and d5 <= d6:
        along_c = 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        along_b = d1 / (d1 - d3)
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        along_c = d2 / (d2 - d6)
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        along_c = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        along_b = 1.0 - along_c
    else:
        along_b = vb / (va + vb + vc)
        along_c = vc / (va + vb + vc)
    squared = 0.0
    for x in range(3):
        away = a[x] + along_b * (b[x] - a[x]) + along_c * (c[x] - a[x]) - point[x]
        squared += away * away
    return squared
