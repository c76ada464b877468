"""Faces of tetrahedra, and a mesh's boundary."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# The outward faces of a positively oriented tetrahedron; face f is opposite to corner f. Some
# kernels compile them in.
FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]], dtype=np.int64)
MOST_NODES = 2**21  # Most nodes of a mesh, so that the three of a face fit into one 64-bit number


def sort_faces(
    tetrahedra: NDArray[np.integer],
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Sort face numbers so that faces of the same three nodes follow one another.

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


def find_boundary_triangles(tetrahedra: NDArray[np.integer]) -> NDArray[np.int32]:
    """Return (F, 3) triangles that belong to one tetrahedron only, normals pointing outward."""
    faces = tetrahedra[:, FACES].reshape(-1, 3)[find_boundary_faces(tetrahedra)]
    return np.ascontiguousarray(faces, dtype=np.int32)


def find_boundary_faces(tetrahedra: NDArray[np.integer]) -> NDArray[np.intp]:
    """Return (F,) ascending numbers, as in `sort_faces`, of the faces of one tetrahedron only."""
    order, starts, counts = sort_faces(tetrahedra)
    return np.sort(order[starts[counts == 1]])
