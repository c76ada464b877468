"""An elliptical tube along y that swings gently: a vessel, a nerve or the shaft of a bone.

>>> import numpy as np
>>> from us_sim.volume.phantom.tube import Tube
>>> vein = Tube(centre=(2e-3, 13e-3), radii=(3.5e-3, 2.75e-3))
>>> distance = vein.distance(np.array([2e-3]), 0.0, np.array([13e-3 - 2.75e-3]))
>>> abs(round(float(distance[0, 0]), 9))
0.0
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_WAVELENGTH = 70e-3


@dataclass(frozen=True)
class Tube:
    """Centre line and cross-section, m, in a frame whose y runs along the tube."""

    centre: tuple[float, float]  # m, x and z
    radii: tuple[float, float]  # m, along x and z
    swing: tuple[float, float] = (0.0, 0.0)  # m, amplitude along x and z
    phase: float = 0.0  # rad, of the swing at y = 0

    def middle(self, y: float) -> tuple[float, float]:
        """(x, z) m of the centre line at y."""
        angle = 2 * np.pi * y / _WAVELENGTH + self.phase
        return (
            self.centre[0] + self.swing[0] * float(np.sin(angle)),
            self.centre[1] + self.swing[1] * float(np.sin(0.7 * angle + 1.0)),
        )

    def distance(
        self, x: NDArray[np.float64], y: float, z: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Distance (X, Z) m from the wall, negative inside.

        The distance is exact on the wall and right to first order beside it.
        """
        middle_x, middle_z = self.middle(y)
        across = (x[:, None] - middle_x) / self.radii[0]
        down = (z[None, :] - middle_z) / self.radii[1]
        # A square root is several times faster than hypot, and nothing here over- or underflows.
        radius = np.sqrt(np.maximum(across**2 + down**2, 1e-12))
        slope = np.sqrt((across / self.radii[0]) ** 2 + (down / self.radii[1]) ** 2)
        slope = np.maximum(slope, 1e-6 / max(self.radii))
        return np.asarray((radius - 1.0) * radius / slope)
