"""Tetrahedral meshes of organs from files that meshio reads, placed in frame ``patient``."""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError
from us_sim.geometry.mesh_file import read_with_meshio
from us_sim.geometry.pose import Pose
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, repair_mesh

_NO_MESH = (
    "this is not a tetrahedral mesh that can be read: give a Gmsh, VTK or VTU file, whole and of "
    "an unstructured grid"
)

_SURFACES = (".stl", ".obj", ".off", ".ply")  # which hold triangles and no tetrahedra
_IS_SURFACE = (
    "this is a surface, and tissue needs its inside as tetrahedra: mesh that, such as with Gmsh, "
    "and give the Gmsh, VTK or VTU file"
)

_SIZES = (1e-3, 2.5)  # Sizes of bodies, m: a smaller or larger one is in the wrong unit
_USUAL_SIZES = (0.01, 0.8)  # m, sizes of organs: any other is remarked on
# Cells that a volume mesh may hold beside tetrahedra: their corners, edges and faces.
_ON_THEIR_SURFACE = ("vertex", "line", "line3", "triangle", "triangle6", "polygon")


def read_mesh(
    path: Path | str, metres_per_unit: float = 1.0, pose: Pose | None = None
) -> tuple[TetrahedralMesh, tuple[str, ...]]:
    """Read a mesh from a Gmsh, VTK or VTU file, or any other with tetrahedra that meshio reads.

    Args:
        path: the file.
        metres_per_unit: the file's unit, 0.001 where it is in millimetres.
        pose: of the file's own frame in ``patient``.

    Returns:
        The mesh, and a sentence on each thing that was repaired or left out.

    Raises:
        MeshError: the file is missing, unreadable or without tetrahedra, its size cannot be that of
            a body, the mesh cannot be used, or meshio is needed and not installed.
    """
    path = Path(path)
    if not os.path.isfile(path):
        raise MeshError(f"{path}: there is no such mesh file")
    if not (math.isfinite(metres_per_unit) and metres_per_unit > 0):
        raise MeshError(f"{path}: metres_per_unit is {metres_per_unit!r}: give a number above zero")
    try:
        points, tetrahedra, left_out = _read(path)
        with np.errstate(over="ignore"):
            nodes = points * metres_per_unit
        if pose is not None:
            nodes = pose.transform_points(nodes)
        mesh, repaired = repair_mesh(nodes, tetrahedra)
        size = float(np.ptp(mesh.nodes, axis=0).max())
        if not _SIZES[0] <= size <= _SIZES[1]:
            raise MeshError(
                f"the mesh is {size:.3g} m long, and no body is: say what one unit of the file is, "
                f"in a scene by `tissue.mesh.unit`, such as `unit: 1 mm`"
            )
        if not _USUAL_SIZES[0] <= size <= _USUAL_SIZES[1]:
            repaired = (
                *repaired,
                f"it is {size:.3g} m long, where parts of a body are {100 * _USUAL_SIZES[0]:.0f} "
                f"to {100 * _USUAL_SIZES[1]:.0f} cm: is `tissue.mesh.unit` right?",
            )
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error
    return mesh, (*left_out, *repaired)


def _read(path: Path) -> tuple[NDArray[np.float64], NDArray[np.integer], tuple[str, ...]]:
    with path.open("rb") as file:
        if file.read(64).lstrip().startswith(b"$NOD"):
            raise MeshError(
                "the file is of Gmsh's format 1: save it as 4.1, by `gmsh FILE -save -format msh41 "
                "-o NEW.msh`"
            )
    if path.suffix.lower() in _SURFACES:
        raise MeshError(_IS_SURFACE)
    content = read_with_meshio(path, _NO_MESH)
    parts: list[NDArray[np.integer]] = []
    report = []
    for block in content.cells:
        if block.type == "tetra":
            parts.append(block.data)
        elif block.type == "tetra10":
            parts.append(block.data[:, :4])
            report.append(f"straightened the edges of {len(block.data)} quadratic tetrahedra")
        elif block.type not in _ON_THEIR_SURFACE and len(block.data):
            raise MeshError(
                f"the file has {len(block.data)} cells of type {block.type}: mesh the body with "
                f"tetrahedra only"
            )
    if not sum(map(len, parts)):
        raise MeshError(f"the file has no tetrahedra: {_IS_SURFACE}")
    points = np.asarray(content.points, dtype=np.float64)
    return points, np.concatenate(parts), tuple(report)
