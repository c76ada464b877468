"""The gap between points and the probe, and the direction in which the probe pushes them.

>>> from us_sim.geometry.collider import RoundedBox, Sphere
>>> pressed = Pose(position=[0.0, 0.0, 0.01])
>>> gap, normal = measure_gaps(Sphere(0.03), pressed, np.zeros((1, 3)), spacing=0.01)
>>> gap.round(3), normal
(array([-0.01]), array([[0., 0., 1.]]))
>>> probe = FlaredProbe(RoundedBox(0.04, 0.014, 0.03, 0.004), spacing=0.006)
>>> points = np.array([[0.0, 0.0, -0.001], [0.022, 0.0, -0.005]])
>>> gap, normal = probe.measure_distances(Pose(), points)
>>> gap.round(6), normal.round(3)
(array([-0.001   ,  0.000696]), array([[0.   , 0.   , 1.   ],
       [0.866, 0.   , 0.5  ]]))
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.collider import Collider
from us_sim.geometry.collider_distance import (
    measure_curved_box_distance,
    rotate_vector,
    rotate_vector_back,
)
from us_sim.geometry.pose import Pose
from us_sim.kernels import njit

GAP_TOLERANCE = 1e-5
"""A node this close to the probe's surface lies on it, m."""

_GRIP = 0.1
"""Length by which a collider continues behind the face, m, as where a hand holds the probe. Nodes
cannot slip past it there, and are found in it even after a jump beyond the collider's thickness."""

_LEAN = math.radians(60)
"""Angle of the leaning flanks to the face."""

_FLARE = 0.6
"""Width over the collider's that the flanks gain at each side, over the nodes' spacing."""

_RESOLVED = 2.0
"""Rounding, over the nodes' spacing, from which on they resolve it."""

_CLOSE = 1e-6  # m, from the surface, where a point that is traced to it has arrived

_TRACED = 400  # steps on a point's way in; a grazing one takes many


def pushes_only_forward(collider: Collider, spacing: float) -> bool:
    """Return whether the collider pushes along its face's normal only, not off its rounding.

    Surface nodes that are ``spacing`` (m) apart do not see a rounding of less than twice that: one
    by one they would slide off it sideways and the probe would sink in between them, which a
    continuous skin prevents.
    """
    return bool(collider.offset_box[3] < _RESOLVED * spacing)


def measure_gaps(
    collider: Collider,
    pose: Pose,
    points: NDArray[np.float64],
    spacing: float,
    skirt: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Measure gaps between points and the probe, along the direction in which it pushes them.

    With a rounding that the points resolve (see `pushes_only_forward`) the gap outside the
    collider and within half its rounding below the surface is the signed distance, and the
    direction its normal. Deeper, the nearest surface point is no guide: the normal may point
    sideways or back. There a point is pushed onto the tangent plane where the probe's +z through it
    leaves the collider, as if the probe had come down on it. With a smaller rounding every point is
    pushed along +z onto the surface, or, under a curved face, square to that face.

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
        pushes_only_forward(collider, spacing),
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
    """Return the tissue's reaction to the forces with which the probe pushes it.

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
    """Return the gap and push direction for one point of frame ``probe``: (gap, nx, ny, nz).

    ``box`` is the collider's ``offset_box``, ``forward`` the answer of `pushes_only_forward`, and
    ``skirt`` (m) widens a forward push beyond the rim.
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
    """Return as `pushing_gap`, for a box with a curved front."""
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
        distance, nx, ny, nz = measure_curved_box_distance(box, _GRIP, x, y, z)
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
    """Fill gap (N,), normal (N, 3) for points (N, 3) of the probe's parent frame, skirt (N,)."""
    r = rotation
    for i in range(len(points)):
        a = points[i, 0] - origin[0]
        b = points[i, 1] - origin[1]
        c = points[i, 2] - origin[2]
        x, y, z = rotate_vector_back(r, a, b, c)
        g, nx, ny, nz = pushing_gap(box, forward, skirt[i], x, y, z)
        gap[i] = g
        normal[i, 0], normal[i, 1], normal[i, 2] = rotate_vector(r, nx, ny, nz)


class FlaredProbe:
    """Shape with which a probe presses a surface that is coarser than the probe's edges.

    It is the collider, with a front that is the collider's own, and flanks that lean outward behind
    it, at 60 degrees to the face, until they are a little wider than the collider; from there they
    go straight back. A surface whose nodes are farther apart than the rounding of an edge cannot
    lie along upright flanks: it would be swallowed by the edge. A collider whose rounding the nodes
    resolve keeps its own flanks.

    The shape is convex, so that its signed distance is a convex function; so a spring along it has
    an energy (S. Boyd and L. Vandenberghe, Convex Optimization, 2004, section 8.1). Outside the
    core the distance has a continuous slope, but for the four edges where two leaning flanks meet:
    there the normal turns by 29 degrees at once.

    Args:
        collider: the probe's shape.
        spacing: m, between neighbouring nodes of the surface.
    """

    def __init__(self, collider: Collider, spacing: float) -> None:
        box = collider.offset_box
        lean, flare = _LEAN, _FLARE * spacing
        if box[3] >= _RESOLVED * spacing:
            lean, flare = math.pi / 2, 0.0
        bent = box[4] if len(box) > 4 else 0.0
        length = 2 * box[2] + _GRIP
        cosine = math.cos(lean) if flare > 0.0 else 0.0
        self._shape = np.array([*box[:2], length, box[3], bent, math.sin(lean), cosine, flare])
        #: m, half of the smallest half width: deeper, the nearest surface may be the wrong one.
        self.deep = 0.5 * (float(box[:2].min()) + float(box[3]))
        #: m, gap up to which a point may come to touch while the probe stays where it is.
        self.reach = self.deep + spacing

    def measure_distances(
        self, pose: Pose, points: NDArray[np.float64], near: NDArray[np.integer] | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Measure signed distances of points, and the outward normals of the surface there.

        Args:
            pose: of the probe in the points' frame.
            points: (P, 3) m.
            near: indices of the points that are measured; all others are infinitely far.

        Returns:
            (P,) m, negative inside, infinite behind the shape, and (P, 3).
        """
        if near is None:
            near = np.arange(len(points))
        gap, normal = np.full(len(points), np.inf), np.zeros((len(points), 3))
        _distances(self._shape, pose.rotation, np.array(pose.position), points, near, gap, normal)
        return gap, normal

    def curvature(self, pose: Pose, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (P, 3, 3) 1/m, how the normal turns as points (P, 3) m move."""
        turn = np.zeros((len(points), 3, 3))
        _curvatures(self._shape, pose.rotation, np.array(pose.position), points, turn)
        return turn

    def find_entry_planes(
        self, last: Pose | None, pose: Pose, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Find the planes through which points came in as the probe moved to a pose.

        Args:
            last: where the probe came from; None: from far behind along its axis.
            pose: where it is.
            points: (P, 3) m, inside now.

        Returns:
            (P,) m, gaps to the planes, and (P, 3), their normals.
        """
        there = (points - pose.position) @ pose.rotation
        if last is None:
            came = there + np.array([0.0, 0.0, 2 * (self._shape[2] + self._shape[3])])
        else:
            came = (points - last.position) @ last.rotation
        gap, normal = np.empty(len(points)), np.empty((len(points), 3))
        _enter(self._shape, came, there, gap, normal)
        return gap, normal @ pose.rotation.T


@njit(cache=True, nogil=True, error_model="numpy")
def _corner(sine, cosine, flare, beside, ahead):
    """Return the distance in a plane to a front that ends at the origin, with a flank behind it.

    The front is where ``ahead`` is zero, the flank at ``beside`` above zero. The distance is
    followed by its two slopes, and its curvature (1/m) across them.
    """
    low = flare * sine / cosine if cosine > 0.0 else 0.0  # how far back the flank leans
    flank, upright = beside * sine + ahead * cosine, beside - flare
    inside = ahead <= 0.0 and flank <= 0.0 and upright <= 0.0
    if beside < 0.0 or inside:  # or before the front
        if ahead >= flank and ahead >= upright:
            return ahead, 0.0, 1.0, 0.0
        if flank >= upright:
            return flank, sine, cosine, 0.0
        return upright, 1.0, 0.0, 0.0
    if beside * cosine <= ahead * sine:
        length = math.sqrt(beside * beside + ahead * ahead)
        return length, beside / length, ahead / length, 1.0 / length
    if beside * cosine - ahead * sine <= math.sqrt(flare * flare + low * low):
        return flank, sine, cosine, 0.0
    behind = ahead + low
    if behind <= 0.0:
        return upright, 1.0, 0.0, 0.0
    length = math.sqrt(upright * upright + behind * behind)
    return length, upright / length, behind / length, 1.0 / length


@njit(cache=True, nogil=True, error_model="numpy")
def _profile(shape, x, z):
    """Return the distance to the core in the image's plane: (distance, slopes by x and z, 1/m)."""
    half, bent = shape[0], shape[4]
    side = 1.0 if x >= 0.0 else -1.0
    ahead = z + shape[3]
    sine, cosine, flare = shape[5], shape[6], shape[7]
    if bent == 0.0:
        a, b, c, k = _corner(sine, cosine, flare, side * x - half, ahead)
        return a, side * b, c, k
    radius = 1.0 / bent
    end = math.sqrt(radius * radius - half * half)  # of the arc, above its centre
    above = ahead + radius
    if half * bent > sine:  # steeper at its end than the flanks lean
        sine, cosine, flare = 1.0, 0.0, 0.0
    beyond, over = side * x - half, above - end
    arc = above > 0.0 and side * x * end <= half * above  # it is nearer than its ends
    if arc or beyond < 0.0:
        reach = math.sqrt(x * x + above * above)
        flank, upright = beyond * sine + over * cosine, beyond - flare
        if arc and (reach >= radius or reach - radius >= max(flank, upright)):
            return reach - radius, x / reach, above / reach, 1.0 / reach
        if flank >= upright:
            return flank, side * sine, cosine, 0.0
        return upright, side, 0.0, 0.0
    a, b, c, k = _corner(sine, cosine, flare, beyond, over)
    return a, side * b, c, k


@njit(cache=True, nogil=True, error_model="numpy")
def _distance(shape, x, y, z):
    """Return distance and normal for one point of frame ``probe``: (distance, nx, ny, nz)."""
    if z + shape[3] + shape[2] <= 0.0:
        return math.inf, 0.0, 0.0, 1.0
    across, ux, uz, _ = _profile(shape, x, z)
    side = 1.0 if y >= 0.0 else -1.0
    found, by, ba, _ = _corner(shape[5], shape[6], shape[7], side * y - shape[1], across)
    return found - shape[3], ba * ux, side * by, ba * uz


@njit(cache=True, nogil=True, error_model="numpy")
def _distances(shape, r, origin, points, near, gap, normal):
    """Fill gap (P,), normal (P, 3) for the points (P, 3) that are near."""
    for i in near:
        a = points[i, 0] - origin[0]
        b = points[i, 1] - origin[1]
        c = points[i, 2] - origin[2]
        x, y, z = rotate_vector_back(r, a, b, c)
        gap[i], nx, ny, nz = _distance(shape, x, y, z)
        normal[i, 0], normal[i, 1], normal[i, 2] = rotate_vector(r, nx, ny, nz)


@njit(cache=True, nogil=True, error_model="numpy")
def _curvatures(shape, r, origin, points, turn):
    """Fill turn (P, 3, 3), 1/m, with the second derivatives of the distance."""
    most = 5.0 / shape[3]
    first, second = np.empty(3), np.empty(3)
    for i in range(len(points)):
        local = np.empty(3)
        for d in range(3):
            local[d] = 0.0
            for e in range(3):
                local[d] += r[e, d] * (points[i, e] - origin[e])
        if local[2] + shape[3] + shape[2] <= 0.0:
            continue
        across, ux, uz, inner = _profile(shape, local[0], local[2])
        side = 1.0 if local[1] >= 0.0 else -1.0
        beside = side * local[1] - shape[1]
        _, by, ba, outer = _corner(shape[5], shape[6], shape[7], beside, across)
        inner, outer = min(ba * inner, most), min(outer, most)
        for d in range(3):  # unit vectors along which the normal turns
            first[d] = r[d, 0] * uz - r[d, 2] * ux
            second[d] = ba * side * r[d, 1] - by * (r[d, 0] * ux + r[d, 2] * uz)
        for d in range(3):
            for e in range(3):
                turn[i, d, e] = inner * first[d] * first[e] + outer * second[d] * second[e]


@njit(cache=True, nogil=True, error_model="numpy")
def _enter(shape, came, there, gap, normal):
    """Fill gap (P,) and normal (P, 3) of planes where points enter, all in frame ``probe``."""
    for i in range(len(there)):
        wx = there[i, 0] - came[i, 0]
        wy = there[i, 1] - came[i, 1]
        wz = there[i, 2] - came[i, 2]
        length = math.sqrt(wx * wx + wy * wy + wz * wz)
        part = 0.0
        found, nx, ny, nz = _distance(shape, came[i, 0], came[i, 1], came[i, 2])
        for _ in range(_TRACED):
            if found < _CLOSE or part >= 1.0:
                break
            part = min(part + found / length, 1.0)
            x, y, z = came[i, 0] + part * wx, came[i, 1] + part * wy, came[i, 2] + part * wz
            found, nx, ny, nz = _distance(shape, x, y, z)
        left = 1.0 - part
        gap[i] = found + left * (nx * wx + ny * wy + nz * wz)
        normal[i, 0] = nx
        normal[i, 1] = ny
        normal[i, 2] = nz
