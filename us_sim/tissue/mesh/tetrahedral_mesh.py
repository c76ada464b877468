"""Tetrahedral meshes: their settings, boxes made here, checks that solvers rely on, and repair."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from us_sim.errors import MeshError
from us_sim.geometry.mesh_faces import (
    FACES,
    MOST_NODES,
    find_boundary_faces,
    find_boundary_triangles,
    sort_faces,
)
from us_sim.geometry.pose import PLACE, Placement
from us_sim.settings.quantity import Quantity
from us_sim.settings.setting import Settings, setting
from us_sim.settings.spelling import format_count

_LEAST_NODES = 64
_MOST_ALONG = 400


@dataclass(frozen=True)
class MeshSettings(Settings):
    """A box of tetrahedra in ``patient``, or a mesh from a file."""

    section = "mesh"
    error = MeshError
    alternatives = MappingProxyType(
        {"file": ("unit", "pose", "margin"), "lower": ("upper", "nodes", "planes")}
    )

    lower: tuple[float, float, float] | None = setting(
        PLACE, "corner of the box with the least x, y, z", default=None
    )
    upper: tuple[float, float, float] | None = setting(
        PLACE, "corner of the box with the largest x, y, z", default=None
    )
    nodes: tuple[int, int, int] | int = setting(
        Quantity("number", 2, 200_000),
        "of the box along x, y, z; or one number, the most it has, closer together under the probe "
        "and where structures are thin",
        default=(20, 10, 10),
    )
    planes: dict[str, tuple[float, ...]] = setting(
        PLACE,
        "coordinates of the box's nodes along x, y or z, one by one",
        default_factory=dict,
    )
    file: str | None = setting(
        description="mesh in place of the box: Gmsh, VTK, or what else meshio reads",
        default=None,
        file=True,
    )
    unit: float = setting(
        Quantity("length", 1e-9, 1e3), "length of a unit of the file", default=1.0
    )
    pose: Placement = setting(description="of the file's frame in `patient`", default=Placement())
    margin: float | None = setting(
        Quantity("length", 1e-6, 1.0),
        "distance from a face of the file's bounding box within which boundary nodes belong to it; "
        "not given: a twentieth of the size along that axis",
        default=None,
    )

    def check(self) -> None:
        """Refuse what is neither a file nor a box whose corners and planes go together."""
        box = {"lower": self.lower, "upper": self.upper, "planes": self.planes or None}
        if self.file is not None:
            for key, value in box.items():
                if value is not None:
                    raise self.make_error("", f"has both `file` and `{key}`; keep one")
            return
        if self.lower is None or self.upper is None:
            raise self.make_error(
                "lower" if self.lower is None else "upper",
                "is missing; give the corners of a box, or a `file`",
            )
        if self.unit != 1.0 or self.pose != Placement() or self.margin is not None:
            raise self.make_error(
                "", "`unit`, `pose` and `margin` are for a mesh from a `file` only"
            )
        self._check_nodes()
        for name in self.planes:
            if name not in ("x", "y", "z"):
                raise self.make_error("planes", f"unknown axis `{name}`; axes are x, y and z")
        for axis, name in enumerate("xyz"):
            self._check_axis(axis, name, self.lower[axis], self.upper[axis])

    def _check_nodes(self) -> None:
        if isinstance(self.nodes, int):
            if self.planes:
                raise self.make_error(
                    "nodes", "must be three numbers where `planes` say where the nodes are"
                )
            if self.nodes < _LEAST_NODES:
                raise self.make_error(
                    "nodes", f"{self.nodes} make no box: give {_LEAST_NODES} or more"
                )
        elif max(self.nodes) > _MOST_ALONG:
            raise self.make_error(
                f"nodes[{self.nodes.index(max(self.nodes))}]",
                f"{max(self.nodes)} is outside 2 to {_MOST_ALONG}",
            )

    def _check_axis(self, axis: int, name: str, lower: float, upper: float) -> None:
        if lower >= upper:
            raise self.make_error(
                f"upper[{axis}]",
                f"{upper:g} m is not above tissue.mesh.lower[{axis}], {lower:g} m",
            )
        if name not in self.planes or isinstance(self.nodes, int):
            return
        planes, count = self.planes[name], self.nodes[axis]
        if len(planes) < 2 or any(b <= a for a, b in itertools.pairwise(planes)):
            raise self.make_error(f"planes.{name}", "needs two or more rising coordinates")
        ends = zip((planes[0], planes[-1]), (lower, upper), strict=True)
        if len(planes) != count or not all(math.isclose(a, b, abs_tol=1e-9) for a, b in ends):
            raise self.make_error(
                f"planes.{name}",
                f"must be {count} coordinates from {lower:g} to {upper:g} m, as nodes, lower and "
                f"upper say",
            )


EDGES = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])  # the six edges of a tetrahedron
_FARTHEST = 1e6  # Largest coordinate of a body, m; beyond it volumes would overflow
# Below this fraction of its longest edge cubed a tetrahedron's volume is rounding noise.
_SMALLEST_VOLUME = 1e-9


def check_mesh(nodes: NDArray[np.float64], tetrahedra: NDArray[np.integer]) -> None:
    """Refuse meshes that no solver could work on; disconnected parts are allowed.

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
            f"{format_count(len(idle), 'mesh node belongs', 'mesh nodes belong')} to no "
            f"tetrahedron, such as node {idle[0]}: remove them, or call `repair_mesh`"
        )
    _check_places(nodes)
    _check_volumes(nodes, tetrahedra)
    _check_faces(tetrahedra)


def check_arrays(nodes: NDArray[np.float64], tetrahedra: NDArray[np.integer]) -> None:
    """Refuse arrays that cannot be a mesh's, whatever is wrong with the mesh itself.

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
            f"{format_count(len(bad), 'mesh node is', 'mesh nodes are')} not finite, such as node "
            f"{bad[0]} at {nodes[bad[0]].tolist()}: give every node three numbers"
        )
    bad = np.flatnonzero((np.abs(nodes) > _FARTHEST).any(axis=1))
    if len(bad):
        raise MeshError(
            f"{format_count(len(bad), 'mesh node is', 'mesh nodes are')} farther than "
            f"{_FARTHEST:g} m away, such as node {bad[0]} at {nodes[bad[0]].tolist()}: give "
            f"coordinates in metres"
        )
    if tetrahedra.min() < 0 or tetrahedra.max() >= len(nodes):
        raise MeshError(
            f"tetrahedra name nodes {tetrahedra.min()} to {tetrahedra.max()}, but the mesh "
            f"has nodes 0 to {len(nodes) - 1}"
        )


def signed_volumes(
    nodes: NDArray[np.float64], tetrahedra: NDArray[np.integer]
) -> NDArray[np.float64]:
    """Return (M,) m3, negative for an inverted tetrahedron."""
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
            f"{format_count(len(same), 'mesh node lies', 'mesh nodes lie')} exactly where another "
            f"one lies, such as node {other} on node {node}: join them, or call `repair_mesh`"
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
            "order its nodes so that its volume is positive, or call `repair_mesh`",
        ),
    ):
        if len(bad):
            raise MeshError(
                f"{format_count(len(bad), 'tetrahedron is', 'tetrahedra are')} "
                f"{what}, such as tetrahedron {bad[0]} (volume {volumes[bad[0]]:.3g} m3): {remedy}"
            )


def _check_faces(tetrahedra: NDArray[np.integer]) -> None:
    """Refuse tetrahedra that do not meet face to face, two at a face, from its two sides."""
    whole = np.sort(tetrahedra, axis=1).astype(np.int64)
    order = np.lexsort((whole[:, 2] << 32 | whole[:, 3], whole[:, 0] << 32 | whole[:, 1]))
    same = np.flatnonzero((whole[order[1:]] == whole[order[:-1]]).all(axis=1))
    if len(same):
        raise MeshError(
            f"{format_count(len(same), 'tetrahedron is', 'tetrahedra are')} repeated, such as "
            f"tetrahedron {order[same[0] + 1]}, which has the nodes of tetrahedron "
            f"{order[same[0]]}: keep each once, or call `repair_mesh`"
        )
    order, starts, counts = sort_faces(tetrahedra)
    crowded = np.flatnonzero(counts > 2)
    if len(crowded):
        first = starts[crowded[0]]
        several = (order[first : first + counts[crowded[0]]] // 4).tolist()
        raise MeshError(
            f"the mesh is not manifold: "
            f"{format_count(len(crowded), 'face belongs', 'faces belong')} to more than two "
            f"tetrahedra, such as one of tetrahedra {', '.join(map(str, several))}: take out those "
            f"that overlap"
        )
    paired = starts[counts == 2]
    one, other = order[paired], order[paired + 1]
    folded = np.flatnonzero(_turn(tetrahedra, one) == _turn(tetrahedra, other))
    if len(folded):
        raise MeshError(
            f"{format_count(len(folded), 'pair of tetrahedra lies', 'pairs of tetrahedra lie')} on "
            f"the same side of the face they share, such as {one[folded[0]] // 4} and "
            f"{other[folded[0]] // 4}: they overlap, mend the mesh"
        )
    _check_hinges(tetrahedra, one // 4, other // 4)


def _turn(tetrahedra: NDArray[np.integer], numbers: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return whether faces name their nodes in an even permutation of ascending order."""
    a, b, c = tetrahedra[numbers[:, None] // 4, FACES[numbers % 4]].T
    return (a < b) ^ (b < c) ^ (a < c)


def _check_hinges(tetrahedra: NDArray, one: NDArray, other: NDArray) -> None:
    """Refuse parts that hang together by no face; pairs ``one``, ``other`` (P,) share one."""
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
            f"{format_count(len(hinges), 'node', 'nodes')} in all, such as node {node} between "
            f"tetrahedra {_with_node(tetrahedra, body == lowest[node], node)} and "
            f"{_with_node(tetrahedra, body == highest[node], node)}: join such parts by faces, or "
            f"give each its own nodes"
        )


def _with_node(tetrahedra: NDArray, among: NDArray, node: np.integer) -> np.intp:
    return np.flatnonzero(among & (tetrahedra == node).any(axis=1))[0]


# Five tetrahedra of a cell, as corner offsets: four at alternate corners and the one between.
_FIVE = np.array(
    [
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
        [[1, 1, 0], [0, 1, 0], [1, 0, 0], [1, 1, 1]],
        [[1, 0, 1], [0, 0, 1], [1, 1, 1], [1, 0, 0]],
        [[0, 1, 1], [1, 1, 1], [0, 0, 1], [0, 1, 0]],
        [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]],
    ]
)


@dataclass(frozen=True, eq=False)
class TetrahedralMesh:
    """Nodes and positively oriented tetrahedra; every node belongs to at least one.

    It may be in several parts that touch nowhere.

    Raises:
        MeshError: as `check_mesh`.
    """

    nodes: NDArray[np.float64]  # (N, 3), m, frame patient
    tetrahedra: NDArray[np.int32]  # (M, 4), indices into nodes
    planes: tuple[NDArray[np.float64], ...] | None = None  # m, of each axis, of a box mesh

    def __post_init__(self) -> None:
        nodes = np.array(self.nodes, dtype=np.float64, order="C")
        tetrahedra = np.array(self.tetrahedra, order="C")
        check_mesh(nodes, tetrahedra)
        object.__setattr__(self, "nodes", nodes)
        object.__setattr__(self, "tetrahedra", tetrahedra.astype(np.int32))

    @cached_property
    def volumes(self) -> NDArray[np.float64]:
        """(M,) m3, of each tetrahedron."""
        return signed_volumes(self.nodes, self.tetrahedra)

    @cached_property
    def edges(self) -> NDArray[np.int32]:
        """(E, 2) each edge once, the smaller node first, in lexicographic order."""
        ends = np.sort(self.tetrahedra[:, EDGES].reshape(-1, 2), axis=1).astype(np.int64)
        once = np.unique(ends[:, 0] << 32 | ends[:, 1])
        return np.column_stack([once >> 32, once & 0xFFFFFFFF]).astype(np.int32)

    @cached_property
    def boundary(self) -> NDArray[np.int32]:
        """(F, 3) triangles that belong to one tetrahedron only, normals pointing outward."""
        return find_boundary_triangles(self.tetrahedra)

    @cached_property
    def boundary_tetrahedra(self) -> NDArray[np.int32]:
        """(F,) the tetrahedron that each triangle of the boundary belongs to."""
        return (find_boundary_faces(self.tetrahedra) // 4).astype(np.int32)

    @cached_property
    def parts(self) -> NDArray[np.int64]:
        """(N,) which part each node belongs to, from 0; parts touch nowhere."""
        return connected_parts(len(self.nodes), *self.edges.T)


def uniform_planes(lo: float, hi: float, n: int) -> NDArray[np.float64]:
    """Return (n,) m, equally spaced mesh planes of one axis from ``lo`` to ``hi``.

    Raises:
        MeshError: fewer than two planes.
    """
    if n < 2:
        raise MeshError(f"a box mesh of {n} planes along an axis has no cells: give at least 2")
    return np.linspace(lo, hi, n)


def box_mesh(planes_x: ArrayLike, planes_y: ArrayLike, planes_z: ArrayLike) -> TetrahedralMesh:
    """Make a grid of cells, five tetrahedra each, mirrored in every other cell to conform.

    Node (i, j, k) has the index (i * len(planes_y) + j) * len(planes_z) + k.

    Args:
        planes_x: m, ascending coordinates of the node planes of x.
        planes_y: of y.
        planes_z: of z.

    Raises:
        MeshError: an axis has fewer than two planes, or they do not ascend.
    """
    planes = []
    for axis, values in zip("xyz", (planes_x, planes_y, planes_z), strict=True):
        coordinates = np.asarray(values, dtype=np.float64)
        if (
            coordinates.ndim != 1
            or len(coordinates) < 2
            or not np.isfinite(coordinates).all()
            or not (np.diff(coordinates) > 0).all()
        ):
            raise MeshError(
                f"the mesh planes along {axis} must be at least two finite ascending coordinates"
            )
        planes.append(coordinates)
    shape = tuple(len(coordinates) for coordinates in planes)
    nodes = np.stack(np.meshgrid(*planes, indexing="ij"), axis=-1).reshape(-1, 3)

    cells = np.indices([n - 1 for n in shape]).reshape(3, -1).T
    offsets = np.broadcast_to(_FIVE, (len(cells), 5, 4, 3)).copy()
    odd = cells.sum(axis=1) % 2 == 1
    offsets[odd, ..., 0] = 1 - offsets[odd, ..., 0]
    corners = cells[:, None, None, :] + offsets
    tetrahedra = np.ravel_multi_index(tuple(np.moveaxis(corners, -1, 0)), shape).reshape(-1, 4)
    mirrored = signed_volumes(nodes, tetrahedra) < 0
    tetrahedra[mirrored] = tetrahedra[mirrored][:, [0, 1, 3, 2]]
    return TetrahedralMesh(nodes, tetrahedra, tuple(planes))


def repair_mesh(nodes: ArrayLike, tetrahedra: ArrayLike) -> tuple[TetrahedralMesh, tuple[str, ...]]:
    """Make a mesh from nodes and tetrahedra that may be in disorder.

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
            `check_mesh` says. Its numbers are those after the repair.
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
            _format_repair("joined", len(places) - len(whole), "node", "with another in its place")
        )
        places = places[np.sort(first)]

    ordered = np.sort(corners, axis=1)
    collapsed = (ordered[:, 1:] == ordered[:, :-1]).any(axis=1)
    _, once = np.unique(ordered, axis=0, return_index=True)
    repeated = np.ones(len(corners), dtype=bool)
    repeated[once] = False
    for bad, what in ((collapsed, "that names a node twice"), (repeated & ~collapsed, "repeated")):
        if bad.any():
            report.append(_format_repair("left out", bad.sum(), "tetrahedron", what))
    corners = corners[~(collapsed | repeated)]

    used, renumbered = np.unique(corners, return_inverse=True)
    if len(used) < len(places):
        left_out = len(places) - len(used)
        report.append(_format_repair("left out", left_out, "node", "that no tetrahedron uses"))
        places, corners = places[used], renumbered.reshape(-1, 4)

    inverted = signed_volumes(places, corners) < 0
    if inverted.any():
        corners = corners.astype(np.int32)
        corners[inverted] = corners[inverted][:, [0, 1, 3, 2]]
        report.append(_format_repair("turned", int(inverted.sum()), "inverted tetrahedron"))
    try:
        return TetrahedralMesh(places, corners.astype(np.int32)), tuple(report)
    except MeshError as error:
        done = f" (after repair: {', '.join(report)})" if report else ""
        raise MeshError(f"{error}{done}") from error


def _format_repair(verb: str, count: int, thing: str, how: str = "") -> str:
    plural = thing.replace("tetrahedron", "tetrahedra") if "hedron" in thing else f"{thing}s"
    if count > 1:
        how = how.replace("names", "name").replace("its place", "their place")
    return f"{verb} {count} {thing if count == 1 else plural} {how}".rstrip()


def connected_parts(count: int, one: ArrayLike, other: ArrayLike) -> NDArray[np.int64]:
    """Return (count,) the part of each vertex, numbered from 0 by their first vertices.

    The vertices ``one`` and ``other`` (E,) are those that each edge joins.
    """
    from scipy.sparse import coo_array  # imported late: it takes a tenth of a second
    from scipy.sparse.csgraph import connected_components

    joined = coo_array((np.ones(np.size(one)), (one, other)), shape=(count, count))
    return np.asarray(connected_components(joined, directed=False)[1], dtype=np.int64)
