"""Vectors turned by a rotation matrix, for kernels that do so point by point.

>>> import numpy as np
>>> from us_sim.geometry.turned import turned, turned_back
>>> quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
>>> turned(quarter, 1.0, 2.0, 3.0), turned_back(quarter, -2.0, 1.0, 3.0)
((-2.0, 1.0, 3.0), (1.0, 2.0, 3.0))
"""

from __future__ import annotations

from us_sim.kernels import njit


@njit(cache=True, nogil=True, error_model="numpy")
def turned(r, x, y, z):
    """The matrix r (3, 3) times a vector: from the child's frame to the parent's."""
    return (
        r[0, 0] * x + r[0, 1] * y + r[0, 2] * z,
        r[1, 0] * x + r[1, 1] * y + r[1, 2] * z,
        r[2, 0] * x + r[2, 1] * y + r[2, 2] * z,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def turned_back(r, x, y, z):
    """Its transpose times a vector: from the parent's frame to the child's."""
    return (
        r[0, 0] * x + r[1, 0] * y + r[2, 0] * z,
        r[0, 1] * x + r[1, 1] * y + r[2, 1] * z,
        r[0, 2] * x + r[1, 2] * y + r[2, 2] * z,
    )
