"""Positions as whole steps from where they were at rest: half the bytes of single precision.

>>> import numpy as np
>>> from us_sim.viewer.meshes.offsets import Offsets
>>> offsets = Offsets.between(np.array([[0.0, 0.0, 0.012]]), np.zeros((1, 3)))
>>> offsets.resolution, offsets.steps
(1e-06, array([[    0,     0, 12000]], dtype=int16))
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FINEST = 1e-6
"""m: a step is no shorter. So tissue may move by 33 mm before steps must be longer."""
_MOST = np.iinfo(np.int16).max


@dataclass(frozen=True, eq=False)
class Offsets:
    """How far points are from their places at rest, in steps."""

    steps: NDArray[np.int16]  # (N, 3)
    resolution: float  # m, of a step

    @classmethod
    def between(cls, positions: NDArray[np.floating], rest: NDArray[np.floating]) -> Offsets:
        """Of positions (N, 3) from rest (N, 3), m, to half a step of the shortest that suffices."""
        moved = np.subtract(positions, rest, dtype=np.float64)
        farthest = float(np.abs(moved).max(initial=0.0))
        resolution = FINEST * max(1, math.ceil(farthest / (FINEST * _MOST)))
        return cls(np.rint(moved / resolution).astype(np.int16), resolution)

    def positions(self, rest: NDArray[np.floating]) -> NDArray[np.float64]:
        """(N, 3) m, as the page has them."""
        return rest + self.resolution * self.steps.astype(np.float64)
