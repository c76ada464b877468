"""Conjugate gradients for tissue on springs, with a local and a coarse preconditioner.

The matrix is a stiffness and springs that are both only known by their products. The preconditioner
knows springs that are nearly these, each at one node: it adds up the answers of each node by
itself, its springs included, and of a coarse grid (additive Schwarz; B. Smith, P. Bjorstad and W.
Gropp, Domain Decomposition, 1996, section 2.1). Fields are (3, N).

>>> import numpy as np
>>> from us_sim.tissue.linear_algebra.two_level import TwoLevel, conjugate_gradients
>>> blocks = np.outer([2.0, 0.0, 0.0, 2.0, 0.0, 2.0], np.ones(3))
>>> two_level = TwoLevel(None, fixed=np.array([2]), local_weight=1.0)
>>> two_level.prepare(blocks, np.array([0]), np.array([[0.0, 0, 1]]), np.array([8.0]))
>>> def double(field, image):
...     np.multiply(field, 2.0, out=image)
>>> def spring(field, image):
...     image[2, 0] += 8.0 * field[2, 0]
>>> force = np.array([[0.0, 4.0, 0.0], [0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
>>> solved = conjugate_gradients(double, two_level, force, 5, 1e-9, spring)
>>> solved.iterations, solved.solution[:, 0], solved.solution[:, 1]
(1, array([0., 0., 1.]), array([2., 0., 0.]))
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit
from us_sim.tissue.linear_algebra.coarse_grid import CoarseGrid

Product = Callable[[NDArray[np.floating], NDArray[np.floating]], Any]

_POWER = 20
"""Power iterations towards an eigenvalue."""

_LOOP: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": True}


@dataclass(frozen=True, eq=False)
class Solved:
    """What conjugate gradients found."""

    solution: NDArray[np.floating]  # (3, N)
    image: NDArray[np.floating]  # (3, N), the product without springs of the solution
    direction: NDArray[np.floating]  # (3, N), the last search direction
    iterations: int
    curved: bool  # whether that was one of negative curvature; the solution is what came before


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

    def prepare(
        self,
        blocks: NDArray[np.floating],
        nodes: NDArray[np.integer],
        normals: NDArray[np.float64],
        stiffness: NDArray[np.float64],
    ) -> None:
        """Set the matrix.

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
            self._grid.touch(nodes, normals, np.minimum(own, stiffness))

    def apply(self, residual: NDArray[np.floating], out: NDArray[np.floating]) -> None:
        """Overwrite ``out`` with the preconditioner times ``residual``."""
        _apply_blocks(self._inverse, residual, out)
        if self._grid is not None:
            self._grid.add_correction(residual, out)


def conjugate_gradients(
    product: Product,
    preconditioner: Preconditioner,
    residual: NDArray[np.floating],
    iterations: int,
    tolerance: float,
    add_springs: Product | None = None,
) -> Solved:
    """Solve for a displacement that balances ``residual``, starting from none.

    Args:
        product: writes the stiffness, without springs, times its first argument into the second.
        preconditioner: prepared.
        residual: (3, N), zero at fixed nodes; overwritten with what is left.
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
            return Solved(solution, image, search, iteration + 1, True)
        left = _advance(slope / curvature, search, elastic, whole, solution, image, residual)
        if left <= tolerance * tolerance:
            return Solved(solution, image, search, iteration + 1, False)
    return Solved(solution, image, search, iterations, False)


def largest_local_eigenvalue(
    blocks: NDArray[np.floating], product: Product, fixed: NDArray[np.integer]
) -> float:
    """The largest of a stiffness without springs, preconditioned by its blocks (6, N) N/m alone."""
    local = TwoLevel(None, fixed, 1.0)
    local.prepare(blocks, np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0))
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
    """Inverse of each block with its springs, times scale; fills own (K,), n' D n of the blocks."""
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
    """Turn the search to what is left, conditioned; returns the slope along that.

    It was ``before`` along the search before; without one, that is zero.
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
    """The product along the search direction, with the fixed nodes' rows left out."""
    clear_nodes(whole, fixed)
    return _dot(search, whole)


@njit(**_LOOP)
def _advance(length, search, elastic, whole, solution, image, residual):
    """One step along the search direction; returns the square of the residual that is left."""
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
