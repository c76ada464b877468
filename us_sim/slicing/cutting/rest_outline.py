"""The area where an image cuts the mesh at rest, from the mesh's outer faces alone.

Tissue that was there and moved away leaves black behind. How often the outer faces wind around a
pixel says whether it lies in the mesh: their crossings with its row are counted from the left.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit
from us_sim.slicing.cutting.cut_polygons import FACES, cross_edge, face_cut, place_node
from us_sim.slicing.cutting.spans import closed_columns, up_to
from us_sim.slicing.probe.plane import SlicePlane


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

    def cut(self, plane: SlicePlane) -> Outline:
        """The cut by the plane of an image; overwritten by the next."""
        count = _cut(
            self._nodes,
            self._triangles,
            plane.to_pixel,
            plane.columns,
            plane.rows,
            self._places,
            *self._outline[:3],
        )
        return self._outline._replace(number=count)


@njit(cache=True, nogil=True, error_model="numpy")
def _cut(nodes, triangles, to_pixel, columns, rows, place, outlines, points, turns):
    """Fills an outline and returns how many cuts it has."""
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
        number = face_cut(place, a, b, c, outline)
        left = outline[0, 0]
        top = outline[0, 1]
        bottom = outline[0, 1]
        for k in range(1, number):
            left = min(left, outline[k, 0])
            top = min(top, outline[k, 1])
            bottom = max(bottom, outline[k, 1])
        # What lies left of the image winds around its pixels too.
        if bottom < -1.0 or top > rows or left > columns:
            continue
        points[count] = number
        turns[count] = _turn(place, a, b, c, outline) if least < 0.0 and number == 2 else 0
        count += 1
    return count


@njit(inline="always", error_model="numpy")
def _turn(place, a, b, c, outline):
    """How a face that crosses the plane winds around points right of it; nodes on it are above.

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
    """Sets which columns of a row lie in the closed mesh at rest.

    Args:
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
            at = up_to(outlines[q, a, 0] + (row - start) * slope, 0, columns)
            winding[at] += turns[q]
    turn = 0
    for i in range(columns):
        turn += winding[i]
        covered[i] = turn != 0
    for q in range(number):
        first, end = closed_columns(outlines[q], points[q], row, columns)
        for i in range(first, end):
            covered[i] = True
