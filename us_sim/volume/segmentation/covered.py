"""Where a volume has data at all: the body against air, and what no beam has reached.

>>> import numpy as np
>>> from us_sim.volume.segmentation.covered import covered_part
>>> grey = np.zeros((12, 12, 12), np.uint8)
>>> grey[2:10, 2:10, 2:10] = 40
>>> grey[5, 5, 5] = 0  # an echo-free voxel within
>>> int(covered_part(grey, np.full(3, 1e-3)).sum())
512
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from us_sim.errors import VolumeError
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting
from us_sim.volume.segmentation.morphology import ball_closed, largest_part
from us_sim.volume.segmentation.region import Region


@dataclass(frozen=True)
class Covered(Settings):
    """All that has data: the largest part above a grey value, with its holes filled."""

    error = VolumeError

    lower: float = setting(Quantity("number", 0.0, 255.0), "least grey value of data", default=1.0)
    gap: float = setting(
        Quantity("length", 0.0, 0.02), "gaps up to twice as wide are closed", default=2e-3
    )

    def found_in(self, region: Region) -> NDArray[np.bool_]:
        """(i, j, k) where there are data."""
        return covered_part(region.grey, region.spacing, self.lower, self.gap)


def covered_part(
    grey: NDArray[np.number[Any]],
    spacing: NDArray[np.float64],
    lower: float = 1.0,
    gap: float = 2e-3,
) -> NDArray[np.bool_]:
    """(i, j, k) the largest part of at least that grey value, gaps (m) closed and holes filled."""
    closed = ball_closed(np.asarray(grey >= lower), gap, spacing)
    if not closed.any():
        return closed
    return np.asarray(ndimage.binary_fill_holes(largest_part(closed)))
