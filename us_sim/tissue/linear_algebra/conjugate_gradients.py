"""Preconditioned conjugate gradients on 3x3 blocks, with some nodes confined to planes."""

from __future__ import annotations

import math

import numpy as np

from us_sim.kernels import njit


@njit(cache=True, nogil=True, error_model="numpy")
def product_rows(start, columns, blocks, vector, rows):
    """Return (len(rows), 3), those block rows of the matrix times vector (N, 3)."""
    product = np.empty((len(rows), 3))
    for k in range(len(rows)):
        x = y = z = 0.0
        for b in range(start[rows[k]], start[rows[k] + 1]):
            v0 = vector[columns[b], 0]
            v1 = vector[columns[b], 1]
            v2 = vector[columns[b], 2]
            x += blocks[b, 0, 0] * v0 + blocks[b, 0, 1] * v1 + blocks[b, 0, 2] * v2
            y += blocks[b, 1, 0] * v0 + blocks[b, 1, 1] * v1 + blocks[b, 1, 2] * v2
            z += blocks[b, 2, 0] * v0 + blocks[b, 2, 1] * v1 + blocks[b, 2, 2] * v2
        product[k, 0] = x
        product[k, 1] = y
        product[k, 2] = z
    return product


@njit(cache=True, nogil=True, error_model="numpy")
def _project(vector, touched, normal):
    """Take the component along normal (T, 3) out of vector (N, 3) at the touched (T,) nodes."""
    for t in range(len(touched)):
        i = touched[t]
        along = (
            vector[i, 0] * normal[t, 0] + vector[i, 1] * normal[t, 1] + vector[i, 2] * normal[t, 2]
        )
        for axis in range(3):
            vector[i, axis] -= along * normal[t, axis]


@njit(cache=True, nogil=True, error_model="numpy")
def _multiply(start, columns, blocks, vector, product):
    """Fill product (N, 3) with the matrix in 3x3 blocks times vector; return vector . product."""
    energy = 0.0
    for i in range(len(vector)):
        x = y = z = 0.0
        for b in range(start[i], start[i + 1]):
            j = columns[b]
            v0 = vector[j, 0]
            v1 = vector[j, 1]
            v2 = vector[j, 2]
            x += blocks[b, 0, 0] * v0 + blocks[b, 0, 1] * v1 + blocks[b, 0, 2] * v2
            y += blocks[b, 1, 0] * v0 + blocks[b, 1, 1] * v1 + blocks[b, 1, 2] * v2
            z += blocks[b, 2, 0] * v0 + blocks[b, 2, 1] * v1 + blocks[b, 2, 2] * v2
        product[i, 0] = x
        product[i, 1] = y
        product[i, 2] = z
        energy += x * vector[i, 0] + y * vector[i, 1] + z * vector[i, 2]
    return energy


@njit(cache=True, nogil=True, error_model="numpy")
def _precondition(preconditioner, residual, scaled):
    """Fill scaled with preconditioner (N, 3, 3) times residual (N, 3); return r.z and r.r."""
    slope = 0.0
    square = 0.0
    for i in range(len(residual)):
        x = residual[i, 0]
        y = residual[i, 1]
        z = residual[i, 2]
        m = preconditioner[i]
        a = m[0, 0] * x + m[0, 1] * y + m[0, 2] * z
        b = m[1, 0] * x + m[1, 1] * y + m[1, 2] * z
        c = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z
        scaled[i, 0] = a
        scaled[i, 1] = b
        scaled[i, 2] = c
        slope += a * x + b * y + c * z
        square += x * x + y * y + z * z
    return slope, square


@njit(cache=True, nogil=True, error_model="numpy")
def run_conjugate_gradients(  # noqa: PLR0913
    start, columns, blocks, preconditioner, touched, normal, displacement, residual, direction,
    product, slope, norm, iterations, target,
):  # fmt: skip
    """Improve displacement (N, 3) by at most ``iterations``, until |residual| <= target.

    Goes on with residual and direction when ``slope`` is positive, begins anew when it is negative,
    and does nothing when it is 0; ``norm`` is then |residual|.

    Returns:
        The slope to go on with (0 when converged), and |residual| before and after.
    """
    if slope < 0.0:
        _multiply(start, columns, blocks, displacement, residual)
        residual[:] = -residual
        _project(residual, touched, normal)
        slope, square = _precondition(preconditioner, residual, direction)
        norm = math.sqrt(square)
    before = norm
    if norm <= target or slope == 0.0:
        return 0.0, before, norm
    for _ in range(iterations):
        energy = _multiply(start, columns, blocks, direction, product)
        if not energy > 0.0:
            return -1.0, before, norm
        _project(product, touched, normal)
        _advance(slope / energy, direction, product, displacement, residual)
        last = slope
        slope, square = _precondition(preconditioner, residual, product)
        norm = math.sqrt(square)
        if norm <= target:
            return 0.0, before, norm
        turn = slope / last
        for i in range(len(direction)):
            for axis in range(3):
                direction[i, axis] = product[i, axis] + turn * direction[i, axis]
    return slope, before, norm


@njit(cache=True, nogil=True, error_model="numpy")
def _advance(step, direction, product, displacement, residual):
    """Move the displacement by step times direction; update the residual by its product."""
    for i in range(len(displacement)):
        for axis in range(3):
            displacement[i, axis] += step * direction[i, axis]
            residual[i, axis] -= step * product[i, axis]
