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

from us_sim.geometry.pose import Pose

__all__ = ["between", "motion"]


def motion(start: Pose, end: Pose, lever: float) -> NDArray[np.float64]:
    """(6,) m: how far the probe moves, and how far it turns times a lever (m)."""
    x, y, z, w = (start.inverse() @ end).orientation
    axis = np.array([x, y, z]) * (1.0 if w >= 0 else -1.0)
    sine = float(np.linalg.norm(axis))
    angle = 2.0 * np.arctan2(sine, abs(w))
    turn = axis * (angle / sine) if sine > 0 else axis
    return np.concatenate([end.position - start.position, lever * turn])


def between(start: Pose, end: Pose, share: float) -> Pose:
    """The pose at a share of the way, from 0 at ``start`` to 1 at ``end``.

    The orientation runs along the chord, which is near enough for the turn of one frame.
    """
    if share >= 1.0:
        return end
    position = (1 - share) * start.position + share * end.position
    sign = 1.0 if start.orientation @ end.orientation >= 0 else -1.0
    return Pose(position, (1 - share) * start.orientation + share * sign * end.orientation)
