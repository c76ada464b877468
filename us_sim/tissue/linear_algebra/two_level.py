"""Conjugate gradients for tissue on springs, with a two-level additive Schwarz preconditioner.

The matrix is a stiffness and springs that are both only known by their products. Conjugate
gradients with a local preconditioner carry a force one layer of nodes an iteration. So the
preconditioner adds up the answers of each node by itself, its springs included, and of a coarse
grid, on which the smooth part is solved for directly: some hundred nodes of a regular grid
around the mesh, between which displacements are trilinear (B. Smith, P. Bjorstad and W. Gropp,
Domain Decomposition, 1996, section 2.1). The grid need not follow the mesh, which may be of any
kind. Fields are (3, N).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh

# Most nodes of a grid around the bounding box: a dense product of 1,200 unknowns takes 0.2 ms.
_MOST_NODES = 400
# Fewest nodes of the mesh for each node of the grid: with fewer there is nothing to gain.
_SPARSEST = 8
# Combinations of grid functions softer than this fraction of the stiffest count as dependent.
_INDEPENDENT = 1e-7
# Stiffness of the grid's constraint at a touched node, over the node's own. The constraint need
# not be exact, as the local preconditioner does the rest.
_YIELD = 3.0


class CoarseGrid:
    """Applies P (P' K P)^-1 P' with P the trilinear interpolation from the grid to the mesh.

    Touched nodes are kept from moving along their normals by a correction of low rank (M. A.
    Woodbury, Inverting modified matrices, 1950).

    Args:
        mesh: of the tissue.
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
        self.set_contacts(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0))

    def set_contacts(
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
            *(self._inverse, self._touched_corner, self._touched_weight, self._normal),
            *(1.0 / (_YIELD * stiffness), self._response, self._factor),
        )

    def add_correction(self, force: NDArray[np.floating], correction: NDArray[np.floating]) -> None:
        """Add the smooth displacement that balances ``force`` to ``correction``, both (3, N)."""
        _correct(
            *(self._inverse, self._node, self._start, self._corner, self._weight, self._across),
            *(self._room, self._touched_corner, self._touched_weight, self._normal),
            *(self._response, self._factor, *self._coarse, force, correction),
        )

    def _invert(self, count: int, product: Callable[[NDArray], NDArray]) -> NDArray:
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


def _interpolation(nodes: NDArray, free: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Return grid cells (N,), grid nodes (N, 8) numbered without gaps, and weights (N, 8)."""
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
    """Set coarse (3G,) to P' field (3, N)."""
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
    """Add P coarse (3G,) to field (3, N); across (8, F) are P's weights, room (3, F) for sums."""
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
    """Fill the grid's responses (K, 3G) to unit normal forces, and a Cholesky factor (K, K).

    The factor is of the responses along the normals, raised by softness (K,).
    """
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
        for m in range(k + 1):
            factor[k, m] = _move_along(corner[m], weight[m], normal[m], response[k])
        factor[k, k] += softness[k]
    _factorise(factor)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _factorise(matrix):
    """Overwrite the lower triangle of a matrix (K, K) with its Cholesky factor."""
    for k in range(len(matrix)):
        for m in range(k + 1):
            total = matrix[k, m]
            for j in range(m):
                total -= matrix[k, j] * matrix[m, j]
            matrix[k, m] = np.sqrt(total) if k == m else total / matrix[m, m]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _correct(  # noqa: PLR0913
    inverse, node, start, corner, weight, across, room, touched_corner, touched_weight, normal,
    response, factor, right, solution, force, correction,
):  # fmt: skip
    """Add the constrained grid's answer to force (3, N) to correction (3, N)."""
    _restrict(force, node, start, corner, weight, right)
    _multiply(inverse, right, solution)
    count = len(touched_corner)
    push = np.empty(count)
    for k in range(count):
        push[k] = _move_along(touched_corner[k], touched_weight[k], normal[k], solution)
    _solve_factored(factor, push)
    for k in range(count):
        s = inverse.dtype.type(push[k])
        row = response[k]
        for j in range(len(right)):
            solution[j] -= s * row[j]
    _prolong(solution, node, start, corner, across, room, correction)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _move_along(corner, weight, normal, coarse):
    """Return the movement along normal (3,) of a node with weights (8,) at grid nodes (8,)."""
    total = 0.0
    for q in range(8):
        g = 3 * corner[q]
        for d in range(3):
            total += weight[q] * normal[d] * coarse[g + d]
    return total


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _multiply(inverse, right, solution):
    """Set solution (3G,) to the symmetric inverse (3G, 3G) times right (3G,)."""
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


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _solve_factored(factor, push):
    """Overwrite push (K,) with the solution for it by a Cholesky factor (K, K)."""
    count = len(push)
    for k in range(count):
        total = push[k]
        for j in range(k):
            total -= factor[k, j] * push[j]
        push[k] = total / factor[k, k]
    for k in range(count - 1, -1, -1):
        total = push[k]
        for j in range(k + 1, count):
            total -= factor[j, k] * push[j]
        push[k] = total / factor[k, k]


Product = Callable[[NDArray[np.floating], NDArray[np.floating]], Any]
_POWER = 20  # Power iterations towards an eigenvalue
_LOOP: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": True}


@dataclass(frozen=True, eq=False)
class CgSolution:
    """Result of `solve_conjugate_gradients`."""

    solution: NDArray[np.floating]  # (3, N)
    image: NDArray[np.floating]  # (3, N), the product without springs of the solution
    direction: NDArray[np.floating]  # (3, N), the last search direction
    iterations: int
    curved: bool  # whether the last direction had no positive curvature, and was not followed


class Preconditioner(Protocol):
    """An approximate inverse of a stiffness with springs."""

    fixed: NDArray[np.integer]

    def apply(self, residual: NDArray[np.floating], out: NDArray[np.floating]) -> None:
        """Overwrite ``out`` with the preconditioner times ``residual``."""


class TwoLevel:
    """The preconditioner.

    Args:
        grid: the coarse level, or None.
        fixed: nodes that do not move.
        local_weight: of the local level; the coarse one has weight 1.
    """

    def __init__(
        self, grid: CoarseGrid | None, fixed: NDArray[np.integer], local_weight: float
    ) -> None:
        self._grid = grid
        self.fixed = fixed
        self._weight = local_weight

    def set_matrix(
        self,
        blocks: NDArray[np.floating],
        nodes: NDArray[np.integer],
        normals: NDArray[np.float64],
        stiffness: NDArray[np.float64],
    ) -> None:
        """Set the blocks of the stiffness, and the springs.

        Args:
            blocks: (6, N) N/m, xx, xy, xz, yy, yz, zz of each node's block of the stiffness.
            nodes: (K,), where there are springs, all of one node in a row.
            normals: (K, 3), their directions.
            stiffness: (K,) N/m.
        """
        dtype = blocks.dtype
        nodes = np.asarray(nodes, dtype=np.int64)  # always, lest numba compile kernels twice
        own = np.empty(len(nodes))
        self._inverse = np.empty_like(blocks)
        _invert_blocks(
            blocks,
            self._weight,
            self.fixed,
            nodes,
            normals.astype(dtype),
            stiffness.astype(dtype),
            own,
            self._inverse,
        )
        if self._grid is not None:
            # A spring softer than the tissue does not keep it from moving.
            self._grid.set_contacts(nodes, normals, np.minimum(own, stiffness))

    def apply(self, residual: NDArray[np.floating], out: NDArray[np.floating]) -> None:
        """Overwrite ``out`` with the preconditioner times ``residual``."""
        _apply_blocks(self._inverse, residual, out)
        if self._grid is not None:
            self._grid.add_correction(residual, out)


def solve_conjugate_gradients(
    product: Product,
    preconditioner: Preconditioner,
    residual: NDArray[np.floating],
    iterations: int,
    tolerance: float,
    add_springs: Product | None = None,
) -> CgSolution:
    """Solve for a displacement that balances ``residual``, starting from none.

    Args:
        product: writes the stiffness, without springs, times its first argument into the second.
        preconditioner: of the stiffness with springs.
        residual: (3, N), zero at fixed nodes; overwritten with the remaining one.
        iterations: the most products.
        tolerance: norm of the residual at which to end.
        add_springs: adds the springs' forces for its first argument to the second.
    """
    shape, dtype = residual.shape, residual.dtype
    solution, image, search = np.zeros((3, *shape), dtype)
    elastic, conditioned, whole = np.empty((3, *shape), dtype)
    fixed = preconditioner.fixed
    slope = 0.0
    for iteration in range(iterations):
        preconditioner.apply(residual, conditioned)
        slope = _turn(residual, conditioned, slope, search)
        product(search, elastic)
        _copy(elastic, whole)
        if add_springs is not None:
            add_springs(search, whole)
        curvature = _curvature(search, whole, fixed)
        if not curvature > 0.0:
            return CgSolution(solution, image, search, iteration + 1, True)
        left = _advance(slope / curvature, search, elastic, whole, solution, image, residual)
        if left <= tolerance * tolerance:
            return CgSolution(solution, image, search, iteration + 1, False)
    return CgSolution(solution, image, search, iterations, False)


def largest_local_eigenvalue(
    blocks: NDArray[np.floating], product: Product, fixed: NDArray[np.integer]
) -> float:
    """Return the largest eigenvalue of a stiffness preconditioned by its blocks (6, N) N/m."""
    local = TwoLevel(None, fixed, 1.0)
    local.set_matrix(blocks, np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0))
    vector = np.random.default_rng(0).standard_normal((3, blocks.shape[1]))
    image = np.empty_like(vector)
    largest = 0.0
    for _ in range(_POWER):
        vector[:, fixed] = 0.0
        largest = float(np.linalg.norm(vector))
        if largest == 0.0:
            return 1.0
        product(vector / largest, image)
        image[:, fixed] = 0.0
        local.apply(image, vector)
    return largest


@njit(**_LOOP)
def _invert_blocks(blocks, scale, fixed, nodes, normals, springs, own, inverse):
    """Invert each block with its springs, times scale; fill own (K,) with n' D n of the blocks."""
    for i in range(blocks.shape[1]):
        _invert(blocks[:, i], scale, inverse[:, i])
    one = np.empty(6, blocks.dtype)
    for k in range(len(nodes)):
        i = nodes[k]
        x = normals[k, 0]
        y = normals[k, 1]
        z = normals[k, 2]
        if k == 0 or nodes[k - 1] != i:
            for entry in range(6):
                one[entry] = blocks[entry, i]
        own[k] = (
            blocks[0, i] * x * x
            + blocks[3, i] * y * y
            + blocks[5, i] * z * z
            + 2 * (blocks[1, i] * x * y + blocks[2, i] * x * z + blocks[4, i] * y * z)
        )
        s = springs[k]
        one[0] += s * x * x
        one[1] += s * x * y
        one[2] += s * x * z
        one[3] += s * y * y
        one[4] += s * y * z
        one[5] += s * z * z
        _invert(one, scale, inverse[:, i])
    for k in range(len(fixed)):
        inverse[:, fixed[k]] = 0


@njit(**_LOOP, inline="always")
def _invert(block, scale, out):
    a, b, c, d, e, f = block
    p = d * f - e * e
    q = c * e - b * f
    r = b * e - c * d
    s = scale / (a * p + b * q + c * r)
    out[0] = s * p
    out[1] = s * q
    out[2] = s * r
    out[3] = s * (a * f - c * c)
    out[4] = s * (b * c - a * e)
    out[5] = s * (a * d - b * b)


@njit(**_LOOP)
def _apply_blocks(blocks, field, out):
    for i in range(field.shape[1]):
        x = field[0, i]
        y = field[1, i]
        z = field[2, i]
        out[0, i] = blocks[0, i] * x + blocks[1, i] * y + blocks[2, i] * z
        out[1, i] = blocks[1, i] * x + blocks[3, i] * y + blocks[4, i] * z
        out[2, i] = blocks[2, i] * x + blocks[4, i] * y + blocks[5, i] * z


@njit(**_LOOP)
def add_blocks(blocks, scale, field, out):
    """Add scale times symmetric 3x3 blocks (6, N) times a field (3, N) to ``out``."""
    s = field.dtype.type(scale)
    for i in range(field.shape[1]):
        x = s * field[0, i]
        y = s * field[1, i]
        z = s * field[2, i]
        out[0, i] += blocks[0, i] * x + blocks[1, i] * y + blocks[2, i] * z
        out[1, i] += blocks[1, i] * x + blocks[3, i] * y + blocks[4, i] * z
        out[2, i] += blocks[2, i] * x + blocks[4, i] * y + blocks[5, i] * z


@njit(**_LOOP)
def _copy(field, out):
    for d in range(3):
        a = field[d]
        b = out[d]
        for i in range(len(a)):
            b[i] = a[i]


@njit(**_LOOP)
def clear_nodes(field, nodes):
    """Set a field (3, N) to zero at nodes (K,)."""
    for d in range(3):
        for k in range(len(nodes)):
            field[d, nodes[k]] = 0


@njit(**_LOOP)
def _dot(a, b):
    total = 0.0
    for d in range(3):
        x = a[d]
        y = b[d]
        part = a.dtype.type(0)
        for i in range(len(x)):
            part += x[i] * y[i]
        total += part
    return total


@njit(**_LOOP)
def _turn(residual, conditioned, before, search):
    """Update the search direction from the preconditioned residual; return r . z.

    ``before`` is the last step's r . z, or zero in the first.
    """
    slope = _dot(residual, conditioned)
    s = search.dtype.type(slope / before if before != 0.0 else 0.0)
    for d in range(3):
        z = conditioned[d]
        p = search[d]
        for i in range(len(z)):
            p[i] = z[i] + s * p[i]
    return slope


@njit(**_LOOP)
def _curvature(search, whole, fixed):
    """Return the product along the search direction, with the fixed nodes' rows left out."""
    clear_nodes(whole, fixed)
    return _dot(search, whole)


@njit(**_LOOP)
def _advance(length, search, elastic, whole, solution, image, residual):
    """Take a step along the search direction; return the squared residual norm."""
    s = search.dtype.type(length)
    total = 0.0
    for d in range(3):
        p = search[d]
        e = elastic[d]
        q = whole[d]
        x = solution[d]
        y = image[d]
        r = residual[d]
        part = search.dtype.type(0)
        for i in range(len(p)):
            x[i] += s * p[i]
            y[i] += s * e[i]
            r[i] -= s * q[i]
            part += r[i] * r[i]
        total += part
    return total
