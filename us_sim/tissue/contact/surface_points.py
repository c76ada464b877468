"""Points spread over the surface that a probe can touch, and their weights at its nodes.

They are in the middles of the triangles' parts (`TriangleParts`) and at the nodes. A node that the
probe can touch, but no triangle's, is a point by itself.

>>> from us_sim.tissue.model import TissueModel
>>> points = SurfacePoints(TissueModel.make_block((0.1, 0.1, 0.1), (2, 2, 2)), size=0.08)
>>> len(points.rest), float(points.spread_to_points(np.ones(8)).sum())  # of the top's four nodes
(12, 4.0)
>>> sunk = np.zeros((3, 8))
>>> sunk[2] = 0.01
>>> points.interpolate_field(sunk)[0]
array([0.  , 0.  , 0.01])
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.triangles import TriangleParts, choose_part_size
from us_sim.kernels import njit
from us_sim.tissue.contact.penalty_contact import PenaltyContact
from us_sim.tissue.contact.probe_gap import FlaredProbe
from us_sim.tissue.elasticity.linear_tetrahedra import nodal_shear_stiffness
from us_sim.tissue.elasticity.neo_hookean_material import barrier_strength
from us_sim.tissue.model import TissueModel

_LOOP: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": True}

_SHARE = 0.5
"""Part of a point's spring that each of its nodes gets by weight, where they do not share it. From
0.35 to 0.6 conjugate gradients took about 5 percent fewer iterations than with 1."""

_AT_NODES = 0.1
"""Part of a triangle's area that points at its nodes stand for. The more, the farther nodes near
the edge of touching are pushed aside: the mean direction of the pressure is not that at nodes."""

_WEAK = 0.2
"""A spring at a node that is weaker than this part of all there is left out."""

_FIRMNESS = 40.0
"""Stiffness of the springs of a node, over the shear stiffness of the tissue there. The softer, the
deeper the probe sinks in; the firmer, the worse conditioned the equations. Between 30 and 80 the
distance to a fine mesh hardly changes."""

_STIFFENING = 0.2
"""Depth at which a spring pushes twice as much as if it were linear, over the nodes' spacing."""

_GREATEST_FORCE = 25.0
"""Greatest force of a node's springs, over `barrier_strength` there: less than what a crushed
tetrahedron resists, so that no probe turns one inside out."""


def make_surface_contact(model: TissueModel) -> tuple[SurfacePoints, PenaltyContact]:
    """Make points on the surface of a tissue, and the contact of its probe at these."""
    # A lone node has no neighbour to be apart from.
    spacing = model.contact_spacing or float(np.ptp(model.mesh.nodes, axis=0).min())
    points = SurfacePoints(model, choose_part_size(float(model.collider.offset_box[3]), spacing))
    stiffness = _FIRMNESS * points.spread_to_points(
        nodal_shear_stiffness(model.mesh, model.materials)
    )
    greatest = _GREATEST_FORCE * points.spread_to_points(
        barrier_strength(model.mesh, model.materials)
    )
    probe = FlaredProbe(model.collider, spacing)
    law = (probe, stiffness, greatest, _STIFFENING * spacing)
    triangles = points.corners, points.weights
    return points, PenaltyContact(*law, *triangles)


class SurfacePoints:
    """P points on the surface of a tissue.

    Args:
        model: the points are on the triangles of its boundary all of whose nodes the probe can
            touch, not all of them fixed.
        size: m, longest side of a triangle's parts.
    """

    def __init__(self, model: TissueModel, size: float) -> None:
        mesh = model.mesh
        reached = np.zeros(len(mesh.nodes), dtype=bool)
        reached[model.contact_nodes] = True
        triangles = mesh.boundary[reached[mesh.boundary].all(axis=1)]
        triangles = triangles[~model.fixed[triangles].all(axis=1)]
        corners = mesh.nodes[triangles]
        sides = corners - np.roll(corners, 1, axis=1)
        longest = np.linalg.norm(sides, axis=2).max(axis=1)
        area = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
        corner_area = np.zeros(len(mesh.nodes))
        np.add.at(corner_area, triangles, area[:, None] / 3)
        corner_area[reached & ~model.fixed & (corner_area == 0.0)] = 1.0  # of nodes by themselves
        own = np.flatnonzero((corner_area > 0.0) & ~model.fixed)
        parts = TriangleParts(longest, size)
        nodes = (np.repeat(own[:, None], 3, axis=1), triangles[parts.triangle])
        self.nodes = np.concatenate(nodes).astype(np.int64)  # (P, 3)
        weights = (np.tile([1.0, 0.0, 0.0], (len(own), 1)), parts.weights)
        self.weights = np.concatenate(weights)  # (P, 3) of these nodes; they sum to one
        at_node = np.full(len(mesh.nodes), -1)
        at_node[own] = np.arange(len(own))
        #: (P, 3) points at these nodes; -1 where a node has none, and for points at nodes.
        self.corners = at_node[self.nodes]
        self.corners[: len(own)] = -1
        share = np.where(np.isin(own, triangles), _AT_NODES, 1.0)
        area = (1 - _AT_NODES) * area / np.diff(parts.first)
        areas = (share * corner_area[own], area[parts.triangle])
        self.rest = np.einsum("pk,pkd->pd", self.weights, mesh.nodes[self.nodes])  # (P, 3) m
        self._area = np.concatenate(areas)  # (P,) m2
        self._count = len(mesh.nodes)
        self._own, corner = np.unique(self.nodes, return_inverse=True)  # (S,) nodes of points
        self._corner = corner.reshape(self.nodes.shape)  # (P, 3), their places in _own
        self._movable = ~model.fixed[self._own]
        self._all = np.arange(len(self.nodes))
        total = self.sum_at_nodes(self._area)
        self._per_area = np.divide(1.0, total, out=np.zeros_like(total), where=total > 0.0)

    def spread_to_points(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (P,), values of nodes (N,) handed to their points by area; the sum is the same."""
        density = (self.weights * (values * self._per_area)[self.nodes]).sum(axis=1)
        return np.asarray(self._area * density)

    def sum_at_nodes(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (N, ...), values of points (P, ...) handed to their nodes by weight."""
        total = np.zeros((self._count, *values.shape[1:]))
        for k in range(3):
            weight = self.weights[:, k].reshape(-1, *[1] * (values.ndim - 1))
            np.add.at(total, self.nodes[:, k], weight * values)
        return total

    def merge_springs(
        self,
        stiffness: NDArray[np.float64],
        gap: NDArray[np.float64],
        normal: NDArray[np.float64],
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Merge the springs of points into one spring at each node.

        Args:
            stiffness: (P,) N/m; zero where there is none.
            gap: (P,) m.
            normal: (P, 3), direction of the push.

        Returns:
            (N,) m, gaps, infinite where there is no spring; (N, 3), their directions; and (N,)
            m/N, how soft they are.
        """
        total = np.zeros((self._count, 5))
        _sum_springs(self.nodes, self.weights, stiffness, gap, normal, total)
        sprung = np.flatnonzero(total[:, 0] > 0.0)
        firm, across = total[sprung, :1], total[sprung, 2:]
        gaps, normals = np.full(self._count, np.inf), np.zeros((self._count, 3))
        gaps[sprung] = total[sprung, 1] / firm[:, 0]
        normals[sprung] = (
            across / np.maximum(np.linalg.norm(across, axis=1), 1e-9 * firm[:, 0])[:, None]
        )
        softness = np.ones(self._count)
        softness[sprung] = 1.0 / firm[:, 0]
        return gaps, normals, softness

    def interpolate_field(
        self, field: NDArray[np.float64], some: NDArray[np.integer] | None = None
    ) -> NDArray[np.float64]:
        """Return (P, 3), a field (3, N) at ``some`` points, zero at others."""
        values = np.zeros((len(self.nodes), 3))
        some = self._all if some is None else some
        _add_at_points(some, self.nodes, self.weights, field, values)
        return values

    def compute_positions(
        self, displacement: NDArray[np.float64], some: NDArray[np.integer] | None = None
    ) -> NDArray[np.float64]:
        """Return (P, 3) m, ``some`` points at a displacement (3, N) m, others at rest."""
        places: NDArray[np.float64] = self.rest.copy()
        some = self._all if some is None else some
        _add_at_points(some, self.nodes, self.weights, displacement, places)
        return places

    def add_to_nodes(
        self, vectors: NDArray[np.float64], field: NDArray[np.float64], some: NDArray[np.integer]
    ) -> None:
        """Add vectors (P, 3) of some points to the nodes' field (3, N), by weight."""
        _scatter(some, self.nodes, self.weights, vectors, field)

    def lump_springs(
        self,
        active: NDArray[np.integer],
        directions: NDArray[np.float64],
        stiffness: NDArray[np.float64],
    ) -> tuple[NDArray[np.integer], NDArray[np.float64], NDArray[np.float64]]:
        """Divide each point's spring among its nodes, as if these did not share it.

        They are about as stiff as the springs of the points together; that is for preconditioners.

        Args:
            active: (K,) points.
            directions: (K, 3), of their springs.
            stiffness: (K,) N/m.

        Returns:
            (S,) nodes that are not fixed, each with all its springs in a row; (S, 3) directions;
            (S,) N/m.
        """
        used, tensor = self._own, np.zeros((len(self._own), 6))
        _lump(active, self._corner, self.weights, directions, stiffness, tensor)
        nodes = np.empty(3 * len(used), dtype=np.int64)
        along, firm = np.empty((3 * len(used), 3)), np.empty(3 * len(used))
        count = _split(used, tensor, self._movable, nodes, along, firm)
        return nodes[:count], along[:count], firm[:count]


@njit(**_LOOP)
def _add_at_points(some, nodes, weights, field, values):
    """Add a field (3, N) at ``some`` points to their values (P, 3)."""
    x, y, z = field[0], field[1], field[2]
    for p in some:
        i, j, k = nodes[p, 0], nodes[p, 1], nodes[p, 2]
        a, b, c = weights[p, 0], weights[p, 1], weights[p, 2]
        values[p, 0] += a * x[i] + b * x[j] + c * x[k]
        values[p, 1] += a * y[i] + b * y[j] + c * y[k]
        values[p, 2] += a * z[i] + b * z[j] + c * z[k]


@njit(**_LOOP)
def _scatter(some, nodes, weights, vectors, field):
    """Add vectors (P, 3) of ``some`` points to a field (3, N) at their nodes."""
    for p in some:
        for k in range(3):
            for d in range(3):
                field[d, nodes[p, k]] += weights[p, k] * vectors[p, d]


@njit(**_LOOP)
def _sum_springs(nodes, weights, stiffness, gap, normal, total):
    """Add to total (N, 5) the stiffness of each node's springs, and gaps and normals by that."""
    for p in range(len(nodes)):
        if stiffness[p] > 0.0:
            for k in range(3):
                share = weights[p, k] * stiffness[p]
                t = total[nodes[p, k]]
                t[0] += share
                t[1] += share * gap[p]
                for d in range(3):
                    t[2 + d] += share * normal[p, d]


@njit(**_LOOP)
def _lump(active, corner, weights, directions, stiffness, tensor):
    """Add the springs to their nodes' stiffnesses ``tensor`` (S, 6): xx, xy, xz, yy, yz, zz."""
    for m in range(len(active)):
        x, y, z = directions[m, 0], directions[m, 1], directions[m, 2]
        for k in range(3):
            scale = _SHARE * stiffness[m] * weights[active[m], k]
            t = tensor[corner[active[m], k]]
            t[0] += scale * x * x
            t[1] += scale * x * y
            t[2] += scale * x * z
            t[3] += scale * y * y
            t[4] += scale * y * z
            t[5] += scale * z * z


@njit(**_LOOP)
def _split(own, tensor, movable, nodes, along, firm):
    """Write tensors as springs, by Cholesky's method with pivots; return their number."""
    count = 0
    left = np.empty((3, 3))
    for i in range(len(own)):
        t = tensor[i]
        if not movable[i] or t[0] + t[3] + t[5] == 0.0:
            continue
        left[0, 0], left[0, 1], left[0, 2] = t[0], t[1], t[2]
        left[1, 0], left[1, 1], left[1, 2] = t[1], t[3], t[4]
        left[2, 0], left[2, 1], left[2, 2] = t[2], t[4], t[5]
        least = _WEAK * (t[0] + t[3] + t[5])
        for _ in range(3):
            pivot = 0
            for d in range(1, 3):
                if left[d, d] > left[pivot, pivot]:
                    pivot = d
            top = left[pivot, pivot]
            x, y, z = left[0, pivot], left[1, pivot], left[2, pivot]
            size = (x * x + y * y + z * z) / top if top > 0.0 else 0.0
            if size <= least:
                break
            length = math.sqrt(x * x + y * y + z * z)
            nodes[count], firm[count] = own[i], size
            along[count, 0], along[count, 1], along[count, 2] = x / length, y / length, z / length
            count += 1
            for d in range(3):
                for e in range(3):
                    left[d, e] -= size * along[count - 1, d] * along[count - 1, e]
    return count


@njit(**_LOOP)
def add_springs(nodes, weights, directions, stiffness, change, image):
    """Add to image (3, N) the forces of points' springs as nodes move by change (3, N).

    nodes, weights and directions are (K, 3), stiffness (K,) N/m.
    """
    for p in range(len(nodes)):
        i, j, k = nodes[p, 0], nodes[p, 1], nodes[p, 2]
        along = 0.0
        for d in range(3):
            c = change[d]
            moved = weights[p, 0] * c[i] + weights[p, 1] * c[j] + weights[p, 2] * c[k]
            along += directions[p, d] * moved
        along *= stiffness[p]
        for d in range(3):
            force = along * directions[p, d]
            image[d, i] += weights[p, 0] * force
            image[d, j] += weights[p, 1] * force
            image[d, k] += weights[p, 2] * force


@njit(**_LOOP)
def add_turns(nodes, weights, turn, change, image):
    """Add to image as `add_springs`, for stiffnesses (K, 3, 3) N/m in all directions."""
    for p in range(len(nodes)):
        i, j, k = nodes[p, 0], nodes[p, 1], nodes[p, 2]
        for d in range(3):
            force = 0.0
            for e in range(3):
                c = change[e]
                moved = weights[p, 0] * c[i] + weights[p, 1] * c[j] + weights[p, 2] * c[k]
                force += turn[p, d, e] * moved
            image[d, i] += weights[p, 0] * force
            image[d, j] += weights[p, 1] * force
            image[d, k] += weights[p, 2] * force
