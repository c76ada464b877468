"""A coarse grid over a mesh, on which the smooth part of a correction is solved directly.

Conjugate gradients with a local preconditioner carry a force one layer of nodes an iteration. So
what varies slowly is solved for on a few hundred nodes of a regular grid around the mesh, between
which displacements are trilinear (the coarse level of a two-level additive Schwarz method; B.
Smith, P. Bjorstad and W. Gropp, Domain Decomposition, 1996, section 2.1). The grid need not follow
the mesh, which may be of any kind.

>>> import numpy as np
>>> from us_sim.tissue.linear_algebra.coarse_grid import CoarseGrid
>>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
>>> planes = uniform_planes(0.0, 0.1, 9)
>>> mesh = box_mesh(planes, planes, planes)
>>> held = mesh.nodes[:, 2] > 0.09
>>> grid = CoarseGrid(mesh, held, lambda field: 5.0 * field, np.float64)
>>> grid.touch(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0))
>>> force = np.zeros((3, len(mesh.nodes)))
>>> force[2] = 10.0 * (0.1 - mesh.nodes[:, 2]) * ~held
>>> correction = np.zeros_like(force)
>>> grid.add_correction(force, correction)
>>> bool(abs(correction - force / 5.0).max() < 0.03)
True
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh

_MOST_NODES = 400
"""Most nodes of a grid around the bounding box: a dense product of 1,200 unknowns takes 0.2 ms."""

_SPARSEST = 8
"""Fewest nodes of the mesh for each node of the grid: with fewer there is nothing to gain."""

_INDEPENDENT = 1e-7
"""Combinations of grid functions softer than this fraction of the stiffest count as dependent."""

_YIELD = 3.0
"""Stiffness of the grid's constraint at a touched node, over the node's own. The constraint need
not be exact, as the local preconditioner does the rest."""


class CoarseGrid:
    """Applies P (P' K P)^-1 P' with P the trilinear interpolation from the grid to the mesh.

    Touched nodes are kept from moving along their normals by a correction of low rank (M. A.
    Woodbury, Inverting modified matrices, 1950).

    Args:
        mesh: of any shape.
        fixed: (N,), nodes that do not move.
        product: K times a field (3, N), with the fixed nodes' rows left in.
        dtype: in which it is applied.
    """

    def __init__(
        self,
        mesh: TetrahedralMesh,
        fixed: NDArray[np.bool_],
        product: Callable[[NDArray[np.floating]], NDArray[np.floating]],
        dtype: type[np.floating],
    ) -> None:
        cell, corner, weight = _interpolation(mesh.nodes, ~fixed)
        order = np.argsort(cell, kind="stable")
        order = order[~fixed[order]]
        starts = np.flatnonzero(np.diff(cell[order], prepend=-1))
        self._node = order.astype(np.uint32)  # (F,) free nodes, those of one grid cell together
        self._start = np.append(starts, len(order)).astype(np.int64)  # (cells + 1,)
        self._corner = corner[order[starts]].astype(np.int64)  # (cells, 8) grid nodes
        self._place = np.empty(len(cell), np.int64)  # (N,) of each node in _node
        self._place[order] = np.arange(len(order))
        self._cell_of = np.repeat(np.arange(len(starts)), np.diff(self._start))
        self._weight = np.ascontiguousarray(weight[order], dtype=np.float64)  # (F, 8)
        self.size = 3 * (int(corner.max()) + 1 if len(order) else 0)
        self._inverse = self._invert(len(cell), product).astype(dtype)
        self._weight = self._weight.astype(dtype)
        self._across = np.ascontiguousarray(self._weight.T)  # (8, F)
        self._room = np.empty((3, len(self._node)), dtype)
        self._coarse = np.zeros((2, self.size), dtype)
        self._dtype = dtype
        self.touch(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0))

    def touch(
        self,
        nodes: NDArray[np.integer],
        normals: NDArray[np.float64],
        stiffness: NDArray[np.float64],
    ) -> None:
        """Keep ``nodes`` (K,) from moving along ``normals`` (K, 3); ``stiffness`` (K,) N/m.

        A stiffness that is not positive, or so small that it has no inverse, keeps nothing.
        """
        firm = stiffness > np.finfo(np.float64).tiny
        nodes, normals, stiffness = nodes[firm], normals[firm], stiffness[firm]
        place = self._place[nodes]
        self._touched_corner = self._corner[self._cell_of[place]]
        self._touched_weight = self._weight[place]
        self._normal = normals.astype(self._dtype)
        self._response = np.empty((len(nodes), self.size), self._dtype)
        self._factor = np.zeros((len(nodes), len(nodes)))
        _respond(
            self._inverse,
            self._touched_corner,
            self._touched_weight,
            self._normal,
            1.0 / (_YIELD * stiffness),
            self._response,
            self._factor,
        )

    def add_correction(self, force: NDArray[np.floating], correction: NDArray[np.floating]) -> None:
        """Add the smooth displacement that balances ``force`` to ``correction``, both (3, N)."""
        _correct(
            self._inverse,
            self._node,
            self._start,
            self._corner,
            self._weight,
            self._across,
            self._room,
            self._touched_corner,
            self._touched_weight,
            self._normal,
            self._response,
            self._factor,
            self._coarse[0],
            self._coarse[1],
            force,
            correction,
        )

    def _invert(
        self, count: int, product: Callable[[NDArray[np.floating]], NDArray[np.floating]]
    ) -> NDArray[np.float64]:
        matrix = np.empty((self.size, self.size))
        unit, field = np.zeros(self.size), np.zeros((3, count))
        across, room = np.ascontiguousarray(self._weight.T), np.empty((3, len(self._node)))
        for i in range(self.size):
            unit[i] = 1.0
            field[:] = 0.0
            _prolong(unit, self._node, self._start, self._corner, across, room, field)
            unit[i] = 0.0
            response = product(field).astype(np.float64)
            _restrict(response, self._node, self._start, self._corner, self._weight, matrix[i])
        matrix = (matrix + matrix.T) / 2
        scale = 1.0 / np.sqrt(np.diag(matrix))
        # SciPy's would hold the interpreter's lock for a second, and with it frames beside this.
        values, vectors = np.linalg.eigh(scale[:, None] * matrix * scale)
        kept = values > _INDEPENDENT * (values[-1] if len(values) else 0.0)
        vectors = scale[:, None] * vectors[:, kept] / np.sqrt(values[kept])
        return np.ascontiguousarray(vectors @ vectors.T)


def _interpolation(
    nodes: NDArray[np.float64], free: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Grid cell (N,), grid nodes (N, 8) numbered without unused ones, and weights (N, 8)."""
    low, extent = nodes.min(axis=0), np.ptp(nodes, axis=0)
    wanted = max(min(_MOST_NODES, len(nodes) // _SPARSEST), 8)
    spacing = extent.max()
    while np.prod(np.ceil(extent / (0.97 * spacing)) + 1) <= wanted:
        spacing *= 0.97
    shape = np.maximum(np.round(extent / spacing), 1).astype(np.int64)
    scaled = (nodes - low) / extent * shape
    base = np.clip(np.floor(scaled + 1e-9).astype(np.int64), 0, shape - 1)
    part = scaled - base
    part[np.abs(part) < 1e-9] = 0.0
    cell = np.ravel_multi_index(tuple(base.T), tuple(shape))
    corner = np.empty((len(nodes), 8), np.int64)
    weight = np.empty((len(nodes), 8))
    for i in range(8):
        step = np.array([i >> 2 & 1, i >> 1 & 1, i & 1])
        corner[:, i] = np.ravel_multi_index(tuple((base + step).T), tuple(shape + 1))
        weight[:, i] = np.where(step == 1, part, 1 - part).prod(axis=1)
    used = np.zeros(int(np.prod(shape + 1)))
    np.add.at(used, corner[free], weight[free] ** 2)
    # A grid node hardly felt by any node of the mesh gives the system nothing but rounding.
    number = np.where(used > 1e-3, np.cumsum(used > 1e-3) - 1, -1)
    weight[number[corner] < 0] = 0.0
    return cell, np.maximum(number[corner], 0), weight


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _restrict(field, node, start, corner, weight, coarse):
    """coarse (3G,) = P' field (3, N)."""
    coarse[:] = 0
    sums = np.empty((3, 8), field.dtype)
    x, y, z = field[0], field[1], field[2]
    for c in range(len(corner)):
        sums[:] = 0
        first, end = start[c], start[c + 1]
        pairs = first + (end - first) // 2 * 2
        for k in range(first, pairs, 2):  # two at a time, lest each wait for the sums of the last
            i, j = node[k], node[k + 1]
            w, v = weight[k], weight[k + 1]
            xi, yi, zi = x[i], y[i], z[i]
            xj, yj, zj = x[j], y[j], z[j]
            for q in range(8):
                sums[0, q] += w[q] * xi + v[q] * xj
                sums[1, q] += w[q] * yi + v[q] * yj
                sums[2, q] += w[q] * zi + v[q] * zj
        for k in range(pairs, end):
            i = node[k]
            w = weight[k]
            xi, yi, zi = x[i], y[i], z[i]
            for q in range(8):
                sums[0, q] += w[q] * xi
                sums[1, q] += w[q] * yi
                sums[2, q] += w[q] * zi
        for q in range(8):
            g = 3 * corner[c, q]
            for d in range(3):
                coarse[g + d] += sums[d, q]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _prolong(coarse, node, start, corner, across, room, field):
    """field (3, N) += P coarse (3G,); across (8, F) are P's weights, room (3, F) is for sums."""
    for c in range(len(corner)):
        near = corner[c]
        first, end = start[c], start[c + 1]
        for d in range(3):
            v0 = coarse[3 * near[0] + d]
            v1 = coarse[3 * near[1] + d]
            v2 = coarse[3 * near[2] + d]
            v3 = coarse[3 * near[3] + d]
            v4 = coarse[3 * near[4] + d]
            v5 = coarse[3 * near[5] + d]
            v6 = coarse[3 * near[6] + d]
            v7 = coarse[3 * near[7] + d]
            w0, w1 = across[0, first:end], across[1, first:end]
            w2, w3 = across[2, first:end], across[3, first:end]
            w4, w5 = across[4, first:end], across[5, first:end]
            w6, w7 = across[6, first:end], across[7, first:end]
            total = room[d, first:end]
            for k in range(end - first):
                value = (w0[k] * v0 + w1[k] * v1) + (w2[k] * v2 + w3[k] * v3)
                value += (w4[k] * v4 + w5[k] * v5) + (w6[k] * v6 + w7[k] * v7)
                total[k] = value
    for d in range(3):
        values, total = field[d], room[d]
        for k in range(len(node)):
            values[node[k]] += total[k]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _respond(inverse, corner, weight, normal, softness, response, factor):
    """The grid's responses (K, 3G) to unit normal forces, and the Cholesky factor of theirs."""
    count = len(corner)
    for k in range(count):
        row = response[k]
        row[:] = 0
        for q in range(8):
            if weight[k, q] != 0:
                for d in range(3):
                    s = weight[k, q] * normal[k, d]
                    r = inverse[3 * corner[k, q] + d]
                    for j in range(len(row)):
                        row[j] += s * r[j]
    for k in range(count):
        row = response[k]
        for m in range(k + 1):
            total = 0.0
            for q in range(8):
                g = 3 * corner[m, q]
                for d in range(3):
                    total += weight[m, q] * normal[m, d] * row[g + d]
            factor[k, m] = total
        factor[k, k] += softness[k]
    for k in range(count):
        for m in range(k + 1):
            total = factor[k, m]
            for j in range(m):
                total -= factor[k, j] * factor[m, j]
            factor[k, m] = np.sqrt(total) if k == m else total / factor[m, m]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _correct(
    inverse,
    node,
    start,
    corner,
    weight,
    across,
    room,
    touched_corner,
    touched_weight,
    normal,
    response,
    factor,
    right,
    solution,
    force,
    correction,
):
    """correction (3, N) += the constrained grid's answer to force (3, N)."""
    _restrict(force, node, start, corner, weight, right)
    solution[:] = 0
    size = len(right)
    whole = size // 4 * 4
    for i in range(0, whole, 4):  # the matrix is symmetric: rows are columns
        a = right[i]
        b = right[i + 1]
        c = right[i + 2]
        d = right[i + 3]
        ra = inverse[i]
        rb = inverse[i + 1]
        rc = inverse[i + 2]
        rd = inverse[i + 3]
        for j in range(size):
            solution[j] += (a * ra[j] + b * rb[j]) + (c * rc[j] + d * rd[j])
    for i in range(whole, size):
        a = right[i]
        ra = inverse[i]
        for j in range(size):
            solution[j] += a * ra[j]
    count = len(touched_corner)
    push = np.empty(count)
    for k in range(count):
        total = 0.0
        for q in range(8):
            g = 3 * touched_corner[k, q]
            for d in range(3):
                total += touched_weight[k, q] * normal[k, d] * solution[g + d]
        for j in range(k):
            total -= factor[k, j] * push[j]
        push[k] = total / factor[k, k]
    for k in range(count - 1, -1, -1):
        total = push[k]
        for j in range(k + 1, count):
            total -= factor[j, k] * push[j]
        push[k] = total / factor[k, k]
    for k in range(count):
        s = inverse.dtype.type(push[k])
        row = response[k]
        for j in range(size):
            solution[j] -= s * row[j]
    _prolong(solution, node, start, corner, across, room, correction)
