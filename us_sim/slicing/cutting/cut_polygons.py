"""Polygons in which an image cuts tetrahedra, their pixels, and the outline of the mesh at rest.

A node on the plane counts as above it, so that every cut is a triangle or a quadrilateral between
crossings of the plane with edges of the mesh. A crossing is computed from its edge alone, from the
upper node down, so that neighbouring tetrahedra have the very same corners and sides. The cuts of
outer faces are kept too, as closed outlines: triangles, segments or points.

Scan conversion: a row belongs to a side of a polygon from its upper end to just above its lower
end, and a column to a polygon from its left side to just before its right side. So no pixel between
two polygons is missed and none is written twice.

Tissue that moved away leaves black behind: how often the outer faces of the mesh at rest wind
around a pixel says whether it lay in the mesh.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.mesh_faces import FACES
from us_sim.kernels import njit
from us_sim.slicing.cutting.section import ON_PLANE, compute_adjugate, is_solid
from us_sim.slicing.probe.plane import SlicePlane

_STEEP = 1e3
"""Voxels per pixel beyond which a map is so steep that rounding may lead it out of the volume."""
_MARGIN = 1e-6  # pixels by which a cut may lie outside the image and still be considered


class Cuts(NamedTuple):
    """Room for the cuts of an image; of each array only the first entries are in use.

    A cut may have no polygon: then it is only there for its outlines.
    """

    maps: NDArray[np.float64]  # (cuts, 3, 3) from (1, column, row) to rest, voxel indices
    corners: NDArray[np.float64]  # (cuts, 4, 2) column and row, in turn around the polygon
    sides: NDArray[np.int8]  # (cuts,) 3 or 4, or 0 without a polygon
    inside: NDArray[np.bool_]  # (cuts,) the map leads to points among the voxels' centres
    tetrahedra: NDArray[np.int32]  # (cuts,) which tetrahedron was cut
    outlines: NDArray[np.float64]  # (outlines, 3, 2) column and row
    points: NDArray[np.int8]  # (outlines,) how many of the three there are
    owner: NDArray[np.int32]  # (outlines,) which cut it closes


def allocate_cuts(count: int) -> Cuts:
    """Allocate arrays for the cuts of ``count`` tetrahedra, even if all are inverted."""
    many = 4 * count + 1  # one more for the rigid map
    return Cuts(
        np.empty((many, 3, 3)),
        np.empty((many, 4, 2)),
        np.empty(many, dtype=np.int8),
        np.empty(many, dtype=np.bool_),
        np.empty(many, dtype=np.int32),
        np.empty((many, 3, 2)),
        np.empty(many, dtype=np.int8),
        np.empty(many, dtype=np.int32),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def cut_tetrahedra(  # noqa: PLR0913
    near, nodes, to_pixel, pixel_volume, columns, rows, tetrahedra, neighbours, determinants,
    rest_index, within, cuts,
):  # fmt: skip
    """Fill ``cuts``; return the numbers of cuts, of outlines and of tetrahedra skipped.

    The fourth number says whether the cuts are sure to cover the image: no outline is on it, but
    a corner of a polygon is.

    Shapes and units:
        near: (K,) tetrahedra to cut. nodes: (N, 3) m. to_pixel: (3, 4) from m to column, row and
            height. pixel_volume: m³ per unit of those.
        neighbours: (M, 4) the tetrahedron beyond each face, -1 where the mesh ends.
        determinants: (M,) m³, six times the volumes at rest. rest_index: (N, 3) voxels.
        within: (M,) bool, which tetrahedra lie well among the voxels' centres at rest.
    """
    place = np.empty((4, 3))
    polygon = np.empty((4, 2))
    order = np.empty(4, dtype=np.uint64)
    count = np.int64(0)  # a literal would have the callees compiled for it, too
    pieces = np.int64(0)
    skipped = 0
    corner_on_image = False
    for e in near:
        e = np.uint32(e)
        for k in range(4):
            place_node(nodes, np.uint32(tetrahedra[e, k]), to_pixel, place, k)
        sides = _cross(place, order, polygon)
        if not _is_on_image(place, polygon, sides, columns, rows):
            continue
        if not _map_to_rest(
            place, tetrahedra[e], pixel_volume, determinants[e], rest_index, cuts.maps[count]
        ):
            skipped += 1
            pieces, count = _close_around(
                e, place, nodes, to_pixel, pixel_volume, columns, rows, tetrahedra, neighbours,
                determinants, rest_index, cuts, pieces, count,
            )  # fmt: skip
            continue
        before = pieces
        for f in range(4):
            if neighbours[e, f] < 0:
                pieces = _close_face(place, f, columns, rows, cuts, pieces, count)
        if sides == 0 and pieces == before:
            continue
        for k in range(sides):
            cuts.corners[count, k, 0] = polygon[k, 0]
            cuts.corners[count, k, 1] = polygon[k, 1]
            corner_on_image |= (
                0.0 <= polygon[k, 0] <= columns - 1 and 0.0 <= polygon[k, 1] <= rows - 1
            )
        cuts.sides[count] = sides
        cuts.inside[count] = within[e] and _is_gentle(cuts.maps[count])
        cuts.tetrahedra[count] = e
        count += 1
    return count, pieces, skipped, corner_on_image and pieces == 0


@njit(inline="always", error_model="numpy")
def place_node(nodes, n, to_pixel, place, k):
    """Write column, row and height of node ``n`` into row ``k`` of ``place`` (…, 3)."""
    x, y, z = nodes[n, 0], nodes[n, 1], nodes[n, 2]
    for a in range(3):
        place[k, a] = to_pixel[a, 3] + to_pixel[a, 0] * x + to_pixel[a, 1] * y + to_pixel[a, 2] * z
    if abs(place[k, 2]) <= ON_PLANE:
        place[k, 2] = 0.0


@njit(inline="always", error_model="numpy")
def cross_edge(place, a, b, corner):
    """Write the point where an edge from above (or on) the plane to below crosses it."""
    t = place[a, 2] / (place[a, 2] - place[b, 2])
    corner[0] = place[a, 0] + t * (place[b, 0] - place[a, 0])
    corner[1] = place[a, 1] + t * (place[b, 1] - place[a, 1])


@njit(inline="always", error_model="numpy")
def _cross(place, order, polygon):
    """Fill the corners of the polygon, in turn; return how many there are."""
    # Nodes above the plane come first, then those below it.
    up = np.uint64(0)
    for k in range(4):
        if place[k, 2] >= 0.0:
            order[up] = k
            up += np.uint64(1)
    down = np.uint64(3)
    for k in range(4):
        if not place[k, 2] >= 0.0:
            order[down] = k
            down -= np.uint64(1)
    if up == 0 or up == 4:
        return 0
    if up == 1:
        for k in range(3):
            cross_edge(place, order[0], order[k + 1], polygon[k])
        return 3
    if up == 3:
        for k in range(3):
            cross_edge(place, order[k], order[3], polygon[k])
        return 3
    cross_edge(place, order[0], order[2], polygon[0])
    cross_edge(place, order[0], order[3], polygon[1])
    cross_edge(place, order[1], order[3], polygon[2])
    cross_edge(place, order[1], order[2], polygon[3])
    return 4


@njit(inline="always", error_model="numpy")
def _is_on_image(place, polygon, sides, columns, rows):
    left = np.inf
    right = -np.inf
    top = np.inf
    bottom = -np.inf
    for k in range(sides):
        left = min(left, polygon[k, 0])
        right = max(right, polygon[k, 0])
        top = min(top, polygon[k, 1])
        bottom = max(bottom, polygon[k, 1])
    if sides == 0:
        for k in range(4):
            if place[k, 2] == 0.0:
                left = min(left, place[k, 0])
                right = max(right, place[k, 0])
                top = min(top, place[k, 1])
                bottom = max(bottom, place[k, 1])
    return (
        right >= -_MARGIN
        and left <= columns - 1 + _MARGIN
        and bottom >= -_MARGIN
        and top <= rows - 1 + _MARGIN
    )


@njit(inline="always", error_model="numpy")
def _map_to_rest(place, corners, pixel_volume, rest_determinant, rest_index, form):
    """Fill the (3, 3) map of a tetrahedron; return False if it is inverted or flat."""
    determinant, to_1, to_2, to_3 = compute_adjugate(place, 0, 1, 2, 3)
    if not is_solid(determinant, pixel_volume, rest_determinant):
        return False
    r = 1.0 / determinant
    b0 = r * to_1[0]
    c0 = r * to_2[0]
    d0 = r * to_3[0]
    for a in range(3):
        at = rest_index[np.uint32(corners[0]), a]
        to_b = rest_index[np.uint32(corners[1]), a] - at
        to_c = rest_index[np.uint32(corners[2]), a] - at
        to_d = rest_index[np.uint32(corners[3]), a] - at
        form[a, 0] = at + b0 * to_b + c0 * to_c + d0 * to_d
        form[a, 1] = r * (to_1[1] * to_b + to_2[1] * to_c + to_3[1] * to_d)
        form[a, 2] = r * (to_1[2] * to_b + to_2[2] * to_c + to_3[2] * to_d)
    return True


@njit(inline="always", error_model="numpy")
def _is_gentle(form):
    """Return True if rounding of a pixel's place cannot lead far out of the tetrahedron."""
    steepest = 0.0
    for a in range(3):
        steepest = max(steepest, max(abs(form[a, 1]), abs(form[a, 2])))
    return steepest < _STEEP


@njit(inline="always", error_model="numpy")
def cut_face(place, a, b, c, points):
    """Fill the points that span the closed cut of a face; return how many of three there are."""
    count = 0
    for k in (a, b, c):
        if place[k, 2] == 0.0:
            points[count, 0] = place[k, 0]
            points[count, 1] = place[k, 1]
            count += 1
    for first, second in ((a, b), (b, c), (c, a)):
        if place[first, 2] > 0.0 and place[second, 2] < 0.0:
            cross_edge(place, first, second, points[count])
            count += 1
        elif place[second, 2] > 0.0 and place[first, 2] < 0.0:
            cross_edge(place, second, first, points[count])
            count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _close_face(place, f, columns, rows, cuts, pieces, count):
    points = cuts.outlines[pieces]
    number = cut_face(place, FACES[f, 0], FACES[f, 1], FACES[f, 2], points)
    if number == 0 or not _is_on_image(place, points, number, columns, rows):
        return pieces
    cuts.points[pieces] = number
    cuts.owner[pieces] = count
    return pieces + 1


@njit(cache=True, nogil=True, error_model="numpy")
def _close_around(  # noqa: PLR0913
    skipped, place, nodes, to_pixel, pixel_volume, columns, rows, tetrahedra, neighbours,
    determinants, rest_index, cuts, pieces, count,
):  # fmt: skip
    """Add the outlines of the neighbours of a skipped tetrahedron, which end at it."""
    for e in neighbours[skipped]:
        if e < 0:
            continue
        for k in range(4):
            place_node(nodes, tetrahedra[e, k], to_pixel, place, k)
        if not _map_to_rest(
            place, tetrahedra[e], pixel_volume, determinants[e], rest_index, cuts.maps[count]
        ):
            continue
        for f in range(4):
            if neighbours[e, f] == skipped:
                after = _close_face(place, f, columns, rows, cuts, pieces, count)
                if after > pieces:
                    pieces = after
                    cuts.sides[count] = 0
                    cuts.inside[count] = False
                    cuts.tetrahedra[count] = e
                    count += 1
                    break
    return pieces, count


class Outline(NamedTuple):
    """The cuts of the mesh's outer faces at rest; of each array the first ``number`` are in use."""

    outlines: NDArray[np.float64]  # (cuts, 3, 2) column and row, closed
    points: NDArray[np.int8]  # (cuts,) how many of the three there are
    turns: NDArray[np.int8]  # (cuts,) by how much a crossing from the left winds further
    number: int


NO_OUTLINE = Outline(np.empty((0, 3, 2)), np.empty(0, dtype=np.int8), np.empty(0, dtype=np.int8), 0)
"""The outline without a mesh, or where the mesh at rest does not matter."""


class RestSurface:
    """The outer faces of a mesh at rest.

    Args:
        rest_nodes: (N, 3) m. tetrahedra: (M, 4). determinants: (M,) m³, six times their volumes.
        neighbours: (M, 4) the tetrahedron beyond each face, -1 where the mesh ends.
    """

    def __init__(
        self,
        rest_nodes: NDArray[np.float64],
        tetrahedra: NDArray[np.int32],
        determinants: NDArray[np.float64],
        neighbours: NDArray[np.int32],
    ) -> None:
        element, face = np.nonzero((neighbours < 0) & (determinants != 0)[:, None])
        triangles = tetrahedra[element[:, None], FACES[face]]
        inverted = determinants[element] < 0
        triangles[inverted] = triangles[inverted][:, ::-1]
        used, inverse = np.unique(triangles, return_inverse=True)
        self._nodes = np.ascontiguousarray(rest_nodes[used])
        self._triangles = np.ascontiguousarray(inverse.reshape(-1, 3), dtype=np.int32)
        self._places = np.empty((len(used), 3))
        self._outline = Outline(
            np.empty((len(triangles) + 1, 3, 2)),
            np.empty(len(triangles) + 1, dtype=np.int8),
            np.empty(len(triangles) + 1, dtype=np.int8),
            0,
        )

    def cut_plane(self, plane: SlicePlane) -> Outline:
        """Return the cut by the plane of an image; the next call overwrites it."""
        count = _cut(
            self._nodes, self._triangles, plane.to_pixel, plane.columns, plane.rows, self._places,
            *self._outline[:3],
        )  # fmt: skip
        return self._outline._replace(number=count)


@njit(cache=True, nogil=True, error_model="numpy")
def _cut(nodes, triangles, to_pixel, columns, rows, place, outlines, points, turns):  # noqa: PLR0913
    """Fill an outline and return how many cuts it has."""
    for n in range(len(nodes)):
        place_node(nodes, n, to_pixel, place, n)
    count = 0
    for f in range(len(triangles)):
        a = np.int64(triangles[f, 0])
        b = np.int64(triangles[f, 1])
        c = np.int64(triangles[f, 2])
        least = min(min(place[a, 2], place[b, 2]), place[c, 2])
        if least > 0.0 or max(max(place[a, 2], place[b, 2]), place[c, 2]) < 0.0:
            continue
        outline = outlines[count]
        number = cut_face(place, a, b, c, outline)
        left = outline[0, 0]
        top = outline[0, 1]
        bottom = outline[0, 1]
        for k in range(1, number):
            left = min(left, outline[k, 0])
            top = min(top, outline[k, 1])
            bottom = max(bottom, outline[k, 1])
        # Parts left of the image wind around its pixels too.
        if bottom < -1.0 or top > rows or left > columns:
            continue
        points[count] = number
        turns[count] = _turn(place, a, b, c, outline) if least < 0.0 and number == 2 else 0
        count += 1
    return count


@njit(inline="always", error_model="numpy")
def _turn(place, a, b, c, outline):
    """Return how a face that crosses the plane winds around points right of it, 1 or -1.

    The face's nodes turn counterclockwise as seen from outside the mesh.
    """
    # Turn the face until its first node is alone on its side of the plane.
    for _ in range(2):
        up = place[a, 2] >= 0.0
        if up != (place[b, 2] >= 0.0) and up != (place[c, 2] >= 0.0):
            break
        a, b, c = b, c, a
    if place[a, 2] >= 0.0:
        cross_edge(place, a, b, outline[0])
        cross_edge(place, a, c, outline[1])
        return -1 if outline[1, 1] > outline[0, 1] else 1
    cross_edge(place, b, a, outline[0])
    cross_edge(place, c, a, outline[1])
    return 1 if outline[1, 1] > outline[0, 1] else -1


@njit(cache=True, nogil=True, error_model="numpy")
def mark_covered(outlines, points, turns, number, row, winding, covered):
    """Mark the columns of a row that lie in the closed mesh at rest.

    Shapes and units:
        outlines, points, turns, number: as `Outline`.
        winding: (columns + 1,) int32 to work in. covered: (columns,) bool.
    """
    columns = len(covered)
    winding[:] = 0
    for q in range(number):
        if turns[q] == 0:
            continue
        a, b = (0, 1) if outlines[q, 0, 1] < outlines[q, 1, 1] else (1, 0)
        start = outlines[q, a, 1]
        height = outlines[q, b, 1] - start
        if start <= row < outlines[q, b, 1]:
            slope = (outlines[q, b, 0] - outlines[q, a, 0]) / height
            at = ceil_clamped(outlines[q, a, 0] + (row - start) * slope, 0, columns)
            winding[at] += turns[q]
    turn = 0
    for i in range(columns):
        turn += winding[i]
        covered[i] = turn != 0
    for q in range(number):
        first, end = find_closed_columns(outlines[q], points[q], row, columns)
        for i in range(first, end):
            covered[i] = True


CUT_SHIFT, END_SHIFT = 26, 13
"""A span is one number: bits by which its cut and its end are shifted there. The lowest bits are
its first column. A column is at most 4096."""

_CLOSE = 1e-8  # pixels from an outline within which a place is on it: rounding of positions


@njit(cache=True, nogil=True, error_model="numpy")
def convert_cuts(  # noqa: PLR0913
    corners, sides, count, outlines, points, owner, pieces, runs, first_row, end_row, spans, used
):  # fmt: skip
    """Fill the spans of rows ``first_row`` to ``end_row - 1``; return the most that a row has.

    Where that is more than there is room for, the rest is lost. Where spans overlap the later one
    holds.

    Shapes and units:
        corners … pieces: as `cut_polygons.Cuts`, with how many there are.
        runs: (rows, 2, 2) int32, first and end columns that show something.
        spans: (rows, room) int64. used: (rows,) int32, how many of them a row has.
    """
    low = np.empty(end_row - first_row, dtype=np.int64)
    high = np.empty(end_row - first_row, dtype=np.int64)
    columns = np.int64(0)
    kinds = np.uint64(1)
    for row in range(first_row, end_row):
        used[row] = 0
        columns = max(columns, max(np.int64(runs[row, 0, 1]), np.int64(runs[row, 1, 1])))
        if runs[row, 1, 1] > runs[row, 1, 0]:
            kinds = np.uint64(2)
    _add_outlines(
        outlines, points, owner, pieces, columns, first_row, end_row, runs, kinds, spans, used
    )
    for q in range(count):
        if sides[q] == 0:
            continue
        top = np.inf
        bottom = -np.inf
        for k in range(sides[q]):
            top = min(top, corners[q, k, 1])
            bottom = max(bottom, corners[q, k, 1])
        above = ceil_clamped(top, first_row, end_row)
        below = ceil_clamped(bottom, first_row, end_row)
        for row in range(above, below):
            low[np.uint64(row - first_row)] = columns
            high[np.uint64(row - first_row)] = 0
        for k in range(sides[q]):
            other = k + 1 if k + 1 < sides[q] else 0
            a, b = (k, other) if corners[q, k, 1] < corners[q, other, 1] else (other, k)
            column = corners[q, a, 0]
            start = corners[q, a, 1]
            slope = (corners[q, b, 0] - column) / (corners[q, b, 1] - start)
            for row in range(
                ceil_clamped(start, first_row, end_row),
                ceil_clamped(corners[q, b, 1], first_row, end_row),
            ):
                at = ceil_clamped(column + (row - start) * slope, 0, columns)
                line = np.uint64(row - first_row)
                low[line] = min(low[line], at)
                high[line] = max(high[line], at)
        for row in range(above, below):
            line = np.uint64(row - first_row)
            _add(q, low[line], high[line], row, runs, kinds, spans, used)
    return used[first_row:end_row].max()


@njit(cache=True, nogil=True, error_model="numpy")
def _add_outlines(  # noqa: PLR0913
    outlines, points, owner, pieces, columns, first_row, end_row, runs, kinds, spans, used
):
    """Add the spans of the cuts' closed outlines, arguments as for `convert_cuts`."""
    for q in range(pieces):
        top = np.inf
        bottom = -np.inf
        for k in range(points[q]):
            top = min(top, outlines[q, k, 1])
            bottom = max(bottom, outlines[q, k, 1])
        above = ceil_clamped(top - _CLOSE, first_row, end_row)
        below = ceil_clamped(bottom + _CLOSE, first_row, end_row) + 1
        for row in range(above, min(below, end_row)):
            first, end = find_closed_columns(outlines[q], points[q], row, columns)
            _add(owner[q], first, end, row, runs, kinds, spans, used)


@njit(inline="always", error_model="numpy")
def ceil_clamped(value, least, most):
    """Round up to a whole number held between two others; NaN becomes the first."""
    held = value if value > least else np.float64(least)
    held = held if held < most else np.float64(most)
    return np.int64(np.ceil(held))


@njit(inline="always", error_model="numpy")
def _add(q, first, end, row, runs, kinds, spans, used):
    line = np.uint64(row)
    for k in range(kinds):
        a = max(first, np.int64(runs[line, k, 0]))
        b = min(end, np.int64(runs[line, k, 1]))
        # An empty span is written too, and overwritten: faster than to test for it.
        place = np.uint64(used[line])
        if place < np.uint64(spans.shape[1]):
            spans[line, place] = np.int64(q) << CUT_SHIFT | b << END_SHIFT | a
        used[line] += a < b


@njit(inline="always", error_model="numpy")
def find_closed_columns(outline, points, row, columns):
    """Return first and end column of a row that lie on a closed point, segment or triangle."""
    left = np.inf
    right = -np.inf
    for k in range(points):
        other = k + 1 if k + 1 < points else 0
        a, b = (k, other) if outline[k, 1] <= outline[other, 1] else (other, k)
        start = outline[a, 1]
        height = outline[b, 1] - start
        if row + _CLOSE < start or row - _CLOSE > start + height:
            continue
        t = 0.0
        u = 1.0
        if height > 0.0:
            t = max(0.0, (row - _CLOSE - start) / height)
            u = min(1.0, (row + _CLOSE - start) / height)
        from_a = outline[a, 0] + t * (outline[b, 0] - outline[a, 0])
        to_b = outline[a, 0] + u * (outline[b, 0] - outline[a, 0])
        left = min(left, min(from_a, to_b))
        right = max(right, max(from_a, to_b))
    first = ceil_clamped(left - _CLOSE, 0, columns)
    end = ceil_clamped(right + _CLOSE, 0, columns)
    # The end is just beyond the last column that is not right of the outline.
    if right + _CLOSE >= 0.0 and np.floor(right + _CLOSE) < columns and end <= right + _CLOSE:
        end += 1
    return first, end
