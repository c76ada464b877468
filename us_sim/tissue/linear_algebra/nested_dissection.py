"""An order of elimination for sparse matrices of meshes: halves first, then what separates them.

(A. George, Nested dissection of a regular finite element mesh, SIAM J. Numer. Anal. 10, 1973.)

>>> import numpy as np
>>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh, uniform_planes
>>> from us_sim.tissue.linear_algebra.nested_dissection import nested_dissection
>>> mesh = box_mesh(uniform_planes(0, 0.8, 9), uniform_planes(0, 0.4, 5), uniform_planes(0, 0.4, 5))
>>> root = nested_dissection(mesh.nodes, mesh.edges, largest=50)
>>> len(root.own), [len(part.own) for part in root.parts]
(25, [20, 20])
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array


@dataclass(eq=False)
class Part:
    """Nodes that are eliminated together, after those of the parts below."""

    own: NDArray[np.int64]
    parts: list[Part] = field(default_factory=list)
    boundary: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))  # above it


def nested_dissection(
    points: NDArray[np.float64],
    edges: NDArray[np.integer],
    largest: int = 60,
) -> Part:
    """The tree of parts.

    Args:
        points: (N, 3) m, by whose coordinates nodes are halved.
        edges: (E, 2), which nodes couple.
        largest: number of nodes up to which a part is not halved.
    """
    count = len(points)
    both = np.concatenate([edges, edges[:, ::-1]])
    graph = coo_array((np.ones(len(both), np.int8), tuple(both.T)), shape=(count, count)).tocsr()
    root = _dissect(points, graph, np.arange(count), largest)
    _bound(root, graph, np.zeros(count, dtype=bool))
    return root


def _dissect(
    points: NDArray[np.float64], graph: csr_array, nodes: NDArray[np.int64], largest: int
) -> Part:
    if len(nodes) <= largest:
        return Part(nodes)
    axis = int(np.argmax(np.ptp(points[nodes], axis=0)))
    along = points[nodes, axis]
    middle = np.partition(along, len(nodes) // 2)[len(nodes) // 2]
    below = along < middle
    if not below.any():
        below = along <= middle
        if below.all():
            return Part(nodes)
    inside = np.zeros(graph.shape[0], dtype=bool)
    inside[nodes[below]] = True
    above = nodes[~below]
    separates = np.zeros(len(above), dtype=bool)
    start = graph.indptr[above]
    length = graph.indptr[above + 1] - start
    owner = np.repeat(np.arange(len(above)), length)
    offset = np.arange(length.sum()) - np.repeat(np.cumsum(length) - length, length)
    separates[owner[inside[graph.indices[start[owner] + offset]]]] = True
    halves = [nodes[below], above[~separates]]
    parts = [_dissect(points, graph, half, largest) for half in halves if len(half)]
    return Part(above[separates], parts)


def _bound(part: Part, graph: csr_array, eliminated: NDArray[np.bool_]) -> None:
    """Fill in the boundaries of a part and those below it."""
    for below in part.parts:
        _bound(below, graph, eliminated)
    near = [below.boundary for below in part.parts]
    near += [graph.indices[graph.indptr[i] : graph.indptr[i + 1]] for i in part.own]
    eliminated[part.own] = True
    boundary = np.unique(np.concatenate(near)) if near else part.own
    part.boundary = boundary[~eliminated[boundary]].astype(np.int64)
