"""The polygons in which an image cuts tetrahedra, and the maps from pixels to rest.

A node on the plane counts as above it, so that every cut is a triangle or a quadrilateral between
crossings of the plane with edges of the mesh. A crossing is computed from its edge alone and
always from the upper node down. So tetrahedra with an edge in common have the very same corner, and
those with a face in common the very same side.

That rule leaves out what only touches the plane from above. The mesh includes its outer surface, so
the cuts of its outer faces are kept too, as closed outlines: triangles, segments or points.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit
from us_sim.slicing.cutting.barycentric import adjugate, is_solid
from us_sim.slicing.cutting.clusters import ON_PLANE

FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]], dtype=np.int64)
"""Corners of the four faces of a tetrahedron; face f is opposite to corner f."""

_STEEP = 1e3
"""Voxels per pixel beyond which a map is so steep that rounding may lead it out of the volume."""
_MARGIN = 1e-6
"""Pixels by which a cut may lie outside the image and still be considered."""


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


def room_for_cuts(count: int) -> Cuts:
    """Room for the cuts of that many tetrahedra, even if all are inverted."""
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
def cut_tetrahedra(
    near, nodes, to_pixel, pixel_volume, columns, rows, tetrahedra, neighbours, determinants,
    rest_index, within, cuts,
):  # fmt: skip
    """Fills ``cuts``; returns the numbers of cuts, of outlines and of tetrahedra skipped.

    The fourth number says whether the cuts are sure to cover the image: no outline is on it, but
    a corner of a polygon is.

    Args:
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
    """Column, row and height of node ``n``, into row ``k`` of ``place`` (…, 3)."""
    x = nodes[n, 0]
    y = nodes[n, 1]
    z = nodes[n, 2]
    for a in range(3):
        place[k, a] = to_pixel[a, 3] + to_pixel[a, 0] * x + to_pixel[a, 1] * y + to_pixel[a, 2] * z
    if abs(place[k, 2]) <= ON_PLANE:
        place[k, 2] = 0.0


@njit(inline="always", error_model="numpy")
def cross_edge(place, a, b, corner):
    """Where the edge from a node above (or on) the plane to one below it crosses the plane."""
    t = place[a, 2] / (place[a, 2] - place[b, 2])
    corner[0] = place[a, 0] + t * (place[b, 0] - place[a, 0])
    corner[1] = place[a, 1] + t * (place[b, 1] - place[a, 1])


@njit(inline="always", error_model="numpy")
def _cross(place, order, polygon):
    """Fills the corners of the polygon, in turn; returns how many there are."""
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
    """Whether the box around a tetrahedron's cut, or its nodes on the plane, meets the image."""
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
    """Fills the (3, 3) map of a tetrahedron; returns whether it is neither inverted nor flat."""
    determinant, to_1, to_2, to_3 = adjugate(place, 0, 1, 2, 3)
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
    """Whether rounding of a pixel's place cannot lead out of the tetrahedron's surroundings."""
    steepest = 0.0
    for a in range(3):
        steepest = max(steepest, max(abs(form[a, 1]), abs(form[a, 2])))
    return steepest < _STEEP


@njit(inline="always", error_model="numpy")
def face_cut(place, a, b, c, points):
    """Fills the points that span the closed cut of a face; returns how many of three there are."""
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
    """Adds the outline of a tetrahedron's face, if the image meets it, to those of a cut."""
    points = cuts.outlines[pieces]
    number = face_cut(place, FACES[f, 0], FACES[f, 1], FACES[f, 2], points)
    if number == 0 or not _is_on_image(place, points, number, columns, rows):
        return pieces
    cuts.points[pieces] = number
    cuts.owner[pieces] = count
    return pieces + 1


@njit(cache=True, nogil=True, error_model="numpy")
def _close_around(
    skipped, place, nodes, to_pixel, pixel_volume, columns, rows, tetrahedra, neighbours,
    determinants, rest_index, cuts, pieces, count,
):  # fmt: skip
    """The neighbours of a skipped tetrahedron end at it: adds the outlines of their faces."""
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
