"""In which directions a probe pushes, written down a second time.

>>> import numpy as np
>>> from us_sim.evaluation.push_directions import flared_distance, push_directions
>>> from us_sim.geometry.collider import RoundedBox, Sphere
>>> from us_sim.geometry.pose import Pose
>>> push_directions(Sphere(0.03), Pose(), np.array([[0.0, 0.0, 0.0]]), 0.005)
array([[0., 0., 1.]])
>>> box = RoundedBox(0.04, 0.014, 0.03, 0.004)
>>> distance, normal = flared_distance(box, Pose(), np.array([[0.022, 0.0, -0.005]]), 0.006)
>>> distance.round(6), normal.round(3)
(array([0.000696]), array([[0.866, 0.   , 0.5  ]]))
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.collider import Collider
from us_sim.geometry.pose import Pose

Array = NDArray[np.float64]

_GRIP = 0.1  # m, how far the probe is taken to go on behind its collider

_LEAN, _FLARE = math.radians(60), 0.6
"""Angle of flanks to the face, and how much wider they become, over the nodes' spacing."""

_ON = 1e-12  # m; what is as near to an outline lies on it


def push_directions(collider: Collider, pose: Pose, points: Array, spacing: float) -> Array:
    """(K, 3) unit directions in which the probe pushes points (K, 3) m on or in it.

    The rule of `us_sim.tissue.contact.probe_gap.push_out`, written down again.
    """
    box = collider.offset_box
    rounding = box[3]
    if rounding < 2 * spacing:
        return np.broadcast_to(pose.rotation[:, 2], points.shape)
    local = (points - pose.position) @ pose.rotation
    side = np.where(local[:, :2] >= 0, 1.0, -1.0)
    out = np.maximum(np.abs(local[:, :2]) - box[:2], 0.0)
    rise = np.sqrt(np.maximum(rounding**2 - (out**2).sum(axis=1), 0.0))
    ahead = local[:, 2] + rounding
    behind = -(ahead + 2 * box[2] + _GRIP)
    up = np.maximum(ahead, 0.0) - np.maximum(behind, 0.0)
    length = np.sqrt((out**2).sum(axis=1) + up**2)
    near = (length >= rounding) | ((length > 0.5 * rounding) & (up >= 0))
    radial = np.column_stack([side * out, up]) / np.maximum(length, 1e-300)[:, None]
    from_above = np.column_stack([side * out, rise]) / rounding
    return np.where(near[:, None], radial, from_above) @ pose.rotation.T


def flared_distance(
    collider: Collider, pose: Pose, points: Array, spacing: float
) -> tuple[Array, Array]:
    """Distance of points (P, 3) m to a probe with leaning flanks, and its outward normals there.

    The shape of `us_sim.tissue.contact.probe_gap.FlaredProbe`, written down again: an outline in
    the plane of the image, that of its distance and y around it, and the rounding around both.

    Returns:
        (P,) m, negative inside, infinite behind the shape, and (P, 3).
    """
    box = collider.offset_box
    rounding, length = float(box[3]), 2 * float(box[2]) + _GRIP
    flare = 0.0 if rounding >= 2 * spacing else _FLARE * spacing
    local = (points - pose.position) @ pose.rotation
    side, beside = np.where(local >= 0, 1.0, -1.0), np.abs(local)
    ahead = local[:, 2] + rounding
    half, bent = float(box[0]), float(box[4]) if len(box) > 4 else 0.0
    in_plane = np.column_stack([beside[:, 0], ahead])
    if bent:
        # Flanks that would lean less than the front's end go straight back.
        widened = flare if half * bent <= math.sin(_LEAN) else 0.0
        across, along = _outside(*_arc(in_plane, half, 1 / bent), in_plane, widened, length)
    else:
        across, along = _outside(*_line(in_plane, half), in_plane, flare, length)
    in_plane = np.column_stack([beside[:, 1], across])
    found, out = _outside(*_line(in_plane, float(box[1])), in_plane, flare, length)
    turn = out[:, 1:] * along
    normal = np.column_stack([side[:, 0] * turn[:, 0], side[:, 1] * out[:, 0], turn[:, 1]])
    return np.where(ahead + length > 0.0, found - rounding, np.inf), normal @ pose.rotation.T


def _line(points: Array, half: float) -> tuple[Array, Array, Array]:
    """The place on a straight front that is nearest to points (P, 2) m, its normal there, and its
    end.
    """
    foot = np.column_stack([np.minimum(points[:, 0], half), np.zeros(len(points))])
    return foot, np.broadcast_to([0.0, 1.0], points.shape), np.array([half, 0.0])


def _arc(points: Array, half: float, radius: float) -> tuple[Array, Array, Array]:
    """As `_line`, on an arc that begins at the origin and ends ``half`` beside it."""
    angle = np.minimum(np.arctan2(points[:, 0], points[:, 1] + radius), math.asin(half / radius))
    normal = np.column_stack([np.sin(angle), np.cos(angle)])
    end = np.array([half, math.sqrt(radius**2 - half**2) - radius])
    return radius * normal - [0.0, radius], normal, end


def _outside(
    front: Array, front_normal: Array, end: Array, points: Array, flare: float, length: float
) -> tuple[Array, Array]:
    """Signed distance of points (P, 2) m to an outline, and its normal there.

    Args:
        front: (P, 2) m, places on its front that are nearest to the points.
        front_normal: (P, 2), of the front there.
        end: (2,) m, of the front; there the flank begins.
        points: (P, 2) m, beside the outline's middle and ahead.
        flare: m, by which the flank becomes wider.
        length: m, from there straight back.
    """
    rim = end + np.array([flare, -flare * math.tan(_LEAN)])
    back = rim - np.array([0.0, length])
    corners = [end, rim, back] if flare else [end, back]
    feet, normals = [front], [front_normal]
    for start, stop in pairwise(corners):
        way = stop - start
        part = np.clip((points - start) @ way / (way @ way), 0.0, 1.0)
        feet.append(start + part[:, None] * way)
        square = np.array([-way[1], way[0]]) / math.hypot(*way)
        normals.append(np.broadcast_to(square, points.shape))
    away = points[:, None] - np.stack(feet, axis=1)
    normal = np.stack(normals, axis=1)
    height = (away * normal).sum(axis=2)  # above the planes through what is nearest
    reach = np.linalg.norm(away, axis=2)
    inside = height.max(axis=1) <= _ON
    nearest = np.where(inside, height.argmax(axis=1), reach.argmin(axis=1))
    each = np.arange(len(points))
    far, square = reach[each, nearest], normal[each, nearest]
    direction = away[each, nearest] / np.maximum(far, _ON)[:, None]
    return (
        np.where(inside, height[each, nearest], far),
        np.where(inside[:, None], square, direction),
    )
