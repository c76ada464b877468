"""Faces of tetrahedra, a mesh's boundary, and connected parts of a graph, by NumPy alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

# The four outward faces of a positively oriented tetrahedron.
FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])
MOST_NODES = 2**21  # Most nodes of a mesh, so that the three of a face fit into one 64-bit number


def face_order(
    tetrahedra: NDArray[np.integer],
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Face numbers in an order that groups the faces of the same three nodes.

    Face f of tetrahedron t, ``FACES[f]``, has the number 4 t + f.

    Returns:
        (4M,) face numbers, those of the same nodes one after the other and ascending; and for
        each such group where it starts, and how many faces it has.
    """
    faces = np.sort(tetrahedra[:, FACES].reshape(-1, 3).astype(np.int64), axis=1)
    keys = faces[:, 0] << 42 | faces[:, 1] << 21 | faces[:, 2]
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    starts = np.flatnonzero(np.concatenate([[True], keys[1:] != keys[:-1]]))
    return order, starts, np.diff(np.append(starts, len(keys)))


def boundary_triangles(tetrahedra: NDArray[np.integer]) -> NDArray[np.int32]:
    """(F, 3) triangles that belong to one tetrahedron only, normals pointing outward."""
    faces = tetrahedra[:, FACES].reshape(-1, 3)[boundary_faces(tetrahedra)]
    return np.ascontiguousarray(faces, dtype=np.int32)


def boundary_faces(tetrahedra: NDArray[np.integer]) -> NDArray[np.intp]:
    """(F,) ascending numbers, as in `face_order`, of the faces of one tetrahedron only."""
    order, starts, counts = face_order(tetrahedra)
    return np.sort(order[starts[counts == 1]])


def connected_parts(count: int, one: ArrayLike, other: ArrayLike) -> NDArray[np.int64]:
    """(``count``,) the part of each vertex, from 0 in the order of their first vertices.

    Each vertex points to one with a lower number, and edges and pointers are followed together
    until nothing changes (Shiloach and Vishkin, An O(log n) parallel connectivity algorithm, 1982).

    Args:
        one, other: (E,) the vertices that each edge joins.
    """
    ends = np.concatenate([np.asarray(one, np.int64), np.asarray(other, np.int64)])
    others = np.roll(ends, len(ends) // 2)
    lowest = np.arange(count)
    while True:
        before = lowest.copy()
        reached = before[others]
        np.minimum.at(lowest, before[ends], reached)  # the root of a vertex, to its neighbour's
        np.minimum.at(lowest, ends, reached)
        lowest = lowest[lowest]
        if np.array_equal(lowest, before):
            return np.unique(lowest, return_inverse=True)[1].astype(np.int64)
