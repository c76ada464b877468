"""Meshes of tissue, and surfaces."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Iterator
from pathlib import Path

import meshio
import numpy as np

from tests.fuzz.target import target
from us_sim.skin.surface import read_surface
from us_sim.tissue.mesh.file import read_mesh
from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh

PLANES = np.linspace(0.0, 0.1, 3)
BOX = box_mesh(PLANES, PLANES, PLANES)
SQUARE = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0], [0.2, 0.2, 0.1]])
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3], [1, 4, 2]])

GMSH_1 = """$NOD
5
1 0 0 0
2 .1 0 0
3 0 .1 0
4 0 0 .1
7 .1 .1 .1
$ENDNOD
$ELM
3
1 2 1 1 3 1 2 3
2 4 1 1 4 1 2 3 4
3 4 1 1 4 2 3 4 7
$ENDELM
"""


def written(
    mesh: meshio.Mesh, suffix: str, *ways: dict[str, object]
) -> Callable[[Path], Iterator[bytes]]:
    """Makes files of a mesh by meshio."""

    def seeds(folder: Path) -> Iterator[bytes]:
        file = folder / f"mesh{suffix}"
        for way in ways or ({},):
            with contextlib.redirect_stdout(io.StringIO()):
                meshio.write(file, mesh, **way)
            yield file.read_bytes()

    return seeds


def gmsh_seeds(folder: Path) -> Iterator[bytes]:
    """Of every version that is read."""
    yield GMSH_1.encode()
    ways = [{"file_format": f, "binary": b} for f in ("gmsh22", "gmsh") for b in (False, True)]
    yield from written(SOLID, ".msh", *ways)(folder)


def mesh(path: Path) -> None:
    """Tetrahedra with a volume."""
    read, _ = read_mesh(path)
    assert np.isfinite(read.nodes).all()
    assert read.volumes.min() > 0


def surface(path: Path) -> None:
    """Triangles of vertices that are there."""
    read = read_surface(path)
    assert np.isfinite(read.vertices).all()
    assert len(read.triangles)


SOLID = meshio.Mesh(BOX.nodes, [("tetra", BOX.tetrahedra)])
SHEET = meshio.Mesh(SQUARE, [("triangle", TRIANGLES)])
BINARY = ({"binary": False}, {"binary": True})

target("gmsh", ".msh", gmsh_seeds)(mesh)
target("vtk", ".vtk", written(SOLID, ".vtk", *BINARY))(mesh)
target("vtu", ".vtu", written(SOLID, ".vtu", *BINARY))(mesh)
target("medit", ".mesh", written(SOLID, ".mesh"))(mesh)
target("obj", ".obj", written(SHEET, ".obj"))(surface)
target("stl", ".stl", written(SHEET, ".stl", *BINARY))(surface)
target("ply", ".ply", written(SHEET, ".ply", *BINARY))(surface)
