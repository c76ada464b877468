"""The poses between two of the probe, close enough together for one step each.

>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.solvers.sub_steps import between, motion
>>> far = Pose(position=[0.0, 0.0, 0.01])
>>> float(abs(motion(Pose(), far, 0.03)).max())
0.01
>>> between(Pose(), far, 0.5).position
array([0.   , 0.   , 0.005])
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry import se3
from us_sim.geometry.pose import Pose

__all__ = ["between", "motion"]


def motion(start: Pose, end: Pose, lever: float) -> NDArray[np.float64]:
    """(6,) m: how far the probe moves, and how far it turns times a lever (m)."""
    turn = se3.rotation_log((start.inverse() @ end).orientation)
    return np.concatenate([end.position - start.position, lever * turn])


def between(start: Pose, end: Pose, fraction: float) -> Pose:
    """The pose at a fraction of the path, from 0 at ``start`` to 1 at ``end``.

    The orientation runs along the chord, which is near enough for the turn of one frame.
    """
    if fraction >= 1.0:
        return end
    position = (1 - fraction) * start.position + fraction * end.position
    sign = 1.0 if start.orientation @ end.orientation >= 0 else -1.0
    return Pose(position, (1 - fraction) * start.orientation + fraction * sign * end.orientation)
