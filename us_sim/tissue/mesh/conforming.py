"""A box of tetrahedra whose faces follow closed surfaces in it, by the mesher fTetWild.

Surfaces may reach beyond the box, which cuts them. Nodes on the box's faces lie in them exactly.
fTetWild makes a somewhat different mesh in every run. A surface of few flat triangles, within a
tolerance of a round one, encloses too little: `with_inside_volume` corrects that.
"""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError
from us_sim.geometry.mesh_faces import boundary_triangles
from us_sim.geometry.triangles import vertex_normals
from us_sim.tissue.mesh import wild_mesher
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, repair, signed_volumes

_SECONDS = 300.0  # After which fTetWild is given up; meshes of some thousand nodes take it seconds
# Size of all over the longest edge asked for: fTetWild begins with a grid that reaches as far
# beyond the box as an edge is long, and joins its tetrahedra where they may be longer at the end.
_LONGEST = 10.0
# Triangles of a box whose corner is 4 (x is high) + 2 (y is high) + (z is high).
_BOX = np.array(
    [
        *([0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]),
        *([2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]),
    ],
    dtype=np.int32,
)

_GRID = "`mesh: grid` in the case, `kind: grid` in a scene's tissue.mesh"


@dataclass(frozen=True, eq=False)
class EdgeLengths:
    """How long edges should be, at the nodes of a coarse mesh and between them."""

    mesh: TetrahedralMesh
    lengths: NDArray[np.float64]  # (N,) m


def require_mesher() -> None:
    """Refuse at once where the mesher is not installed.

    Raises:
        MeshError: pytetwild is missing.
    """
    if importlib.util.find_spec("pytetwild") is None:
        raise MeshError(
            "a conforming mesh needs pytetwild; install it with `pip install "
            f"'us_sim[conforming]'`, or say {_GRID}"
        )


def conforming_mesh(
    box: NDArray[np.float64],
    surfaces: Sequence[tuple[NDArray[np.float64], NDArray[np.int32]]],
    edges: EdgeLengths,
    tolerance: float,
    *,
    coarsen: bool = False,
) -> TetrahedralMesh:
    """Tetrahedra that fill a box, none of which crosses a surface by more than the tolerance.

    Args:
        box: (2, 3) m, lower and upper corner.
        surfaces: (V, 3) m vertices and (T, 3) triangles of each.
        edges: lengths that are aimed at.
        tolerance: m, how far faces may lie from a surface.
        coarsen: whether tetrahedra are joined wherever their shape allows it, for the fewest nodes.

    Raises:
        MeshError: pytetwild is missing, or fTetWild fails, or takes longer than five minutes.
    """
    require_mesher()
    corners = np.stack(np.meshgrid(*box.T, indexing="ij"), axis=-1).reshape(-1, 3)
    vertices, triangles, count = [corners], [_BOX], len(corners)
    for points, faces in surfaces:
        vertices.append(points)
        triangles.append(faces + count)
        count += len(points)
    soup = np.concatenate(vertices)
    diagonal = float(np.linalg.norm(np.ptp(soup, axis=0)))
    nodes, tetrahedra = _run(
        {
            "vertices": soup,
            "triangles": np.concatenate(triangles).astype(np.int32),
            "edge": np.array(min(edges.lengths.max(), diagonal / _LONGEST)),
            "coarsen": np.array(coarsen),
            "epsilon": np.array(tolerance / diagonal),
            "size_nodes": edges.mesh.nodes,
            "size_tetrahedra": edges.mesh.tetrahedra,
            "sizes": np.minimum(edges.lengths, diagonal / _LONGEST),
        }
    )
    return _within(box, nodes, tetrahedra, tolerance)


def _run(arrays: dict[str, Any]) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder).resolve()
        given, made = place / "given.npz", place / "made.npz"
        np.savez(given, **arrays)
        # -P: this folder is no place to import from.
        command = [sys.executable, "-P", str(Path(wild_mesher.__file__)), str(given), str(made)]
        try:
            # fTetWild leaves files of its own where it runs.
            done = subprocess.run(
                command, capture_output=True, timeout=_SECONDS, check=False, cwd=place
            )
        except subprocess.TimeoutExpired as error:
            raise MeshError(
                f"fTetWild made no mesh of these structures in {_SECONDS:g} s: allow fewer nodes, "
                f"smooth their labels, or say {_GRID}"
            ) from error
        if done.returncode != 0 or not made.is_file():
            words = done.stderr.decode(errors="replace").strip().splitlines()
            why = words[-1] if words else f"it ended with status {done.returncode}"
            raise MeshError(
                f"fTetWild made no mesh of these structures ({why[:200]}): smooth their labels, "
                f"or say {_GRID}"
            )
        with np.load(made, allow_pickle=False) as stored:
            return stored["nodes"].astype(np.float64), stored["tetrahedra"].astype(np.int32)


def _within(box: NDArray, nodes: NDArray, tetrahedra: NDArray, tolerance: float) -> TetrahedralMesh:
    """The tetrahedra in the box, with the nodes of its faces moved into them.

    Raises:
        MeshError: they do not fill the box, or cannot be used.
    """
    if len(tetrahedra):
        middle = nodes[tetrahedra].mean(axis=1)
        tetrahedra = tetrahedra[((middle > box[0]) & (middle < box[1])).all(axis=1)]
    if not len(tetrahedra):
        raise MeshError(f"fTetWild made no tetrahedra of this box: say {_GRID}")
    on_boundary = np.unique(boundary_triangles(tetrahedra))
    flat = np.zeros(len(tetrahedra), dtype=bool)
    for axis in range(3):
        for end in box[:, axis]:
            near = on_boundary[np.abs(nodes[on_boundary, axis] - end) <= tolerance]
            nodes[near, axis] = end
            in_face = np.zeros(len(nodes), dtype=bool)
            in_face[near] = True
            flat |= in_face[tetrahedra].all(axis=1)
    tetrahedra = tetrahedra[~flat]
    try:
        mesh, _ = repair(nodes, tetrahedra)
    except MeshError as error:
        raise MeshError(f"the mesh that fTetWild made cannot be used ({error}): say {_GRID}") from (
            error
        )
    filled = mesh.volumes.sum() / np.prod(box[1] - box[0])
    if abs(filled - 1.0) > 1e-6:
        raise MeshError(f"fTetWild filled {100 * filled:.4g} % of the box: say {_GRID}")
    return mesh


_STEPS = 3
_HALVINGS = 4
_LEFT = 0.2  # Part of a tetrahedron's volume that it keeps in one step


def with_inside_volume(
    mesh: TetrahedralMesh, inside: NDArray[np.bool_], volume: float
) -> TetrahedralMesh:
    """The mesh with its interface moved alike along its normals until a part has a volume.

    Nodes on the faces of the mesh's bounding box stay in them. Where tetrahedra are too flat for
    all of the way, some of it is gone.

    Args:
        mesh: of a box.
        inside: (M,) the tetrahedra of the part.
        volume: m³, that they should have together.
    """
    nodes = mesh.nodes.copy()
    on_face = [nodes == bound for bound in (nodes.min(axis=0), nodes.max(axis=0))]
    triangles = boundary_triangles(mesh.tetrahedra[inside])
    cap = np.zeros(len(triangles), dtype=bool)
    for on in on_face:
        cap |= on[triangles].all(axis=1).any(axis=1)
    triangles = triangles[~cap]
    if not len(triangles):
        return mesh
    moved = np.unique(triangles)
    for _ in range(_STEPS):
        before = signed_volumes(nodes, mesh.tetrahedra)
        a, b, c = (nodes[triangles[:, corner]] for corner in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0
        normals = np.zeros_like(nodes)
        normals[moved] = vertex_normals(nodes, triangles)[moved]
        normals[on_face[0] | on_face[1]] = 0.0
        step = (volume - before[inside].sum()) / area
        for _ in range(_HALVINGS):
            tried = nodes + step * normals
            if (signed_volumes(tried, mesh.tetrahedra) > _LEFT * before).all():
                nodes = tried
                break
            step /= 2.0
    return TetrahedralMesh(nodes, mesh.tetrahedra)
