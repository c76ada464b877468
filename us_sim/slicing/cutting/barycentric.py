"""Barycentric coordinates of a tetrahedron on the plane of an image: affine in (1, column, row).

>>> import numpy as np
>>> from us_sim.slicing.cutting.barycentric import adjugate
>>> corners = np.array([[0.0, 0, -1], [2, 0, 1], [0, 2, 1], [0, 0, 1]])
>>> determinant, first, second, third = adjugate(corners, 0, 1, 2, 3)
>>> column, row = 0.5, 0.0
>>> [(one + of_column * column + of_row * row) / determinant
...  for one, of_column, of_row in (first, second, third)]
[0.25, 0.0, 0.25]
"""

from __future__ import annotations

import numpy as np

from us_sim.kernels import njit

_FLAT = 1e-6
"""Fraction of its rest volume below which a tetrahedron is flat: it has no interior to show."""


@njit(inline="always", error_model="numpy")
def adjugate(place, n0, n1, n2, n3):
    """A tetrahedron's determinant, and the barycentric coordinates of its last three corners.

    Each is three coefficients, of 1, column and row, times the determinant.

    Args:
        place: (N, 3) column, row and height above the plane. n0 … n3: which four are the corners.
    """
    x0 = place[n0, 0]
    y0 = place[n0, 1]
    z0 = place[n0, 2]
    ax = place[n1, 0] - x0
    ay = place[n1, 1] - y0
    az = place[n1, 2] - z0
    bx = place[n2, 0] - x0
    by = place[n2, 1] - y0
    bz = place[n2, 2] - z0
    cx = place[n3, 0] - x0
    cy = place[n3, 1] - y0
    cz = place[n3, 2] - z0
    # Rows of the inverse of the matrix with columns a, b, c are b×c, c×a and a×b over a·(b×c).
    ux = by * cz - bz * cy
    uy = bz * cx - bx * cz
    uz = bx * cy - by * cx
    vx = cy * az - cz * ay
    vy = cz * ax - cx * az
    vz = cx * ay - cy * ax
    wx = ay * bz - az * by
    wy = az * bx - ax * bz
    wz = ax * by - ay * bx
    return (
        ax * ux + ay * uy + az * uz,
        (-(ux * x0 + uy * y0 + uz * z0), ux, uy),
        (-(vx * x0 + vy * y0 + vz * z0), vx, vy),
        (-(wx * x0 + wy * y0 + wz * z0), wx, wy),
    )


@njit(inline="always", error_model="numpy")
def is_solid(determinant, pixel_volume, rest_determinant):
    """Whether a tetrahedron is neither inverted nor flat.

    ``pixel_volume`` is m³ per unit of the determinant, ``rest_determinant`` is m³.
    """
    size = determinant * pixel_volume * np.sign(rest_determinant)
    return size > _FLAT * abs(rest_determinant)
