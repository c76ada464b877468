"""The gap between nodes and the probe, and the direction in which the probe pushes them.

>>> import numpy as np
>>> from us_sim.geometry.collider import Sphere
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.contact.penetration import push_out
>>> pressed = Pose(position=[0.0, 0.0, 0.01])
>>> gap, normal = push_out(Sphere(0.03), pressed, np.zeros((1, 3)), spacing=0.01)
>>> gap.round(3), normal
(array([-0.01]), array([[0., 0., 1.]]))
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.collider import Collider
from us_sim.geometry.collider_distance import curved_box_distance, turned, turned_back
from us_sim.geometry.pose import Pose
from us_sim.kernels import njit

GAP_TOLERANCE = 1e-5
"""A node this close to the probe's surface lies on it, m."""

_GRIP = 0.1
"""Length by which a collider continues behind the face, m, as where a hand holds the probe. Nodes
cannot slip past it there, and are found in it even after a jump beyond the collider's thickness."""


def only_forward(collider: Collider, spacing: float) -> bool:
    """Whether the collider pushes with its face alone, not along the normals of its rounding.

    Surface nodes that are ``spacing`` (m) apart do not see a rounding of less than twice that: one
    by one they would slide off it sideways and the probe would sink in between them, which a
    continuous skin prevents.
    """
    return bool(collider.offset_box[3] < 2 * spacing)


def push_out(
    collider: Collider,
    pose: Pose,
    points: NDArray[np.float64],
    spacing: float,
    skirt: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gap between points and the probe, along the direction in which it pushes them.

    With a rounding that the points resolve (see `only_forward`) the gap outside the collider and
    within half its rounding below the surface is the signed distance, and the direction its normal.
    Deeper, the nearest surface point is no guide: the normal may point sideways or back. There a
    point is pushed onto the tangent plane where the probe's +z through it leaves the collider, as
    if the probe had come down on it. With a smaller rounding every point is pushed along +z onto
    the surface, or, under a curved face, square to that face.

    Args:
        collider: the probe's shape; it is taken to go on for 0.1 m behind.
        pose: of the probe in the points' frame.
        points: (N, 3) m.
        spacing: m, between neighbouring points.
        skirt: (N,) m, how far beside the probe each point still counts as under its rim, for a
            probe that pushes along +z only; zero by default.

    Returns:
        (N,) m, negative inside, infinite where the probe cannot push, and (N, 3) unit directions in
        the points' frame.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    gap = np.empty(len(points))
    normal = np.empty_like(points)
    _pushing_gaps(
        collider.offset_box,
        only_forward(collider, spacing),
        pose.rotation,
        np.array(pose.position),
        points,
        np.zeros(len(points)) if skirt is None else skirt,
        gap,
        normal,
    )
    return gap, normal


def wrench_on_probe(
    pose: Pose, points: NDArray[np.float64], forces: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Reaction of the forces with which the probe pushes tissue.

    Args:
        pose: of the probe.
        points: (K, 3) m, where it pushes, in the pose's parent frame.
        forces: (K, 3) N, on the tissue, in that frame.

    Returns:
        force (3,) N and torque (3,) N m on the probe about its origin, in frame ``probe``.
    """
    moments = (points - pose.position).T @ forces  # (3, 3) N m, each arm's axis by each force's
    torque = np.array(
        [
            moments[1, 2] - moments[2, 1],
            moments[2, 0] - moments[0, 2],
            moments[0, 1] - moments[1, 0],
        ]
    )
    rotation = pose.rotation
    return -forces.sum(axis=0) @ rotation, -torque @ rotation


@njit(cache=True, nogil=True, error_model="numpy")
def pushing_gap(box, forward, skirt, x, y, z):
    """Gap and push direction for one point of frame ``probe``: (gap, nx, ny, nz).

    ``box`` is the collider's ``offset_box``, ``forward`` as `only_forward` says, and ``skirt`` (m)
    widens a forward push beyond the rim.
    """
    if len(box) > 4:
        return _curved_pushing_gap(box, forward, skirt, x, y, z)
    rounding = box[3]
    sx = 1.0 if x >= 0 else -1.0
    sy = 1.0 if y >= 0 else -1.0
    ox = max(abs(x) - box[0], 0.0)
    oy = max(abs(y) - box[1], 0.0)
    beside = ox * ox + oy * oy
    ahead = z + rounding  # of the core's front
    behind = -(ahead + 2 * box[2] + _GRIP)  # the end of the grip
    under = beside < (rounding + skirt) ** 2
    if forward and not (under and behind < 0.0):
        return math.inf, 0.0, 0.0, 1.0
    rise = math.sqrt(max(rounding * rounding - beside, 0.0))
    if forward:
        return ahead - rise, 0.0, 0.0, 1.0
    oz = max(ahead, 0.0) - max(behind, 0.0)
    length = math.sqrt(beside + oz * oz)
    if length >= rounding or (length > 0.5 * rounding and oz >= 0.0):
        return length - rounding, sx * ox / length, sy * oy / length, oz / length
    nz = rise / rounding
    return nz * (ahead - rise), sx * ox / rounding, sy * oy / rounding, nz


@njit(cache=True, nogil=True, error_model="numpy")
def _curved_pushing_gap(box, forward, skirt, x, y, z):
    """As `pushing_gap`, of a box with a curved front."""
    rounding, radius = box[3], 1.0 / box[4]
    sx = 1.0 if x >= 0 else -1.0
    sy = 1.0 if y >= 0 else -1.0
    ox = max(abs(x) - box[0], 0.0)
    oy = max(abs(y) - box[1], 0.0)
    beside = ox * ox + oy * oy
    if forward:
        behind = -(z + rounding + 2 * box[2] + _GRIP)
        if beside >= (rounding + skirt) ** 2 or behind >= 0.0:
            return math.inf, 0.0, 0.0, 1.0
    else:
        distance, nx, ny, nz = curved_box_distance(box, _GRIP, x, y, z)
        if distance >= 0.0 or (distance > -0.5 * rounding and nz >= 0.0):
            return distance, nx, ny, nz
    # Where +z through the point leaves the collider: on the bent face, or on the rounding beyond
    # its ends; (tx, tz) is square to the face there, or at its end.
    bulge = math.sqrt(max(rounding * rounding - oy * oy, 0.0))
    tx = x / (radius + bulge)
    if abs(tx) * radius <= box[0]:
        tz = math.sqrt(1.0 - tx * tx)
        surface = (radius + bulge) * tz
        nx, nz = bulge * tx, bulge * tz
    else:
        tx = sx * box[0] / radius
        tz = math.sqrt(1.0 - tx * tx)
        rise = math.sqrt(max(rounding * rounding - beside, 0.0))
        surface = radius * tz + rise
        nx, nz = sx * ox, rise
    below = z + rounding + radius - surface
    if forward:
        return tz * below, tx, 0.0, tz
    return nz / rounding * below, nx / rounding, sy * oy / rounding, nz / rounding


@njit(cache=True, nogil=True, error_model="numpy")
def _pushing_gaps(box, forward, rotation, origin, points, skirt, gap, normal):
    """Fills gap (N,), normal (N, 3) for points (N, 3) of the probe's parent frame, skirt (N,)."""
    r = rotation
    for i in range(len(points)):
        a = points[i, 0] - origin[0]
        b = points[i, 1] - origin[1]
        c = points[i, 2] - origin[2]
        x, y, z = turned_back(r, a, b, c)
        g, nx, ny, nz = pushing_gap(box, forward, skirt[i], x, y, z)
        gap[i] = g
        normal[i, 0], normal[i, 1], normal[i, 2] = turned(r, nx, ny, nz)
