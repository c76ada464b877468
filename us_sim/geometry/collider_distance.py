"""Signed distance of points to the probe's shape, for contact with tissue and skin.

>>> import numpy as np
>>> from us_sim.geometry.collider import Sphere
>>> from us_sim.geometry.collider_distance import measure_distances
>>> from us_sim.geometry.pose import Pose
>>> measure_distances(Sphere(0.03), Pose(), np.array([[0.0, 0.0, 0.01]]))
(array([0.01]), array([[0., 0., 1.]]))
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.collider import Collider
from us_sim.geometry.pose import Pose
from us_sim.kernels import njit


@njit(cache=True, nogil=True, error_model="numpy")
def rotate_vector(r, x, y, z):
    """Rotate a vector by the matrix r (3, 3): from the child's frame to the parent's."""
    return (
        r[0, 0] * x + r[0, 1] * y + r[0, 2] * z,
        r[1, 0] * x + r[1, 1] * y + r[1, 2] * z,
        r[2, 0] * x + r[2, 1] * y + r[2, 2] * z,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def rotate_vector_back(r, x, y, z):
    """Rotate a vector by the transpose of r (3, 3): from the parent's frame to the child's."""
    return (
        r[0, 0] * x + r[1, 0] * y + r[2, 0] * z,
        r[0, 1] * x + r[1, 1] * y + r[2, 1] * z,
        r[0, 2] * x + r[1, 2] * y + r[2, 2] * z,
    )


def measure_distances(
    collider: Collider, pose: Pose, points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Measure the distance of points to the collider's surface, and its outward normal there.

    The formulas are exact. Where the nearest surface point is not unique, on the core itself, the
    normal is the probe's +z if that is one of the nearest directions.

    Returns:
        (N,) m, negative inside, and (N, 3) unit normals, in the frame of pose and points (N, 3) m.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    distance = np.empty(len(points))
    normal = np.empty_like(points)
    _signed_distances(
        collider.offset_box, pose.rotation, np.array(pose.position), points, distance, normal
    )
    return distance, normal


@njit(cache=True, nogil=True, error_model="numpy")
def measure_box_distance(box, x, y, z):
    """Measure one point of frame ``probe``: return distance, nx, ny, nz.

    ``box`` is a collider's ``offset_box``; its foremost face is z = 0.
    """
    if len(box) > 4:
        return measure_curved_box_distance(box, 0.0, x, y, z)
    z = z + box[2] + box[3]
    dx = abs(x) - box[0]
    dy = abs(y) - box[1]
    dz = abs(z) - box[2]
    sx = 1.0 if x >= 0 else -1.0
    sy = 1.0 if y >= 0 else -1.0
    sz = 1.0 if z >= 0 else -1.0
    ox = max(dx, 0.0)
    oy = max(dy, 0.0)
    oz = max(dz, 0.0)
    length = math.sqrt(ox * ox + oy * oy + oz * oz)
    if length > 0.0:
        return length - box[3], sx * ox / length, sy * oy / length, sz * oz / length
    if dz >= dx and dz >= dy:
        return dz - box[3], 0.0, 0.0, sz
    if dx >= dy:
        return dx - box[3], sx, 0.0, 0.0
    return dy - box[3], 0.0, sy, 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def measure_curved_box_distance(box, grip, x, y, z):
    """Measure the distance to a box with a curved front that goes on behind by ``grip`` m."""
    radius = 1.0 / box[4]
    end = math.sqrt(radius * radius - box[0] * box[0])  # of the arc, above its centre
    ahead = z + box[3]  # of the foremost point of the core
    above = ahead + radius  # the arc's centre
    behind = -(ahead + 2 * box[2] + grip)
    sx = 1.0 if x >= 0 else -1.0
    sy = 1.0 if y >= 0 else -1.0
    dx = sx * x - box[0]
    dy = sy * y - box[1]
    # Distance to the core in the plane of the image, negative inside, and its direction.
    if above > 0.0 and sx * x * end <= box[0] * above:  # the arc is nearer than its ends
        reach = math.sqrt(x * x + above * above)
        across, ux, uz = reach - radius, x / reach, above / reach
        if across <= 0.0:
            if behind > across:
                across, ux, uz = behind, 0.0, -1.0
            if dx > across:
                across, ux, uz = dx, sx, 0.0
    elif dx > 0.0 or behind > 0.0:
        ox = max(dx, 0.0)
        oz = max(above - end, 0.0) - max(behind, 0.0)
        across = math.sqrt(ox * ox + oz * oz)
        ux, uz = sx * ox / across, oz / across
    elif dx >= behind:
        across, ux, uz = dx, sx, 0.0
    else:
        across, ux, uz = behind, 0.0, -1.0
    oa = max(across, 0.0)
    oy = max(dy, 0.0)
    length = math.sqrt(oa * oa + oy * oy)
    if length > 0.0:
        return length - box[3], ux * oa / length, sy * oy / length, uz * oa / length
    if across >= dy:
        return across - box[3], ux, 0.0, uz
    return dy - box[3], 0.0, sy, 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _signed_distances(box, rotation, origin, points, distance, normal):
    """Fill distance (N,) and normal (N, 3) for points (N, 3) of the parent frame."""
    r = rotation
    for i in range(len(points)):
        a = points[i, 0] - origin[0]
        b = points[i, 1] - origin[1]
        c = points[i, 2] - origin[2]
        x, y, z = rotate_vector_back(r, a, b, c)
        d, nx, ny, nz = measure_box_distance(box, x, y, z)
        distance[i] = d
        normal[i, 0], normal[i, 1], normal[i, 2] = rotate_vector(r, nx, ny, nz)
