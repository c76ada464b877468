"""Triangles divided into equal parts, in whose middles contact with a probe is felt.

Contact belongs to a surface and not to its vertices: between these too an edge of the probe must
not sink in. So triangles are divided until their parts are small enough for that edge, and each
part has a point in its middle that stands for its area and moves with the triangle (as quadrature
points do; P. Wriggers, Computational Contact Mechanics, 2nd ed. 2006, section 9).

>>> import numpy as np
>>> from us_sim.geometry.triangle_parts import TriangleParts
>>> parts = TriangleParts(longest=np.array([1.0, 2.0]), size=1.0)
>>> parts.triangle
array([0, 1, 1, 1, 1])
>>> parts.weights[0]
array([0.33333333, 0.33333333, 0.33333333])
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_FELT, _FINEST = 1.0, 0.25
"""Size of a part over the probe's rounding, and at least over the spacing of the vertices."""


def part_size(rounding: float, spacing: float) -> float:
    """m, the longest side of a triangle's parts, for a probe of some rounding (m) and vertices that
    are ``spacing`` (m) apart.
    """
    return min(max(_FELT * rounding, _FINEST * spacing), spacing)


class TriangleParts:
    """The P parts of T triangles, those of a triangle in a row.

    Args:
        longest: (T,) m, the longest side of each triangle.
        size: m, the longest side that a part may have.
    """

    def __init__(self, longest: NDArray[np.float64], size: float) -> None:
        counts = np.maximum(np.ceil(longest / size - 1e-9), 1).astype(int)
        middles = {int(count): _middles(int(count)) for count in np.unique(counts)}
        empty = np.zeros((0, 3))
        #: (P,) which triangle a part is of.
        self.triangle = np.repeat(np.arange(len(counts)), counts**2)
        #: (P, 3) barycentric coordinates of its middle; they sum to one.
        self.weights = np.concatenate([empty, *(middles[int(count)] for count in counts)])
        #: (T + 1,) where a triangle's parts begin.
        self.first = np.concatenate([[0], np.cumsum(counts**2)])


def _middles(count: int) -> NDArray[np.float64]:
    """(count^2, 3) barycentric coordinates of the middles of a triangle's equal parts."""
    row, column = np.divmod(np.arange(count * count), count)
    lower = row + column < count
    first = np.column_stack([row, column])[lower] + 1 / 3
    second = np.column_stack([row, column])[row + column < count - 1] + 2 / 3
    two = np.concatenate([first, second]) / count
    return np.column_stack([1 - two.sum(axis=1), two])
