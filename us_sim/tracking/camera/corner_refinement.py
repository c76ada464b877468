"""Corners of markers and chessboards to a part of a pixel, fitted to all pixels along their edges.

The gradients of a corner alone, which OpenCV's ``cornerSubPix`` uses, put a blurred corner about
a fifth of a pixel inside the true one, by which a marker seems farther away than it is. Calibrating
a webcam with 42 photos of a grid of markers leaves 0.46 pixels with them and 0.28 with these; with
four photos of a ChArUco board, 0.19 with OpenCV's ``CharucoDetector`` and 0.14 with these. In
rendered images of such a board at 0.25 to 0.9 m its corners are 0.06 to 0.07 pixels off, and these
0.01 to 0.03 (``tests/tracking/camera/test_source.py``).

>>> from us_sim.tracking.camera.corner_refinement import refine_corners
>>> image = np.full((80, 80), 200, np.uint8)
>>> image[20:60, 25:65] = 20
>>> image[20:60, 24] = 110  # half a pixel more
>>> rough = np.array([[25.0, 21.0], [63.0, 20.0], [64.0, 60.0], [24.0, 59.0]])
>>> refine_corners(image, rough, cells=6).round(2)
array([[24. , 19.5],
       [64.5, 19.5],
       [64.5, 59.5],
       [24. , 59.5]])
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit

_WIDEST = 4.0  # pixels on either side of an edge that are looked at
_NARROWEST = 1.2  # pixels
_LONGEST = 150  # pixels along an edge, evenly spread, that are looked at
_ROUNDS = 3
_STEPS = 6
_LOGISTIC = 1.702  # so steep is the logistic function that is nearest to the normal integral
_STEADY = 3e-3  # pixels, a step after which no other is worth its time
_SETTLED = 0.1  # pixels, of a round: the next would look at the same pixels
_LEAST_CONTRAST = 5.0  # grey
_LIKENESS = 0.2  # of the contrast: what may be left over, root mean square, of an edge


def refine_corners(
    image: NDArray[np.uint8], corners: NDArray[np.float64], cells: int
) -> NDArray[np.float64] | None:
    """Refine the corners (4, 2) pixels of a marker's black square on white.

    Across every edge, grey goes from black to white as a logistic function. Its place, width and
    both greys are fitted to the pixels about it by least squares. The edge may bow a little, as
    lenses make it.

    Args:
        image: (rows, columns) grey.
        corners: (4, 2) pixels, to about two pixels, clockwise.
        cells: of the square along an edge, the two black ones of its border among them.

    Returns:
        None where an edge is not that of a black square: cut, covered or inverted.
    """
    refined = np.empty((4, 2))
    start = np.ascontiguousarray(corners, dtype=np.float64)
    image = np.ascontiguousarray(image)
    if _refine(image, start, cells, refined):
        return refined
    for mended in _mended(start):
        if _refine(image, mended, cells, refined):
            return refined
    return None


def _mended(corners: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
    """Yield the quadrilateral with one corner put where it may be.

    A polygon that is fitted to the outline of a slanted square may cut off a sharp tip, or follow
    the shadow beyond it. So each corner in turn is put where it makes a parallelogram, or, as
    perspective may mislead, at the place nearest to that on the line to a neighbour.
    """
    for k in range(4):
        before, after = corners[k - 1], corners[(k + 1) % 4]
        wanted = before + after - corners[(k + 2) % 4]
        for neighbour in (before, after):
            line = corners[k] - neighbour
            fraction = float((wanted - neighbour) @ line / (line @ line))
            mended = corners.copy()
            mended[k] = neighbour + fraction * line
            yield mended
        mended = corners.copy()
        mended[k] = wanted
        yield mended


@njit(cache=True, nogil=True, error_model="numpy")
def _refine(image, corners, cells, refined):
    """Fit four edges and intersect neighbours, from wide to narrow; returns success."""
    for k in range(4):
        refined[k, 0], refined[k, 1] = corners[k, 0], corners[k, 1]
    edges = np.empty((4, 3))
    widths = np.full(4, 1.0)
    for _ in range(_ROUNDS):
        ax, ay = refined[2, 0] - refined[0, 0], refined[2, 1] - refined[0, 1]
        bx, by = refined[3, 0] - refined[1, 0], refined[3, 1] - refined[1, 1]
        border = 0.5 * (ax * by - ay * bx) / cells
        for k in range(4):
            if not _fit_edge(image, refined[k], refined[(k + 1) % 4], border, edges[k], widths, k):
                return False
        moved = 0.0
        ends = refined.copy()
        for k in range(4):
            x, y = _meet(ends, edges, k)
            if not (abs(x - corners[k, 0]) < 4.0 and abs(y - corners[k, 1]) < 4.0):
                return False
            moved = max(moved, abs(x - refined[k, 0]), abs(y - refined[k, 1]))
            refined[k, 0], refined[k, 1] = x, y
        if moved < _SETTLED:
            break
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _meet(ends, edges, k):
    """Intersect the edge that ends in corner k with the one that begins there."""
    before = (k + 3) % 4
    x, y = ends[k, 0], ends[k, 1]
    for _ in range(4):
        # Each edge about here is a line: through a point of it, along its slope.
        px, py, dx, dy = _tangent(ends[before], ends[k], edges[before], x, y)
        qx, qy, ex, ey = _tangent(ends[k], ends[(k + 1) % 4], edges[k], x, y)
        cross = dx * ey - dy * ex
        length = ((qx - px) * ey - (qy - py) * ex) / cross
        x, y = px + length * dx, py + length * dy
    return x, y


@njit(cache=True, nogil=True, error_model="numpy")
def _tangent(start, end, edge, x, y):
    """Return the point of a bowed edge beside (x, y), and the edge's direction there."""
    tx, ty = end[0] - start[0], end[1] - start[1]
    half = 0.5 * math.sqrt(tx * tx + ty * ty)
    tx, ty = 0.5 * tx / half, 0.5 * ty / half
    nx, ny = ty, -tx
    mx, my = 0.5 * (start[0] + end[0]), 0.5 * (start[1] + end[1])
    s = ((x - mx) * tx + (y - my) * ty) / half
    offset = edge[0] + edge[1] * s + edge[2] * (s * s - 1.0 / 3.0)
    slope = (edge[1] + 2 * edge[2] * s) / half
    return (
        mx + s * half * tx + offset * nx,
        my + s * half * ty + offset * ny,
        tx + slope * nx,
        ty + slope * ny,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _fit_edge(image, start, end, border, edge, widths, k):
    """Fit an edge; return its offset, slope and bow (3,) pixels, and True where it was found.

    They are from the line of its ends, outwards. ``widths[k]`` is the blur's deviation, kept from
    round to round. Along the edge s goes from -1 to 1; across it, outwards, the grey is
    black + (white - black) S((d - offset - slope s - bow (s² - 1/3)) / width), S the logistic
    function.
    """
    rows, columns = image.shape
    tx, ty = end[0] - start[0], end[1] - start[1]
    length = math.sqrt(tx * tx + ty * ty)
    if not length > 6.0:
        return False
    tx, ty = tx / length, ty / length
    # Corners go clockwise with y down: outwards is to the left of the edge's direction.
    nx, ny = ty, -tx
    mx, my = 0.5 * (start[0] + end[0]), 0.5 * (start[1] + end[1])
    half = 0.5 * length
    reach = min(_WIDEST, max(_NARROWEST, 0.75 * border / length))
    ends = 1.0 - min(0.3, max(2.5, 0.04 * length) / half)
    # Columns where the edge is rather horizontal, else rows.
    flat = abs(tx) >= abs(ty)
    along = abs(tx) if flat else abs(ty)
    middle = mx if flat else my
    first = math.ceil(middle - ends * half * along)
    last = math.floor(middle + ends * half * along)
    stride = 1 + (last - first) // _LONGEST
    most = ((last - first) // stride + 1) * (int(2 * reach / along) + 3)
    if last - first < 3:
        return False
    place = np.empty((most, 3))
    count = 0
    for i in range(first, last + 1, stride):
        if flat:
            centre = my + (i - mx) / tx * ty
        else:
            centre = mx + (i - my) / ty * tx
        spread = reach / along
        for j in range(math.ceil(centre - spread), math.floor(centre + spread) + 1):
            column, row = (i, j) if flat else (j, i)
            if row < 0 or column < 0 or row >= rows or column >= columns:
                return False
            x, y = column - mx, row - my
            s = (x * tx + y * ty) / half
            if abs(s) <= ends and count < most:
                place[count, 0] = s
                place[count, 1] = x * nx + y * ny
                place[count, 2] = image[row, column]
                count += 1
    if count < 12:
        return False
    return _fit_profile(place[:count], length, reach, edge, widths, k)


@njit(cache=True, nogil=True, error_model="numpy")
def _fit_profile(place, length, reach, edge, widths, k):
    """Fit offset, slope, bow, black, white and width by Gauss-Newton; see `_fit_edge`."""
    black, white = _measure_sides(place, 0.5 * reach)
    if not white - black > _LEAST_CONTRAST:
        return False
    edge[:] = 0.0
    width = widths[k]
    # A weak prior, of some pixels' weight, holds the bow to what a lens may do, and the width to
    # that of a focused one.
    noise = 0.02 * (white - black)
    bow_weight = (noise / (0.002 * length + 0.01)) ** 2
    width_weight = (noise / 1.0) ** 2
    slopes = np.empty((len(place), 7))  # the last column is what is left over
    right = np.empty(6)
    for _ in range(_STEPS):
        _linearise_profile(place, edge, black, white, width, slopes)
        squares = slopes.T @ slopes
        normal = squares[:6, :6]
        for a in range(6):
            right[a] = squares[6, a]
        normal[2, 2] += bow_weight
        right[2] -= bow_weight * edge[2]
        normal[5, 5] += width_weight
        right[5] -= width_weight * (width - 1.0)
        for a in range(6):
            normal[a, a] *= 1.0 + 1e-6
        if not _solve_definite(normal, right):
            return False
        turn = min(1.0, 1.0 / max(1e-9, abs(right[0]), abs(right[1])))
        for a in range(3):
            edge[a] += turn * right[a]
        black += right[3]
        white += right[4]
        width = min(3.0, max(0.3, width + max(-0.4, min(0.4, right[5]))))
        if not (white - black > _LEAST_CONTRAST and abs(edge[0]) < reach + 1.0):
            return False
        if abs(right[0]) < _STEADY and abs(right[1]) < _STEADY:
            break
    widths[k] = width
    left = 0.0
    for i in range(len(place)):
        left += slopes[i, 6] * slopes[i, 6]
    return left < len(place) * (_LIKENESS * (white - black)) ** 2


@njit(cache=True, nogil=True, error_model="numpy")
def _measure_sides(place, beside):
    """Return the mean greys inside and outside an edge, from ``beside`` pixels on; NaN of none."""
    low, high, lows, highs = 0.0, 0.0, 0, 0
    for i in range(len(place)):
        if place[i, 1] < -beside:
            low += place[i, 2]
            lows += 1
        elif place[i, 1] > beside:
            high += place[i, 2]
            highs += 1
    return low / lows, high / highs


@njit(cache=True, nogil=True, error_model="numpy")
def _linearise_profile(place, edge, black, white, width, slopes):
    """Fill slopes (n, 7) with the grey's by the six parameters, and what is left over."""
    contrast = white - black
    for i in range(len(place)):
        s = place[i, 0]
        bend = s * s - 1.0 / 3.0
        z = (place[i, 1] - edge[0] - edge[1] * s - edge[2] * bend) / width
        step = 1.0 / (1.0 + math.exp(-_LOGISTIC * z))
        bell = _LOGISTIC * step * (1.0 - step) * contrast / width
        slopes[i, 0] = -bell
        slopes[i, 1] = -bell * s
        slopes[i, 2] = -bell * bend
        slopes[i, 3] = 1.0 - step
        slopes[i, 4] = step
        slopes[i, 5] = -bell * z
        slopes[i, 6] = place[i, 2] - black - contrast * step


# No linear algebra library is called, which would take long to compile.


@njit(cache=True, nogil=True, error_model="numpy")
def _solve_definite(matrix, right):
    """Solve a definite system by Cholesky; return False where the matrix is not definite.

    ``right`` (n,) is replaced by the solution, and the lower triangle of the matrix (n, n) by its
    factor.
    """
    size = len(right)
    for i in range(size):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                matrix[i, i] = math.sqrt(total)
            else:
                matrix[i, j] = total / matrix[j, j]
    for i in range(size):
        for j in range(i):
            right[i] -= matrix[i, j] * right[j]
        right[i] /= matrix[i, i]
    for i in range(size - 1, -1, -1):
        for j in range(i + 1, size):
            right[i] -= matrix[j, i] * right[j]
        right[i] /= matrix[i, i]
    return True


_CROSSING_STEPS = 12
_CROSSING_STEADY = 2e-3  # pixels
_SLOPE = 0.851  # of the hyperbolic tangent that is nearest to the normal integral
_ARM = 0.45  # of a square: how far the edges are followed
_NEAR = 0.8  # of the white between a square's edge and its marker
_LEAST_CROSSING_CONTRAST = 3.0  # grey, half of what is between black and white
_CROSSING_LIKENESS = 0.25  # of that: what may be left over, root mean square


def refine_crossing(
    image: NDArray[np.uint8],
    corner: NDArray[np.float64],
    directions: NDArray[np.float64],
    side: float,
    gap: float,
) -> NDArray[np.float64] | None:
    """Refine the corner (2,) pixels of a chessboard's squares.

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
    if not _refine_crossing(np.ascontiguousarray(image), refined, lines, side, gap):
        return None
    return refined


@njit(cache=True, nogil=True, error_model="numpy")
def _refine_crossing(image, corner, directions, side, gap):
    """Fit place, mean, contrast and blur by Gauss-Newton; return whether there is a crossing."""
    rows, columns = image.shape
    arm = max(2.5, _ARM * side)
    near = max(1.0, _NEAR * gap)
    reach = math.ceil(arm * 1.5) + 1
    left, top = int(corner[0]) - reach, int(corner[1]) - reach
    if left < 0 or top < 0 or left + 2 * reach >= columns or top + 2 * reach >= rows:
        return False
    sine = directions[0, 0] * directions[1, 1] - directions[0, 1] * directions[1, 0]
    if abs(sine) < 0.2:
        return False
    window = (left, top, 2 * reach + 1)
    start_x, start_y = corner[0], corner[1]
    mean, contrast, width = 0.0, 0.0, 0.8
    normal = np.empty((5, 5))
    right = np.empty(5)
    for step in range(-1, _CROSSING_STEPS):
        left_over, count = _linearise_crossing(
            image, window, corner, directions, (arm, near), (mean, contrast, width), normal, right
        )
        if count < 12:
            return False
        if step < 0:
            _hold_place_and_blur(normal, right)
        else:
            normal[4, 4] += (0.05 * contrast) ** 2
            right[4] -= (0.05 * contrast) ** 2 * (width - 0.8)
        for a in range(5):
            normal[a, a] *= 1.0 + 1e-6
        if not _solve_definite(normal, right):
            return False
        length = math.sqrt(right[0] * right[0] + right[1] * right[1])
        scale = min(1.0, 1.0 / max(length, 1e-9))
        corner[0] += scale * right[0]
        corner[1] += scale * right[1]
        mean += right[2]
        contrast += right[3]
        width = min(3.0, max(0.3, width + max(-0.3, min(0.3, right[4]))))
        moved = max(abs(corner[0] - start_x), abs(corner[1] - start_y))
        if not (moved < 3.5 and abs(contrast) > _LEAST_CROSSING_CONTRAST):
            return False
        if step >= 0 and length < _CROSSING_STEADY:
            break
    return left_over < count * (_CROSSING_LIKENESS * contrast) ** 2


@njit(cache=True, nogil=True, error_model="numpy")
def _linearise_crossing(image, window, corner, directions, limits, grey, normal, right):
    """Fill the normal matrix (5, 5), its lower triangle, and the right side (5,) of a crossing.

    ``window`` is left, top and size; ``limits`` are the distances (pixels) to which edges are
    followed, and used beside them; ``grey`` is mean, contrast and blur. Return the sum of squares
    that is left over, and the count of pixels.
    """
    (left, top, size), (arm, near), (mean, contrast, width) = window, limits, grey
    ux, uy, vx, vy = directions[0, 0], directions[0, 1], directions[1, 0], directions[1, 1]
    slopes = np.empty(5)
    normal[:] = 0.0
    right[:] = 0.0
    left_over, count = 0.0, 0
    for row in range(top, top + size):
        for column in range(left, left + size):
            x, y = column - corner[0], row - corner[1]
            # Distances from the edges along u and along v.
            across, along = ux * y - uy * x, x * vy - y * vx
            high, low = max(abs(across), abs(along)), min(abs(across), abs(along))
            if high > arm or low > near:
                continue
            one = math.tanh(_SLOPE * across / width)
            other = math.tanh(_SLOPE * along / width)
            rest = float(image[row, column]) - mean - contrast * one * other
            one_slope = _SLOPE / width * (1.0 - one * one)
            other_slope = _SLOPE / width * (1.0 - other * other)
            slopes[0] = contrast * (one_slope * uy * other - one * other_slope * vy)
            slopes[1] = contrast * (-one_slope * ux * other + one * other_slope * vx)
            slopes[2] = 1.0
            slopes[3] = one * other
            slopes[4] = -contrast * (one_slope * across * other + one * other_slope * along) / width
            for a in range(5):
                right[a] += slopes[a] * rest
                for b in range(a + 1):
                    normal[a, b] += slopes[a] * slopes[b]
            left_over += rest * rest
            count += 1
    return left_over, count


@njit(cache=True, nogil=True, error_model="numpy")
def _hold_place_and_blur(normal, right):
    """Leave only the mean and the contrast to be solved for, since nothing is known of them yet."""
    for a in (0, 1, 4):
        normal[a, a] += 1.0
        right[a] = 0.0
        for b in range(5):
            if b != a:
                normal[max(a, b), min(a, b)] = 0.0
