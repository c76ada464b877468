"""Repair of meshes, where only one answer can be meant, with a sentence on what was done.

>>> import numpy as np
>>> from us_sim.tissue.mesh.repair import repair
>>> nodes = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [9, 9, 9]])
>>> mesh, report = repair(nodes, np.array([[0, 2, 1, 3]]))
>>> report
('left out 1 node that no tetrahedron uses', 'turned 1 inverted tetrahedron')
>>> mesh.volumes
array([0.16666667])
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import MeshError
from us_sim.tissue.mesh.check import check_arrays, signed_volumes
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh


def repair(nodes: ArrayLike, tetrahedra: ArrayLike) -> tuple[TetrahedralMesh, tuple[str, ...]]:
    """A mesh from nodes and tetrahedra that may be in disorder.

    Nodes in exactly the same place become one, and tetrahedra that have no volume because of that,
    repeated tetrahedra and unused nodes are left out. Inverted tetrahedra are turned. A tetrahedron
    that was pulled inside out rather than written in another order overlaps its neighbours when it
    is turned, and is refused.

    Args:
        nodes: (N, 3) m.
        tetrahedra: (M, 4) indices into nodes.

    Returns:
        The mesh, and a sentence on each kind of repair; none where nothing was wrong.

    Raises:
        MeshError: nothing safe can be done about the rest, as
            `us_sim.tissue.mesh.check.check_mesh` says. Its numbers are those after the repair.
    """
    places = np.asarray(nodes, dtype=np.float64)
    corners: NDArray[Any] = np.asarray(tetrahedra)
    check_arrays(places, corners)
    report = []

    whole, joined = np.unique(places + 0.0, axis=0, return_inverse=True)
    if len(whole) < len(places):
        kept, first = np.unique(joined.reshape(-1), return_index=True)
        order = np.argsort(first)  # nodes keep their order
        number = np.empty(len(kept), dtype=np.int64)
        number[order] = np.arange(len(kept))
        corners = number[joined.reshape(-1)][corners]
        report.append(
            _said("joined", len(places) - len(whole), "node", "with another in its place")
        )
        places = places[np.sort(first)]

    ordered = np.sort(corners, axis=1)
    collapsed = (ordered[:, 1:] == ordered[:, :-1]).any(axis=1)
    _, once = np.unique(ordered, axis=0, return_index=True)
    repeated = np.ones(len(corners), dtype=bool)
    repeated[once] = False
    for bad, what in ((collapsed, "that names a node twice"), (repeated & ~collapsed, "repeated")):
        if bad.any():
            report.append(_said("left out", bad.sum(), "tetrahedron", what))
    corners = corners[~(collapsed | repeated)]

    used, renumbered = np.unique(corners, return_inverse=True)
    if len(used) < len(places):
        left_out = len(places) - len(used)
        report.append(_said("left out", left_out, "node", "that no tetrahedron uses"))
        places, corners = places[used], renumbered.reshape(-1, 4)

    inverted = signed_volumes(places, corners) < 0
    if inverted.any():
        corners = corners.astype(np.int32)
        corners[inverted] = corners[inverted][:, [0, 1, 3, 2]]
        report.append(_said("turned", inverted.sum(), "inverted tetrahedron"))
    try:
        return TetrahedralMesh(places, corners.astype(np.int32)), tuple(report)
    except MeshError as error:
        done = f" (after repair: {', '.join(report)})" if report else ""
        raise MeshError(f"{error}{done}") from error


def _said(verb: str, count: int, thing: str, how: str = "") -> str:
    plural = thing.replace("tetrahedron", "tetrahedra") if "hedron" in thing else f"{thing}s"
    if count > 1:
        how = how.replace("names", "name").replace("its place", "their place")
    return f"{verb} {count} {thing if count == 1 else plural} {how}".rstrip()
