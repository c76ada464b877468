"""The surface on which a probe is put: the patient's skin at rest.

>>> import numpy as np
>>> from us_sim.tracking.virtual_hand.rest_surface import RestSurface
>>> skin = RestSurface.plane(0.1)
>>> foot = skin.closest(np.array([0.01, 0.02, -0.03]))
>>> foot.point, foot.normal
(array([0.01, 0.02, 0.  ]), array([ 0.,  0., -1.]))
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError

_STEP = 1e-3
"""m: a way over the surface is walked in steps of this, each along the tangent where it begins."""
_TURNS, _NEAR = 30, 1e-9
"""How often the foot of a perpendicular is improved at most, and how far (m) it may then be off."""
_FACING_UP = 0.3
"""Cosine between -z and the normals of a closed surface's upper side, which is more than this."""


@dataclass(frozen=True, eq=False)
class Foot:
    """Where something stands on the surface."""

    point: NDArray[np.float64]  # (3,) m, on the surface, frame patient
    normal: NDArray[np.float64]  # (3,) unit length, out of the body, without jumps along the skin


class RestSurface:
    """Triangles whose normals are made smooth, since a probe on facets would jerk at their edges.

    The normal at a point is interpolated between those of its triangle's corners (Phong 1975), and
    a corner's is the mean of its triangles', weighted by their areas.

    Args:
        vertices: (N, 3) m, frame ``patient``.
        triangles: (T, 3) indices into them, anticlockwise as seen from outside the body.

    Raises:
        MeshError: no triangle has an area, a vertex is not finite, or an index is of no vertex.
    """

    def __init__(self, vertices: NDArray[np.floating], triangles: NDArray[np.integer]) -> None:
        vertices = np.asarray(vertices, dtype=np.float64)
        triangles = np.asarray(triangles, dtype=np.int64).reshape(-1, 3)
        if triangles.size and not 0 <= triangles.min() <= triangles.max() < len(vertices):
            raise MeshError(
                f"the skin's triangles name vertices {triangles.min()} to {triangles.max()}, but "
                f"there are only {len(vertices)}"
            )
        corners = vertices[triangles]
        if not np.isfinite(corners).all():
            raise MeshError("a vertex of the skin is not finite, so no probe can stand on it")
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        proper = np.linalg.norm(across, axis=1) > 0.0
        if not proper.any():
            raise MeshError("the skin has no triangle with an area, so no probe can stand on it")
        sums = np.zeros_like(vertices)
        np.add.at(sums, triangles, across[:, None, :])
        lengths = np.linalg.norm(sums, axis=1, keepdims=True)
        normals = np.divide(sums, lengths, out=sums, where=lengths > 0.0)
        self._corners = corners[proper]  # (T, 3, 3) m
        self._normals = normals[triangles[proper]]  # (T, 3, 3)
        self._flat = across[proper] / np.linalg.norm(across[proper], axis=1, keepdims=True)
        self._centres = self._corners.mean(axis=1)
        self._radii = np.linalg.norm(self._corners - self._centres[:, None], axis=2).max(axis=1)
        self.lower: NDArray[np.float64] = self._corners.min(axis=(0, 1))
        self.upper: NDArray[np.float64] = self._corners.max(axis=(0, 1))
        """(3,) m, the corners of the box around it."""

    @classmethod
    def plane(cls, half: float) -> RestSurface:
        """The square of z = 0 within ``half`` m around the origin, with the body at z > 0."""
        vertices = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
        return cls(np.insert(vertices, 2, 0.0, axis=1), np.array([[0, 2, 1], [0, 3, 2]]))

    @classmethod
    def upper_side(
        cls, vertices: NDArray[np.floating], triangles: NDArray[np.integer]
    ) -> RestSurface:
        """The part of a closed surface on which a probe can be put: what faces -z.

        Args:
            vertices: (N, 3) m, frame ``patient``.
            triangles: (T, 3) indices into them, anticlockwise as seen from outside the body.

        Raises:
            MeshError: as the class itself; nothing of it faces -z.
        """
        a, b, c = (np.asarray(vertices, dtype=np.float64)[triangles[:, k]] for k in range(3))
        across = np.cross(b - a, c - a)
        faces_up = -across[:, 2] > _FACING_UP * np.linalg.norm(across, axis=1)
        return cls(vertices, triangles[faces_up])

    def closest(self, point: NDArray[np.float64]) -> Foot:
        """The surface's closest point to one (3,) m."""
        offsets = self._centres - point
        distances = np.sqrt(np.einsum("tx,tx->t", offsets, offsets))
        least = distances - self._radii
        near = np.flatnonzero(least <= distances.min())
        order = near[np.argsort(least[near])]
        target, found = point.tolist(), (math.inf, 0, (1.0, 0.0, 0.0))
        # Few are looked at: a point on the surface is within the spheres of some eight triangles.
        for triangle, bound in zip(order.tolist(), least[order].tolist(), strict=True):
            if bound > 0.0 and bound * bound > found[0]:
                break
            a, b, c = self._corners[triangle].tolist()
            weights = _closest_weights(a, b, c, target)
            square = sum(
                (weights[0] * a[k] + weights[1] * b[k] + weights[2] * c[k] - target[k]) ** 2
                for k in range(3)
            )
            found = min(found, (square, triangle, weights))
        return self._foot(found[1], np.array(found[2]))

    def above(self, x: float, y: float) -> Foot:
        """The first point of the surface on the way along +z through x, y (m).

        Where that way misses the surface it is the point closest to x, y on the surface's top.
        """
        a, b, c = (self._corners[:, k, :2] for k in range(3))
        point = np.array([x, y])
        areas = np.stack([_area(b, c, point), _area(c, a, point), _area(a, b, point)], axis=1)
        total = areas.sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            weights = areas / total[:, None]
        met = np.flatnonzero((weights >= -1e-9).all(axis=1) & (total != 0.0))
        if not len(met):
            return self.closest(np.array([x, y, self.lower[2]]))
        heights = np.einsum("tc,tc->t", weights[met], self._corners[met, :, 2])
        first = int(np.argmin(heights))
        return self._foot(int(met[first]), weights[met[first]])

    def under(self, position: NDArray[np.float64]) -> tuple[Foot, float]:
        """The foot on whose normal a position (3,) m lies, and how far inwards (m) it is from it.

        Near the edge of a surface that is not closed there may be none: then it is the closest.
        """
        point = position
        for _ in range(_TURNS):
            foot = self.closest(point)
            offset = position - foot.point
            inwards = -float(offset @ foot.normal)
            aside = offset + inwards * foot.normal
            if float(np.abs(aside).max()) < _NEAR:
                return foot, inwards
            point = foot.point + aside
        foot = self.closest(position)
        return foot, -float((position - foot.point) @ foot.normal)

    def walk(self, foot: Foot, way: NDArray[np.float64]) -> Foot:
        """Where one comes to along a way (3,) m over the surface, straight on.

        The way's direction is turned with the surface; at an edge one stays.
        """
        length = float(np.linalg.norm(way))
        steps = max(1, int(np.ceil(length / _STEP)))
        direction = np.asarray(way, dtype=np.float64)
        for _ in range(steps):
            tangent = direction - (direction @ foot.normal) * foot.normal
            size = float(np.linalg.norm(tangent))
            if size < 1e-12:
                break
            direction = tangent / size
            foot = self.closest(foot.point + (length / steps) * direction)
        return foot

    def _foot(self, triangle: int, weights: NDArray[np.float64]) -> Foot:
        normal = weights @ self._normals[triangle]
        length = float(np.linalg.norm(normal))
        # Where triangles fold onto each other their normals may cancel.
        normal = normal / length if length > 1e-9 else self._flat[triangle]
        return Foot(weights @ self._corners[triangle], normal)


def _area(
    a: NDArray[np.float64], b: NDArray[np.float64], point: NDArray[np.float64]
) -> NDArray[np.float64]:
    """(T,) twice the signed areas of the triangles a, b (T, 2) and a point (2,), m²."""
    along, to = b - a, point - a
    return np.asarray(along[:, 0] * to[:, 1] - along[:, 1] * to[:, 0])


def _closest_weights(
    a: list[float], b: list[float], c: list[float], point: list[float]
) -> tuple[float, float, float]:
    """Barycentric weights of the closest point of a triangle to a point, m.

    By the region in which the point lies (Ericson, Real-Time Collision Detection, 2005, 5.1.5).
    """
    ab, ac = _from(a, b), _from(a, c)
    to = _from(a, point)
    d1, d2 = _dot(ab, to), _dot(ac, to)
    if d1 <= 0.0 and d2 <= 0.0:
        return 1.0, 0.0, 0.0
    to = _from(b, point)
    d3, d4 = _dot(ab, to), _dot(ac, to)
    if d3 >= 0.0 and d4 <= d3:
        return 0.0, 1.0, 0.0
    to = _from(c, point)
    d5, d6 = _dot(ab, to), _dot(ac, to)
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 0.0, 1.0
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v = d1 / (d1 - d3)
        return 1.0 - v, v, 0.0
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        w = d2 / (d2 - d6)
        return 1.0 - w, 0.0, w
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 >= d3 and d5 >= d6:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return 0.0, 1.0 - w, w
    total = va + vb + vc
    return va / total, vb / total, vc / total


def _from(start: list[float], end: list[float]) -> tuple[float, float, float]:
    return end[0] - start[0], end[1] - start[1], end[2] - start[2]


def _dot(first: tuple[float, float, float], second: tuple[float, float, float]) -> float:
    return first[0] * second[0] + first[1] * second[1] + first[2] * second[2]
