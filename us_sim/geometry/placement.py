"""The pose of one frame in another, as files write it down.

>>> from us_sim.geometry.placement import Placement
>>> Placement(position=["10 mm", 0, 0]).pose.position
array([0.01, 0.  , 0.  ])
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from us_sim.geometry.pose import Pose
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting

PLACE = Quantity("length", -10.0, 10.0)
"""A coordinate of something near the patient."""


@dataclass(frozen=True)
class Placement(Settings):
    """A position and an orientation."""

    position: tuple[float, float, float] = setting(PLACE, "x, y, z", default=(0.0, 0.0, 0.0))
    orientation: tuple[float, float, float, float] = setting(
        Quantity("number", -1.0, 1.0), "quaternion x, y, z, w", default=(0.0, 0.0, 0.0, 1.0)
    )

    def check(self) -> None:
        """Refuse a quaternion that is no rotation."""
        if math.hypot(*self.orientation) < 1e-6:
            raise self.refused(
                "orientation", "is zero, so it is no orientation: give [0, 0, 0, 1] for none"
            )

    @property
    def pose(self) -> Pose:
        """The same as a rigid transform."""
        return Pose(np.array(self.position), np.array(self.orientation))
