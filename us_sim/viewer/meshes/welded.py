"""Triangles that come corner by corner, as surfaces that share their vertices.

>>> import numpy as np
>>> from us_sim.viewer.meshes.welded import welded
>>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 0, 0], [1, 1, 0], [0, 1, 0]])
>>> vertices, triangles = welded(corners)
>>> len(vertices), triangles
(4, array([[0, 2, 3], [0, 3, 1]]))
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError


def welded(
    corners: NDArray[np.floating],
) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Vertices (V, 3), each once, and triangles (T, 3), without those that have no area left.

    Args:
        corners: (3 T, 3) m, three of each triangle in a row.

    Raises:
        MeshError: they do not make whole triangles, or one is not finite.
    """
    corners = np.ascontiguousarray(corners, dtype=np.float64) + 0.0  # -0 is 0
    if corners.ndim != 2 or corners.shape[1] != 3 or len(corners) % 3:
        raise MeshError(f"corners of shape {corners.shape} do not make whole triangles")
    if not np.isfinite(corners).all():
        raise MeshError("a corner of a triangle is not finite")
    order = np.lexsort(corners.T[::-1])
    ordered = corners[order]
    is_new = np.ones(len(corners), dtype=bool)
    is_new[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    numbers = np.empty(len(corners), dtype=np.intp)
    numbers[order] = np.cumsum(is_new) - 1
    triangles = numbers.reshape(-1, 3)
    apart = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    return ordered[is_new], triangles[apart]
