"""The shape with which a probe presses a surface that is coarser than the probe's edges.

It is the collider, with a front that is the collider's own, and flanks that lean outward behind it,
at 60 degrees to the face, until they are a little wider than the collider; from there they go
straight back. A surface whose nodes are farther apart than the rounding of an edge cannot lie along
upright flanks: it would be swallowed by the edge. A collider whose rounding the nodes resolve keeps
its own flanks.

The shape is convex, so that its signed distance is a convex function; so a spring along it has an
energy (S. Boyd and L. Vandenberghe, Convex Optimization, 2004, section 8.1). Outside the core the
distance has a continuous slope, but for the four edges where two leaning flanks meet: there the
normal turns by 29 degrees at once.

>>> import numpy as np
>>> from us_sim.geometry.collider import RoundedBox
>>> from us_sim.geometry.pose import Pose
>>> from us_sim.tissue.contact.flared_probe import FlaredProbe
>>> probe = FlaredProbe(RoundedBox(0.04, 0.014, 0.03, 0.004), spacing=0.006)
>>> gap, normal = probe.distance(Pose(), np.array([[0.0, 0.0, -0.001], [0.022, 0.0, -0.005]]))
>>> gap.round(6), normal.round(3)
(array([-0.001   ,  0.000696]), array([[0.   , 0.   , 1.   ],
       [0.866, 0.   , 0.5  ]]))
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.collider import Collider
from us_sim.geometry.collider_distance import turned, turned_back
from us_sim.geometry.pose import Pose
from us_sim.kernels import njit

_LEAN = math.radians(60)
"""Angle of the leaning flanks to the face."""

_FLARE = 0.6
"""How much wider than the collider the flanks become at each side, over the nodes' spacing."""

_RESOLVED = 2.0
"""Rounding, over the nodes' spacing, from which on they resolve it."""

_GRIP = 0.1
"""Length by which the shape continues behind the collider, m, as where a hand holds the probe."""

_REACH = 1.0
"""Gap of points that may come to touch, over what is deep and the nodes' spacing together."""

_CLOSE = 1e-6  # m
_TRACED = 400  # steps of a point's way in, of which a grazing one takes many


class FlaredProbe:
    """The shape, and how far points are from it.

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
        self.reach = _REACH * (self.deep + spacing)

    def distance(
        self, pose: Pose, points: NDArray[np.float64], near: NDArray[np.integer] | None = None
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Signed distance of points, and the outward normal of the surface there.

        Args:
            pose: of the probe in the points' frame.
            points: (P, 3) m.
            near: numbers of the points to look at; all others are infinitely far.

        Returns:
            (P,) m, negative inside, infinite behind the shape, and (P, 3).
        """
        if near is None:
            near = np.arange(len(points))
        gap, normal = np.full(len(points), np.inf), np.zeros((len(points), 3))
        _distances(self._shape, pose.rotation, np.array(pose.position), points, near, gap, normal)
        return gap, normal

    def curvature(self, pose: Pose, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(P, 3, 3) 1/m, how the normal turns as points (P, 3) m move."""
        turn = np.zeros((len(points), 3, 3))
        _curvatures(self._shape, pose.rotation, np.array(pose.position), points, turn)
        return turn

    def entered(
        self, last: Pose | None, pose: Pose, points: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The planes through which points came in as the probe moved from one pose to another.

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
    """Distance in a plane to a front that ends at the origin, and the flank behind its end.

    The front is where ``ahead`` is zero, the flank at ``beside`` above zero. Returns it, its two
    slopes, and its curvature (1/m) across them.
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
    """Distance to the core in the plane of the image: (distance, its slopes by x and z, 1/m)."""
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
    """Distance and normal for one point of frame ``probe``: (distance, nx, ny, nz)."""
    if z + shape[3] + shape[2] <= 0.0:
        return math.inf, 0.0, 0.0, 1.0
    across, ux, uz, _ = _profile(shape, x, z)
    side = 1.0 if y >= 0.0 else -1.0
    found, by, ba, _ = _corner(shape[5], shape[6], shape[7], side * y - shape[1], across)
    return found - shape[3], ba * ux, side * by, ba * uz


@njit(cache=True, nogil=True, error_model="numpy")
def _distances(shape, r, origin, points, near, gap, normal):
    """Fills gap (P,), normal (P, 3) for the points (P, 3) that are near."""
    for i in near:
        a = points[i, 0] - origin[0]
        b = points[i, 1] - origin[1]
        c = points[i, 2] - origin[2]
        x, y, z = turned_back(r, a, b, c)
        gap[i], nx, ny, nz = _distance(shape, x, y, z)
        normal[i, 0], normal[i, 1], normal[i, 2] = turned(r, nx, ny, nz)


@njit(cache=True, nogil=True, error_model="numpy")
def _curvatures(shape, r, origin, points, turn):
    """Fills turn (P, 3, 3), 1/m: the second derivatives of the distance."""
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
    """Fills gap (P,) and normal (P, 3) of planes where points enter, all in frame ``probe``."""
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
