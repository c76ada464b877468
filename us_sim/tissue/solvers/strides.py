"""Poses on the way of a probe, so that tissue is swept aside and not left where it was hit.

>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.solvers.strides import strides
>>> [pose.position.tolist() for pose in strides(Pose(), Pose([0.0, 0.0, 0.008]), 0.008, arm=0.02)]
[[0.0, 0.0, 0.0026666666666666666], [0.0, 0.0, 0.005333333333333333]]
>>> [f"{pose.position[2]:.3f}" for pose in strides(None, Pose([0, 0, 0.03]), 0.006, arm=0.02)]
['0.027']
"""

from __future__ import annotations

import math

from us_sim.geometry.pose import Pose
from us_sim.geometry.se3 import interpolate

_STRIDE = 3e-3
"""Way of a probe in tissue that is gone at once, m."""

_MOST = 8
"""Strides in a frame; a longer way is a leap."""


def strides(last: Pose | None, pose: Pose, depth: float, arm: float) -> list[Pose]:
    """Poses on the way to one: from the last, or after a leap from before the tissue.

    Args:
        last: where the probe was, if it touched the tissue.
        pose: where it is now.
        depth: m, of that in the tissue as it is.
        arm: m, from the probe's origin to the outermost of it, which turns move farthest.
    """
    if last is not None:
        turned = 2 * math.acos(min(1.0, abs(float(last.orientation @ pose.orientation))))
        way = math.dist(last.position, pose.position) + arm * turned
        count = math.ceil(way / _STRIDE)
        if count <= _MOST:
            return [interpolate(last, pose, k / count) for k in range(1, count)]
    count = min(math.ceil(depth / _STRIDE), _MOST)
    backs = [(1 - k / count) * depth for k in range(1, count)]
    return [Pose(pose.position - x * pose.rotation[:, 2], pose.orientation) for x in backs]
