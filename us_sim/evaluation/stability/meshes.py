"""Small tissues on which solvers are tried: well shaped, badly shaped, in pieces, badly held.

>>> from us_sim.evaluation.stability.meshes import MESHES, mesh_named
>>> sorted(MESHES)[:3], len(mesh_named("box").nodes)
(['box', 'delaunay', 'fine'], 64)
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay

from us_sim.tissue.mesh.tetrahedral_mesh import (
    TetrahedralMesh,
    box_mesh,
    signed_volumes,
    uniform_planes,
)
from us_sim.tissue.model import face_nodes

SUPPORTS = ("bottom", "walls", "three", "one piece", "nothing", "everything")
"""What of a tissue is held."""

_FLATTEST = 1e-7
"""Volume over the longest edge cubed, below which a tetrahedron of Delaunay's is left out."""


@lru_cache
def mesh_named(name: str) -> TetrahedralMesh:
    """One of `MESHES`, made once: its top is z = 0 and its bottom the largest z."""
    return MESHES[name]()


def fixed_nodes(mesh: TetrahedralMesh, support: str) -> NDArray[np.bool_]:
    """(N,) which nodes one of `SUPPORTS` holds."""
    nodes = mesh.nodes
    fixed = np.zeros(len(nodes), dtype=bool)
    if support in ("bottom", "walls", "three", "one piece"):
        fixed[face_nodes(mesh, "bottom")] = True
    if support == "walls":
        fixed[face_nodes(mesh, "sides")] = True
    if support == "three":
        bottom = np.flatnonzero(fixed)
        across = nodes[bottom, :2] @ np.array([[1.0, 1, -1], [1, -1, 0.5]])
        fixed[:] = False
        fixed[bottom[across.argmax(axis=0)]] = True
    if support == "one piece":
        fixed &= parts(mesh) == 0
    if support == "everything":
        fixed[:] = True
    return fixed


def parts(mesh: TetrahedralMesh) -> NDArray[np.intp]:
    """(N,) which connected part each node is of."""
    count = len(mesh.nodes)
    graph = coo_array((np.ones(len(mesh.edges)), tuple(mesh.edges.T)), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def _box(nx: int, ny: int, nz: int, size: float = 1.0) -> TetrahedralMesh:
    x, y = (uniform_planes(-0.05 * size, 0.05 * size, count) for count in (nx, ny))
    return box_mesh(x, y, uniform_planes(0.0, 0.08 * size, nz))


def _layered() -> TetrahedralMesh:
    """Cells a thousand times as wide as thick."""
    across = uniform_planes(-0.05, 0.05, 4)
    return box_mesh(across, across, [0.0, 3e-5, 0.02, 0.02003, 0.08])


def _jittered(mesh: TetrahedralMesh, spread: float, seed: int) -> TetrahedralMesh:
    """Every node that is not on a face moved at random; those on faces within their face."""
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    moved = mesh.nodes + spread * np.random.default_rng(seed).uniform(-1, 1, mesh.nodes.shape)
    on_face = (mesh.nodes == low) | (mesh.nodes == high)
    return TetrahedralMesh(np.where(on_face, mesh.nodes, moved), mesh.tetrahedra)


def _delaunay() -> TetrahedralMesh:
    """Of scattered points, with the slivers that come of that."""
    points = _jittered(_box(5, 5, 5), 0.0003, seed=5).nodes
    corners = Delaunay(points).simplices
    a, b, c, d = np.moveaxis(points[corners], 1, 0)
    volume = signed_volumes(points, corners)
    corners[volume < 0] = corners[volume < 0][:, [0, 1, 3, 2]]
    longest = np.max([np.linalg.norm(p - q, axis=1) for p in (a, b, c, d) for q in (a, b, c)], 0)
    corners = corners[np.abs(volume) > _FLATTEST * longest**3]
    used, renumbered = np.unique(corners, return_inverse=True)
    return TetrahedralMesh(points[used], renumbered.reshape(corners.shape))


def _sliver() -> TetrahedralMesh:
    """A node pushed almost through the opposite faces: volumes down to 1e-6 of the edge cubed."""
    mesh = _box(4, 4, 4)
    nodes = mesh.nodes.copy()
    inner = int(np.argmin(np.linalg.norm(nodes - [0.017, 0.017, 0.027], axis=1)))
    beside = (mesh.tetrahedra == inner).any(axis=1)
    inwards = nodes[mesh.tetrahedra[beside][0]].mean(axis=0) - nodes[inner]
    nodes[inner] += 0.5 * inwards
    before = mesh.volumes[beside]
    slope = 2 * (TetrahedralMesh(nodes, mesh.tetrahedra).volumes[beside] - before)
    # Volumes change linearly with the distance, and the first to vanish ends it.
    shrinking = slope < 0
    furthest = ((before[shrinking] - 1e-10) / -slope[shrinking]).min()
    nodes[inner] += (furthest - 0.5) * inwards
    return TetrahedralMesh(nodes, mesh.tetrahedra)


def _tetrahedron() -> TetrahedralMesh:
    nodes = [[0.0, 0, 0], [0.04, 0, 0.05], [-0.02, -0.035, 0.05], [-0.02, 0.035, 0.05]]
    return TetrahedralMesh(np.array(nodes), np.array([[0, 2, 1, 3]]))


def _two_pieces() -> TetrahedralMesh:
    one = box_mesh([-0.05, -0.03, -0.01], [-0.02, 0.02], [0.0, 0.04, 0.08])
    other = one.nodes + np.array([0.06, 0.0, 0.0])
    return TetrahedralMesh(
        np.concatenate([one.nodes, other]),
        np.concatenate([one.tetrahedra, one.tetrahedra + len(other)]),
    )


def _slab() -> TetrahedralMesh:
    """A skin, 2 mm thick."""
    across = uniform_planes(-0.05, 0.05, 6)
    return box_mesh(across, across, uniform_planes(0.0, 0.002, 3))


MESHES: dict[str, Callable[[], TetrahedralMesh]] = {
    "box": lambda: _box(4, 4, 4),
    "fine": lambda: _box(6, 5, 5),
    "layered": _layered,
    "perturbed": lambda: _jittered(_box(5, 4, 5), 0.004, seed=3),
    "delaunay": _delaunay,
    "sliver": _sliver,
    "slab": _slab,
    "tetrahedron": _tetrahedron,
    "two pieces": _two_pieces,
    "millimetre": lambda: _box(4, 4, 4, 0.01),
    "ten metres": lambda: _box(4, 4, 4, 100.0),
}
"""The tissues by name."""
