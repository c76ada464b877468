"""Corners of a chessboard's squares, fitted to the pixels along the edges that cross there.

>>> import numpy as np
>>> from us_sim.tracking.camera.chessboard_corners import refined_crossing
>>> image = np.full((60, 60), 20, np.uint8)
>>> image[:30, 30:] = image[30:, :30] = 200
>>> refined_crossing(image, np.array([31.0, 28.5]), np.eye(2), side=20.0, gap=5.0).round(2)
array([29.5, 29.5])
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit
from us_sim.tracking.camera.definite_system import solve_definite

_STEPS = 12
_STEADY = 2e-3  # pixels
_SLOPE = 0.851  # of the hyperbolic tangent that is nearest to the normal integral
_ARM = 0.45  # of a square: how far the edges are followed
_NEAR = 0.8  # of the white between a square's edge and its marker
_LEAST_CONTRAST = 3.0  # grey, half of what is between black and white
_LIKENESS = 0.25  # of that: what may be left over, root mean square


def refined_crossing(
    image: NDArray[np.uint8],
    corner: NDArray[np.float64],
    directions: NDArray[np.float64],
    side: float,
    gap: float,
) -> NDArray[np.float64] | None:
    """The corner (2,) pixels of a chessboard's squares.

    Grey is a mean, and a contrast with the product of two hyperbolic tangents of the distances to
    the edges. The markers in the white squares are left out.

    Args:
        image: (rows, columns) grey.
        corner: (2,) pixels, to about two pixels.
        directions: (2, 2), of the two edges in the image, unit.
        side: pixels, of the least side of the squares there.
        gap: pixels, of the least white between a square's edge and its marker.

    Returns:
        None where there is no crossing.
    """
    refined = np.array(corner, dtype=np.float64)
    lines = np.ascontiguousarray(directions, dtype=np.float64)
    if not _refine(np.ascontiguousarray(image), refined, lines, side, gap):
        return None
    return refined


@njit(cache=True, nogil=True, error_model="numpy")
def _refine(image, corner, directions, side, gap):
    """Gauss-Newton over the place, the mean, the contrast and the blur; returns its success."""
    rows, columns = image.shape
    arm = max(2.5, _ARM * side)
    near = max(1.0, _NEAR * gap)
    reach = math.ceil(arm * 1.5) + 1
    left, top = int(corner[0]) - reach, int(corner[1]) - reach
    if left < 0 or top < 0 or left + 2 * reach >= columns or top + 2 * reach >= rows:
        return False
    # Distances to the edges: components along the other edge, of oblique coordinates' sine.
    ux, uy, vx, vy = directions[0, 0], directions[0, 1], directions[1, 0], directions[1, 1]
    sine = ux * vy - uy * vx
    if abs(sine) < 0.2:
        return False
    start_x, start_y = corner[0], corner[1]
    mean, contrast, width = 0.0, 0.0, 0.8
    normal = np.empty((5, 5))
    right = np.empty(5)
    slopes = np.empty(5)
    for step in range(-1, _STEPS):
        normal[:] = 0.0
        right[:] = 0.0
        left_over, count = 0.0, 0
        for row in range(top, top + 2 * reach + 1):
            for column in range(left, left + 2 * reach + 1):
                x, y = column - corner[0], row - corner[1]
                # Across the edge along u, and across that along v.
                across, along = ux * y - uy * x, x * vy - y * vx
                high, low = max(abs(across), abs(along)), min(abs(across), abs(along))
                if high > arm or low > near:
                    continue
                one = math.tanh(_SLOPE * across / width)
                other = math.tanh(_SLOPE * along / width)
                grey = float(image[row, column])
                rest = grey - mean - contrast * one * other
                one_slope = _SLOPE / width * (1.0 - one * one)
                other_slope = _SLOPE / width * (1.0 - other * other)
                slopes[0] = contrast * (one_slope * uy * other - one * other_slope * vy)
                slopes[1] = contrast * (-one_slope * ux * other + one * other_slope * vx)
                slopes[2] = 1.0
                slopes[3] = one * other
                slopes[4] = (
                    -contrast * (one_slope * across * other + one * other_slope * along) / width
                )
                for a in range(5):
                    right[a] += slopes[a] * rest
                    for b in range(a + 1):
                        normal[a, b] += slopes[a] * slopes[b]
                left_over += rest * rest
                count += 1
        if count < 12:
            return False
        if step < 0:
            # First only the mean and the contrast, of which nothing is known yet.
            for a in (0, 1, 4):
                normal[a, a] += 1.0
                right[a] = 0.0
                for b in range(5):
                    if b != a:
                        normal[max(a, b), min(a, b)] = 0.0
        else:
            normal[4, 4] += (0.05 * contrast) ** 2
            right[4] -= (0.05 * contrast) ** 2 * (width - 0.8)
        for a in range(5):
            normal[a, a] *= 1.0 + 1e-6
        if not solve_definite(normal, right):
            return False
        length = math.sqrt(right[0] * right[0] + right[1] * right[1])
        scale = min(1.0, 1.0 / max(length, 1e-9))
        corner[0] += scale * right[0]
        corner[1] += scale * right[1]
        mean += right[2]
        contrast += right[3]
        width = min(3.0, max(0.3, width + max(-0.3, min(0.3, right[4]))))
        moved = max(abs(corner[0] - start_x), abs(corner[1] - start_y))
        if not (moved < 3.5 and abs(contrast) > _LEAST_CONTRAST):
            return False
        if step >= 0 and length < _STEADY:
            break
    return left_over < count * (_LIKENESS * contrast) ** 2
