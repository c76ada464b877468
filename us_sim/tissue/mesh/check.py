"""Checks of tetrahedral meshes: each fault that no solver could work with, in one sentence.

>>> import numpy as np
>>> from us_sim.errors import MeshError
>>> from us_sim.tissue.mesh.check import check_mesh
>>> nodes = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
>>> try:
...     check_mesh(nodes, np.array([[0, 2, 1, 3]]))
... except MeshError as error:
...     print(error)
1 tetrahedron is inverted, such as tetrahedron 0 (volume -0.167 m3): order its nodes so that its
volume is positive, or let us_sim.tissue.mesh.repair do it
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError
from us_sim.geometry.connected_parts import connected_parts
from us_sim.geometry.mesh_faces import FACES, MOST_NODES, face_order
from us_sim.settings.spelling import counted

EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])  # the six edges of a tetrahedron

_FARTHEST = 1e6
"""Largest coordinate of a body, m; beyond it volumes would overflow."""

_SMALLEST_VOLUME = 1e-9
"""Below this fraction of its longest edge cubed a tetrahedron's volume is rounding noise."""


def check_mesh(nodes: NDArray[np.float64], tetrahedra: NDArray[np.integer]) -> None:
    """Refuse what no solver could work on; disconnected parts are allowed.

    Args:
        nodes: (N, 3) m.
        tetrahedra: (M, 4) indices into nodes.

    Raises:
        MeshError: wrong shapes, nodes that are not finite, indices out of range, nodes that no
            tetrahedron uses or that lie on one another, tetrahedra that are flat, inverted or
            repeated, faces of more than two tetrahedra, tetrahedra that overlap a neighbour, or
            parts that hang together by a node or an edge only. It says how many, and where one is.
    """
    check_arrays(nodes, tetrahedra)
    used = np.zeros(len(nodes), dtype=bool)
    used[tetrahedra] = True
    if not used.all():
        idle = np.flatnonzero(~used)
        raise MeshError(
            f"{counted(len(idle), 'mesh node belongs', 'mesh nodes belong')} to no tetrahedron, "
            f"such as node {idle[0]}: remove them, or let us_sim.tissue.mesh.repair do it"
        )
    _check_places(nodes)
    _check_volumes(nodes, tetrahedra)
    _check_faces(tetrahedra)


def check_arrays(nodes: NDArray[np.float64], tetrahedra: NDArray[np.integer]) -> None:
    """Refuse arrays that say nothing about a mesh, whatever is wrong with the mesh itself.

    Raises:
        MeshError: wrong shapes or types, too many nodes, coordinates that are not finite or too
            large, or indices out of range.
    """
    if nodes.ndim != 2 or nodes.shape[1] != 3:
        raise MeshError(f"mesh nodes have shape {nodes.shape}: give (N, 3) coordinates")
    if tetrahedra.ndim != 2 or tetrahedra.shape[1] != 4 or tetrahedra.shape[0] == 0:
        raise MeshError(f"tetrahedra have shape {tetrahedra.shape}: give (M, 4) indices, M > 0")
    if not np.issubdtype(tetrahedra.dtype, np.integer):
        raise MeshError(f"tetrahedra are of type {tetrahedra.dtype}: give integer node indices")
    if len(nodes) > MOST_NODES:
        raise MeshError(
            f"the mesh has {len(nodes)} nodes: give a coarser one, of {MOST_NODES} at most"
        )
    bad = np.flatnonzero(~np.isfinite(nodes).all(axis=1))
    if len(bad):
        raise MeshError(
            f"{counted(len(bad), 'mesh node is', 'mesh nodes are')} not finite, such as node "
            f"{bad[0]} at {nodes[bad[0]].tolist()}: give every node three numbers"
        )
    bad = np.flatnonzero((np.abs(nodes) > _FARTHEST).any(axis=1))
    if len(bad):
        raise MeshError(
            f"{counted(len(bad), 'mesh node is', 'mesh nodes are')} farther than {_FARTHEST:g} m "
            f"away, such as node {bad[0]} at {nodes[bad[0]].tolist()}: give coordinates in metres"
        )
    if tetrahedra.min() < 0 or tetrahedra.max() >= len(nodes):
        raise MeshError(
            f"tetrahedra name nodes {tetrahedra.min()} to {tetrahedra.max()}, but the mesh "
            f"has nodes 0 to {len(nodes) - 1}"
        )


def signed_volumes(
    nodes: NDArray[np.float64], tetrahedra: NDArray[np.integer]
) -> NDArray[np.float64]:
    """(M,) m3, negative for an inverted tetrahedron."""
    a, b, c, d = (nodes[tetrahedra[:, corner]] for corner in range(4))
    b, c, d = b - a, c - a, d - a
    x = c[:, 1] * d[:, 2] - c[:, 2] * d[:, 1]
    y = c[:, 2] * d[:, 0] - c[:, 0] * d[:, 2]
    z = c[:, 0] * d[:, 1] - c[:, 1] * d[:, 0]
    return (b[:, 0] * x + b[:, 1] * y + b[:, 2] * z) / 6


def _check_places(nodes: NDArray[np.float64]) -> None:
    order = np.lexsort(nodes.T)
    same = np.flatnonzero((nodes[order[1:]] == nodes[order[:-1]]).all(axis=1))
    if len(same):
        node, other = sorted((int(order[same[0]]), int(order[same[0] + 1])))
        raise MeshError(
            f"{counted(len(same), 'mesh node lies', 'mesh nodes lie')} exactly where another one "
            f"lies, such as node {other} on node {node}: join them, or let "
            f"us_sim.tissue.mesh.repair do it"
        )


def _check_volumes(nodes: NDArray[np.float64], tetrahedra: NDArray[np.integer]) -> None:
    volumes = signed_volumes(nodes, tetrahedra)
    longest = np.zeros(len(tetrahedra))
    for one, other in EDGES:
        along = nodes[tetrahedra[:, one]] - nodes[tetrahedra[:, other]]
        np.maximum(longest, np.einsum("ij,ij->i", along, along), out=longest)
    smallest = _SMALLEST_VOLUME * longest**1.5
    for bad, what, remedy in (
        (
            np.flatnonzero(np.abs(volumes) <= smallest),
            "flat",
            "take out such tetrahedra, or move their nodes apart",
        ),
        (
            np.flatnonzero(volumes < -smallest),
            "inverted",
            "order its nodes so that its volume is positive, or let us_sim.tissue.mesh.repair "
            "do it",
        ),
    ):
        if len(bad):
            raise MeshError(
                f"{counted(len(bad), 'tetrahedron is', 'tetrahedra are')} "
                f"{what}, such as tetrahedron {bad[0]} (volume {volumes[bad[0]]:.3g} m3): {remedy}"
            )


def _check_faces(tetrahedra: NDArray[np.integer]) -> None:
    """Whether tetrahedra meet face to face, two at a face, from its two sides."""
    whole = np.sort(tetrahedra, axis=1).astype(np.int64)
    order = np.lexsort((whole[:, 2] << 32 | whole[:, 3], whole[:, 0] << 32 | whole[:, 1]))
    same = np.flatnonzero((whole[order[1:]] == whole[order[:-1]]).all(axis=1))
    if len(same):
        raise MeshError(
            f"{counted(len(same), 'tetrahedron is', 'tetrahedra are')} repeated, such as "
            f"tetrahedron {order[same[0] + 1]}, which has the nodes of tetrahedron "
            f"{order[same[0]]}: keep each once, or let us_sim.tissue.mesh.repair do it"
        )
    order, starts, counts = face_order(tetrahedra)
    crowded = np.flatnonzero(counts > 2)
    if len(crowded):
        first = starts[crowded[0]]
        several = (order[first : first + counts[crowded[0]]] // 4).tolist()
        raise MeshError(
            f"the mesh is not manifold: {counted(len(crowded), 'face belongs', 'faces belong')} "
            f"to more than two tetrahedra, such as one of tetrahedra "
            f"{', '.join(map(str, several))}: take out those that overlap"
        )
    paired = starts[counts == 2]
    one, other = order[paired], order[paired + 1]
    folded = np.flatnonzero(_turn(tetrahedra, one) == _turn(tetrahedra, other))
    if len(folded):
        raise MeshError(
            f"{counted(len(folded), 'pair of tetrahedra lies', 'pairs of tetrahedra lie')} on the "
            f"same side of the face they share, such as {one[folded[0]] // 4} and "
            f"{other[folded[0]] // 4}: they overlap, mend the mesh"
        )
    _check_hinges(tetrahedra, one // 4, other // 4)


def _turn(tetrahedra: NDArray[np.integer], numbers: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Whether faces name their nodes in an even permutation of ascending order."""
    a, b, c = tetrahedra[numbers[:, None] // 4, FACES[numbers % 4]].T
    return (a < b) ^ (b < c) ^ (a < c)


def _check_hinges(
    tetrahedra: NDArray[np.integer], one: NDArray[np.intp], other: NDArray[np.intp]
) -> None:
    """Whether tetrahedra hang together by faces; the pairs (P,) and (P,) have one in common."""
    body = connected_parts(len(tetrahedra), one, other)
    bodies = int(body.max()) + 1
    if bodies == 1:
        return
    nodes = tetrahedra.max() + 1
    lowest = np.full(nodes, bodies)
    highest = np.zeros(nodes, dtype=int)
    np.minimum.at(lowest, tetrahedra.ravel(), np.repeat(body, 4))
    np.maximum.at(highest, tetrahedra.ravel(), np.repeat(body, 4))
    hinges = np.flatnonzero(lowest < highest)
    if len(hinges):
        node = hinges[0]
        raise MeshError(
            f"{bodies} parts of the mesh hang together by nodes or edges only, "
            f"{counted(len(hinges), 'node', 'nodes')} in all, such as node {node} between "
            f"tetrahedra {_with_node(tetrahedra, body == lowest[node], node)} and "
            f"{_with_node(tetrahedra, body == highest[node], node)}: join such parts by faces, or "
            f"give each its own nodes"
        )


def _with_node(
    tetrahedra: NDArray[np.integer], among: NDArray[np.bool_], node: np.integer
) -> np.intp:
    return np.flatnonzero(among & (tetrahedra == node).any(axis=1))[0]
