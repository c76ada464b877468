"""The probe's shape where it touches the patient, as a signed distance shared by tissue and skin.

>>> import numpy as np
>>> from us_sim.collider import Sphere, signed_distance
>>> from us_sim.pose import Pose
>>> distance, normal = signed_distance(Sphere(0.03), Pose(), np.array([[0.0, 0.0, 0.01]]))
>>> distance, normal
(array([0.01]), array([[0., 0., 1.]]))
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from numba import njit
from numpy.typing import NDArray

from us_sim.errors import ProbeError
from us_sim.pose import Pose

__all__ = ["Capsule", "Collider", "RoundedBox", "Sphere", "offset_box_distance", "signed_distance"]


@dataclass(frozen=True)
class Sphere:
    """The paper's spherical collision volume; touches z = 0 of the probe at the origin.

    Raises:
        ProbeError: the radius is not a positive number.
    """

    radius: float  # m

    def __post_init__(self) -> None:
        _require_positive_lengths(self)

    @property
    def offset_box(self) -> NDArray[np.float64]:
        """(4,) m: half extents x, y, z of the core box, and the rounding around it."""
        return np.array([0.0, 0.0, 0.0, self.radius])


@dataclass(frozen=True)
class Capsule:
    """A cylinder along the probe's x with hemispherical ends, as a linear array has.

    Raises:
        ProbeError: a dimension is not a positive number.
    """

    radius: float  # m
    length: float  # m, between the centres of the two end caps

    def __post_init__(self) -> None:
        _require_positive_lengths(self)

    @property
    def offset_box(self) -> NDArray[np.float64]:
        """(4,) m: half extents x, y, z of the core box, and the rounding around it."""
        return np.array([self.length / 2, 0.0, 0.0, self.radius])


@dataclass(frozen=True)
class RoundedBox:
    """A flat transducer face with rounded edges.

    Raises:
        ProbeError: a dimension is not a positive number, or the rounding is more than half of one.
    """

    length: float  # m, along the probe's x, over everything
    width: float  # m, along the probe's y, over everything
    height: float  # m, along the probe's z, over everything
    rounding: float  # m, radius of edges and corners

    def __post_init__(self) -> None:
        _require_positive_lengths(self)
        smallest = min(self.length, self.width, self.height)
        if 2 * self.rounding > smallest:
            raise ProbeError(
                f"RoundedBox.rounding is {self.rounding:g} m, more than half of the smallest "
                f"side ({smallest:g} m): give at most {smallest / 2:g} m"
            )

    @property
    def offset_box(self) -> NDArray[np.float64]:
        """(4,) m: half extents x, y, z of the core box, and the rounding around it."""
        sides = np.array([self.length, self.width, self.height])
        return np.append(sides / 2 - self.rounding, self.rounding)


Collider = Sphere | Capsule | RoundedBox


def signed_distance(
    collider: Collider, pose: Pose, points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distance of points to the collider's surface, and its outward normal there.

    Every shape here is a box (for a sphere a point, for a capsule a segment) grown by a rounding,
    so one exact formula serves all. Where the nearest surface point is not unique, on the core
    itself, the normal is the probe's +z if that is one of the nearest directions.

    Args:
        collider: the shape, which lies in frame ``probe``.
        pose: of the probe in the frame of the points.
        points: (N, 3) m.

    Returns:
        (N,) m, negative inside, and (N, 3) unit normals in the frame of the points.
    """
    points = np.ascontiguousarray(points, dtype=np.float64)
    distance = np.empty(len(points))
    normal = np.empty_like(points)
    _signed_distances(
        collider.offset_box, pose.rotation, np.array(pose.position), points, distance, normal
    )
    return distance, normal


def _require_positive_lengths(collider: Collider) -> None:
    for field in fields(collider):
        value = getattr(collider, field.name)
        if not (isinstance(value, int | float) and math.isfinite(value) and value > 0):
            raise ProbeError(
                f"{type(collider).__name__}.{field.name} is {value!r}: give a length in metres "
                f"above zero"
            )


@njit(cache=True, nogil=True, error_model="numpy")
def offset_box_distance(box, x, y, z):
    """Distance and normal for one point of frame ``probe``: (distance, nx, ny, nz).

    ``box`` is a collider's ``offset_box``; its foremost face is z = 0.
    """
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
def _signed_distances(box, rotation, origin, points, distance, normal):
    """Fills distance (N,) and normal (N, 3) for points (N, 3) of the parent frame."""
    r = rotation
    for i in range(len(points)):
        a = points[i, 0] - origin[0]
        b = points[i, 1] - origin[1]
        c = points[i, 2] - origin[2]
        x = r[0, 0] * a + r[1, 0] * b + r[2, 0] * c
        y = r[0, 1] * a + r[1, 1] * b + r[2, 1] * c
        z = r[0, 2] * a + r[1, 2] * b + r[2, 2] * c
        d, nx, ny, nz = offset_box_distance(box, x, y, z)
        distance[i] = d
        normal[i, 0] = r[0, 0] * nx + r[0, 1] * ny + r[0, 2] * nz
        normal[i, 1] = r[1, 0] * nx + r[1, 1] * ny + r[1, 2] * nz
        normal[i, 2] = r[2, 0] * nx + r[2, 1] * ny + r[2, 2] * nz
