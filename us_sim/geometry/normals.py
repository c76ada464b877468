"""Unit normals at the vertices of a triangle surface, in single or double precision.

>>> import numpy as np
>>> from us_sim.geometry.normals import vertex_normals
>>> square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=np.float32)
>>> vertex_normals(square, np.array([[0, 1, 2], [0, 2, 3]]))[1]
array([0., 0., 1.], dtype=float32)
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.kernels import njit

_Real = TypeVar("_Real", np.float32, np.float64)


def vertex_normals(vertices: NDArray[_Real], triangles: ArrayLike) -> NDArray[_Real]:
    """(N, 3) unit normals: sums of the adjacent triangles' normals weighted by their area.

    They point to the side from which the triangles turn anticlockwise. Where the sum is zero, so
    is the normal.

    Args:
        vertices: (N, 3), float32 or float64; the normals have the same precision.
        triangles: (T, 3) indices into vertices.
    """
    normals = np.zeros(vertices.shape, dtype=vertices.dtype)
    whole = np.ascontiguousarray(vertices).view()
    corners = np.ascontiguousarray(triangles, dtype=np.int32).view()
    # Read-only always, since numba would compile the kernel again for what is not.
    whole.flags.writeable = corners.flags.writeable = False
    _sum_normals(whole, corners, normals)
    return normals


@njit(cache=True, nogil=True, error_model="numpy")
def _sum_normals(vertices, triangles, normals):
    """Fills normals (N, 3), zeros before, from vertices (N, 3) and triangles (T, 3)."""
    for t in range(len(triangles)):
        i = triangles[t, 0]
        j = triangles[t, 1]
        k = triangles[t, 2]
        ax = vertices[j, 0] - vertices[i, 0]
        ay = vertices[j, 1] - vertices[i, 1]
        az = vertices[j, 2] - vertices[i, 2]
        bx = vertices[k, 0] - vertices[i, 0]
        by = vertices[k, 1] - vertices[i, 1]
        bz = vertices[k, 2] - vertices[i, 2]
        x = ay * bz - az * by
        y = az * bx - ax * bz
        z = ax * by - ay * bx
        for v in (i, j, k):
            normals[v, 0] += x
            normals[v, 1] += y
            normals[v, 2] += z
    for v in range(len(normals)):
        length = np.sqrt(normals[v, 0] ** 2 + normals[v, 1] ** 2 + normals[v, 2] ** 2)
        if length > 0.0:
            normals[v, 0] /= length
            normals[v, 1] /= length
            normals[v, 2] /= length
