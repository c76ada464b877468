"""Conjugate gradients for a large-deformation step, with touched nodes held on the probe.

The search stays among displacements in which fixed nodes do not move and touched ones not along
their normals (D. Baraff and A. Witkin, Large Steps in Cloth Simulation, SIGGRAPH 1998, section 5).

>>> import numpy as np
>>> from us_sim.tissue.linear_algebra.projected_conjugate_gradients import Constraints, project
>>> constraints = Constraints(np.array([0]), np.array([1]), np.array([[0.0, 0.0, 1.0]]))
>>> field = np.ones((3, 3))
>>> project(field, constraints)
>>> field
array([[0., 1., 1.],
       [0., 1., 1.],
       [0., 0., 1.]])
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = [
    "Constraints",
    "apply_blocks",
    "inverse_blocks",
    "project",
    "projected_conjugate_gradients",
]

Product = Callable[[NDArray[np.floating], NDArray[np.floating]], None]


@dataclass(frozen=True, eq=False)
class Constraints:
    """The constraints of fixed and of touched nodes."""

    fixed: NDArray[np.integer]  # (F,), nodes that do not move at all
    touched: NDArray[np.integer]  # (K,), nodes that move along the probe's surface only
    normal: NDArray[np.floating]  # (K, 3), unit, of that surface


def project(field: NDArray[np.floating], constraints: Constraints) -> None:
    """Take out of a field (3, N) what the constraints forbid."""
    _project(field, constraints.fixed, constraints.touched, constraints.normal)


def inverse_blocks(
    blocks: NDArray[np.floating], scale: float, constraints: Constraints
) -> NDArray[np.floating]:
    """(6, N): ``scale`` times the inverses of symmetric 3x3 blocks, restricted to the constraints.

    Args:
        blocks: (6, N), positive definite, as xx, xy, xz, yy, yz, zz.
        scale: a factor.
        constraints: along a normal, and at fixed nodes, the result is zero.
    """
    inverse = np.empty_like(blocks)
    _invert_blocks(
        blocks, scale, constraints.fixed, constraints.touched, constraints.normal, inverse
    )
    return inverse


def apply_blocks(blocks: NDArray[np.floating], field: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, N): symmetric 3x3 blocks (6, N) times a field (3, N)."""
    out = np.empty_like(field)
    _apply_blocks(blocks, field, out)
    return out


def projected_conjugate_gradients(
    product: Product,
    blocks: NDArray[np.floating],
    add_coarse: Product,
    constraints: Constraints,
    residual: NDArray[np.floating],
    solution: NDArray[np.floating],
    iterations: int,
    tolerance: float,
) -> tuple[int, bool]:
    """Solve for a displacement that balances ``residual``, starting from none.

    Args:
        product: writes the tangent stiffness times its first argument into the second.
        blocks: (6, N), the local preconditioner, see `inverse_blocks`.
        add_coarse: adds the coarse preconditioner times its first argument to the second.
        constraints: what may not move.
        residual: (3, N), within the constraints; overwritten with what is left.
        solution: (3, N), overwritten.
        iterations: the most products.
        tolerance: ends when the preconditioned residual's norm has fallen to this fraction.

    Returns:
        How many products were used, and whether a direction of negative curvature was met: then the
        solution is the one before it, or, if it was the first direction, that direction.
    """
    search, image, conditioned = (np.zeros_like(residual) for _ in range(3))
    solution[:] = 0.0
    fixed, touched, normal = constraints.fixed, constraints.touched, constraints.normal
    slope = first = 0.0
    for iteration in range(iterations):
        _apply_blocks(blocks, residual, conditioned)
        add_coarse(residual, conditioned)
        _project(conditioned, fixed, touched, normal)
        before, slope = slope, _dot(residual, conditioned)
        if iteration == 0:
            first = slope
        if not slope > tolerance * tolerance * first:
            return iteration, False
        _renew(conditioned, slope / before if iteration else 0.0, search)
        product(search, image)
        _project(image, fixed, touched, normal)
        curvature = _dot(search, image)
        if not curvature > 0.0:
            if iteration == 0:
                solution[:] = search
            return iteration + 1, True
        _advance(slope / curvature, search, image, solution, residual)
    return iterations, False


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _project(field, fixed, touched, normal):
    for k in range(len(fixed)):
        for d in range(3):
            field[d, fixed[k]] = 0
    for k in range(len(touched)):
        i = touched[k]
        s = field[0, i] * normal[k, 0] + field[1, i] * normal[k, 1] + field[2, i] * normal[k, 2]
        for d in range(3):
            field[d, i] -= s * normal[k, d]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _invert_blocks(blocks, scale, fixed, touched, normal, inverse):
    for i in range(blocks.shape[1]):
        a = blocks[0, i]
        b = blocks[1, i]
        c = blocks[2, i]
        d = blocks[3, i]
        e = blocks[4, i]
        f = blocks[5, i]
        p = d * f - e * e
        q = c * e - b * f
        r = b * e - c * d
        s = scale / (a * p + b * q + c * r)
        inverse[0, i] = s * p
        inverse[1, i] = s * q
        inverse[2, i] = s * r
        inverse[3, i] = s * (a * f - c * c)
        inverse[4, i] = s * (b * c - a * e)
        inverse[5, i] = s * (a * d - b * b)
    for k in range(len(touched)):
        i = touched[k]
        x = normal[k, 0]
        y = normal[k, 1]
        z = normal[k, 2]
        u = inverse[0, i] * x + inverse[1, i] * y + inverse[2, i] * z
        v = inverse[1, i] * x + inverse[3, i] * y + inverse[4, i] * z
        w = inverse[2, i] * x + inverse[4, i] * y + inverse[5, i] * z
        s = 1 / (x * u + y * v + z * w)
        inverse[0, i] -= s * u * u
        inverse[1, i] -= s * u * v
        inverse[2, i] -= s * u * w
        inverse[3, i] -= s * v * v
        inverse[4, i] -= s * v * w
        inverse[5, i] -= s * w * w
    for k in range(len(fixed)):
        for j in range(6):
            inverse[j, fixed[k]] = 0


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _apply_blocks(blocks, field, out):
    for i in range(field.shape[1]):
        x = field[0, i]
        y = field[1, i]
        z = field[2, i]
        out[0, i] = blocks[0, i] * x + blocks[1, i] * y + blocks[2, i] * z
        out[1, i] = blocks[1, i] * x + blocks[3, i] * y + blocks[4, i] * z
        out[2, i] = blocks[2, i] * x + blocks[4, i] * y + blocks[5, i] * z


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
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


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _renew(conditioned, beta, search):
    s = search.dtype.type(beta)
    for d in range(3):
        z = conditioned[d]
        p = search[d]
        for i in range(len(z)):
            p[i] = z[i] + s * p[i]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=True)
def _advance(length, search, image, solution, residual):
    s = search.dtype.type(length)
    for d in range(3):
        p = search[d]
        q = image[d]
        x = solution[d]
        r = residual[d]
        for i in range(len(p)):
            x[i] += s * p[i]
            r[i] -= s * q[i]
