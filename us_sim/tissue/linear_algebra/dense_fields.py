"""The displacement field of each force on a surface, every number of it.

>>> import numpy as np
>>> from us_sim.tissue.linear_algebra.dense_fields import DenseFields
>>> fields = DenseFields(np.array([1]), np.array([[[2.0], [0.0], [1.0]]]))  # of one force
>>> displacement = np.zeros((2, 3))
>>> fields.add(np.array([0.5]), displacement)
>>> displacement.tolist()
[[0.0, 0.0, 0.0], [1.0, 0.0, 0.5]]
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit

_CHUNK = 64  # nodes for whose forces the fields are made at once

Solve = Callable[[NDArray[np.int64]], NDArray[np.floating]]


@dataclass(frozen=True, eq=False)
class DenseFields:
    """What each of 3S forces does to F nodes."""

    nodes: NDArray[np.integer]  # (F,)
    fields: NDArray[np.floating]  # (3S, 3, F), m/N

    def __post_init__(self) -> None:
        # Always read-only, as from the cache: numba would compile the kernel again for others.
        for name in ("nodes", "fields"):
            array = getattr(self, name).view()
            array.flags.writeable = False
            object.__setattr__(self, name, array)

    @classmethod
    def made(
        cls, nodes: NDArray[np.integer], forces: int, solve: Solve, precision: type
    ) -> DenseFields:
        """The fields at ``nodes`` (F,) of forces on S nodes.

        Args:
            nodes: of the fields.
            forces: S.
            solve: the (N, 3, 3K) m/N fields of unit forces on K of the S nodes.
            precision: of the numbers to keep.
        """
        fields: NDArray[np.floating] = np.empty((3 * forces, 3, len(nodes)), precision)
        for first in range(0, forces, _CHUNK):
            chunk = np.arange(first, min(first + _CHUNK, forces))
            fields[3 * first : 3 * chunk[-1] + 3] = solve(chunk)[nodes].transpose(2, 1, 0)
        return cls(nodes, fields)

    def add(self, forces: NDArray[np.float64], displacement: NDArray[np.floating]) -> None:
        """Add what forces (3S,) N do to displacement (N, 3) m; zeros are not read."""
        rows = np.flatnonzero(forces)
        _add_rows(self.fields, rows, forces[rows], self.nodes, displacement)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _add_rows(fields, rows, weights, nodes, displacement):
    """Adds the weighted rows of fields (R, 3, F) to displacement (N, 3) of nodes (F,)."""
    width = 1024  # nodes of a piece that stays in the fastest cache
    four = len(rows) // 4 * 4
    whole = np.empty((3, width))
    for begin in range(0, len(nodes), width):
        end = min(begin + width, len(nodes))
        for axis in range(3):
            piece = whole[axis, : end - begin]
            piece[:] = 0.0
            for m in range(0, four, 4):
                a = fields[rows[m], axis, begin:end]
                b = fields[rows[m + 1], axis, begin:end]
                c = fields[rows[m + 2], axis, begin:end]
                d = fields[rows[m + 3], axis, begin:end]
                p, q, r, s = weights[m], weights[m + 1], weights[m + 2], weights[m + 3]
                for i in range(len(piece)):
                    piece[i] += p * a[i] + q * b[i] + r * c[i] + s * d[i]
            for m in range(four, len(rows)):
                a = fields[rows[m], axis, begin:end]
                p = weights[m]
                for i in range(len(piece)):
                    piece[i] += p * a[i]
        for i in range(end - begin):
            for axis in range(3):
                displacement[nodes[begin + i], axis] += whole[axis, i]
