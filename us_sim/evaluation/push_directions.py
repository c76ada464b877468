"""In which directions a probe pushes, written down a second time.

>>> import numpy as np
>>> from us_sim.evaluation.push_directions import push_directions
>>> from us_sim.geometry.collider import Sphere
>>> from us_sim.geometry.pose import Pose
>>> push_directions(Sphere(0.03), Pose(), np.array([[0.0, 0.0, 0.0]]), 0.005)
array([[0., 0., 1.]])
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.collider import Collider
from us_sim.geometry.pose import Pose

__all__ = ["push_directions"]

Array = NDArray[np.float64]

_GRIP = 0.1  # m, how far the probe is taken to go on behind its collider

_STEEP = math.radians(60)  # of the flanks of a probe of small rounding to its face


def push_directions(
    collider: Collider, pose: Pose, points: Array, spacing: float, *, flanks: bool = False
) -> Array:
    """(K, 3) unit directions in which the probe pushes points (K, 3) m on or in it.

    The rule of `us_sim.tissue.contact.penetration.push_out`, written down again. With ``flanks`` a
    point that lies nearer to a flank of a probe of small rounding than to its front is pushed
    square to that flank, a plane along the rounding where this is 60 degrees to the face.
    """
    box = collider.offset_box
    rounding = box[3]
    local = (points - pose.position) @ pose.rotation
    side = np.where(local[:, :2] >= 0, 1.0, -1.0)
    inside = box[:2] - np.abs(local[:, :2])
    out = np.maximum(-inside, 0.0)
    rise = np.sqrt(np.maximum(rounding**2 - (out**2).sum(axis=1), 0.0))
    ahead = local[:, 2] + rounding
    if rounding < 2 * spacing:
        forward = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
        if not flanks:
            return forward @ pose.rotation.T
        nearest = (inside == inside.min(axis=1)[:, None]) & (out == 0.0).all(axis=1)[:, None]
        beside = np.where(nearest.any(axis=1), -inside.min(axis=1), np.linalg.norm(out, axis=1))
        along = side * np.where(nearest, 1.0, out)
        along /= np.maximum(np.linalg.norm(along, axis=1), 1e-300)[:, None]
        sine, cosine = math.sin(_STEEP), math.cos(_STEEP)
        aside = np.column_stack([sine * along, np.full(len(points), cosine)])
        to_flank = (beside - rounding) / sine
        by_flank = (ahead < 0.0) & (np.abs(to_flank) < np.abs(ahead - rise))
        return np.where(by_flank[:, None], aside, forward) @ pose.rotation.T
    behind = -(ahead + 2 * box[2] + _GRIP)
    up = np.maximum(ahead, 0.0) - np.maximum(behind, 0.0)
    length = np.sqrt((out**2).sum(axis=1) + up**2)
    near = (length >= rounding) | ((length > 0.5 * rounding) & (up >= 0))
    radial = np.column_stack([side * out, up]) / np.maximum(length, 1e-300)[:, None]
    from_above = np.column_stack([side * out, rise]) / rounding
    return np.where(near[:, None], radial, from_above) @ pose.rotation.T
