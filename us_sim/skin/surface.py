"""Triangle surfaces of the skin: sheets made here, or read from a file.

Of Wavefront OBJ files only positions and faces are read here: meshio 5.3 refuses three of five real
organs, whose texture coordinates and normals have counts of their own, and trimesh 4 takes vertex
0, which no file has, for the first one.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError
from us_sim.geometry.mesh_file import read_with_meshio
from us_sim.settings.spelling import short_repr

_CORNERS = {"triangle": 3, "quad": 4}


@dataclass(frozen=True, eq=False)
class TriangleSurface:
    """Vertices and triangles, wound so that their normals point out of the body.

    Raises:
        MeshError: a vertex is not finite, an index is out of range, or there is no triangle.
    """

    vertices: NDArray[np.float64]  # (N, 3), m, frame patient
    triangles: NDArray[np.int32]  # (T, 3), indices into vertices, each of which is in one

    def __post_init__(self) -> None:
        vertices = np.array(self.vertices, dtype=np.float64, order="C")
        triangles = np.array(self.triangles, dtype=np.int32, order="C")
        finite = np.isfinite(vertices).all(axis=1)
        if not finite.all():
            bad = int(np.argmin(finite))
            raise MeshError(f"surface vertex {bad} is not finite: {vertices[bad].tolist()}")
        if not triangles.size:
            raise MeshError("the surface has no triangles")
        if triangles.min() < 0 or triangles.max() >= len(vertices):
            raise MeshError(
                f"surface triangles name vertices {triangles.min()} to {triangles.max()}, but "
                f"there are only {len(vertices)}"
            )
        vertices.flags.writeable = False
        triangles.flags.writeable = False
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "triangles", triangles)

    @cached_property
    def edges(self) -> NDArray[np.int32]:
        """(E, 2) each edge once, lower index first, in ascending order."""
        sides = np.concatenate([self.triangles[:, [0, 1]], self.triangles[:, [1, 2]],
                                self.triangles[:, [2, 0]]])  # fmt: skip
        return np.unique(np.sort(sides, axis=1), axis=0)

    @cached_property
    def vertex_areas(self) -> NDArray[np.float64]:
        """(N,) m², a third of the area of each triangle at a vertex."""
        a, b, c = self.vertices[self.triangles.T]
        areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        around = np.zeros(len(self.vertices))
        np.add.at(around, self.triangles, areas[:, None] / 3)
        return around


def plane_surface(size: tuple[float, float], spacing: float) -> TriangleSurface:
    """Make a flat sheet in z = 0 around the origin, with normals along -z, out of the body.

    Args:
        size: m, along x and y.
        spacing: m, the greatest distance of neighbours along x or y.

    Raises:
        MeshError: the sheet would have over four million vertices.
    """
    x, y = _steps(size[0], spacing), _steps(size[1], spacing)
    return _sheet(np.column_stack([x, np.zeros_like(x)]), y)


def bent_surface(
    size: tuple[float, float], spacing: float, *, flat_width: float, radius: float
) -> TriangleSurface:
    """Make an arm-like sheet: flat in the middle, then bent towards +z in an arc on both sides.

    Args:
        size: m, along x (measured on the sheet, as if it were unrolled) and along y.
        spacing: m, the greatest distance of neighbours along the sheet.
        flat_width: m along x, the part around x = 0 that lies in z = 0.
        radius: m, of the arcs; each spans ``(size[0] - flat_width) / (2 radius)`` radians.

    Raises:
        MeshError: an arc is more than half a circle, or there would be too many vertices.
    """
    if (size[0] - flat_width) / (2 * radius) > math.pi:
        raise MeshError(
            f"the sheet's sides of {(size[0] - flat_width) / 2:g} m are more than half a circle "
            f"of radius {radius:g} m: give a larger radius or a smaller size"
        )
    along, y = _steps(size[0], spacing), _steps(size[1], spacing)
    flat = np.clip(along, -flat_width / 2, flat_width / 2)
    angle = (along - flat) / radius
    profile = np.column_stack([flat + radius * np.sin(angle), radius * (1 - np.cos(angle))])
    return _sheet(profile, y)


def read_surface(path: Path | str, metres_per_unit: float = 1.0) -> TriangleSurface:
    """Read a surface from an OBJ file, or from an STL, PLY or VTK file by meshio.

    Quadrilaterals are split, vertices in the same place are joined, and those in no triangle are
    left out.

    Args:
        path: the file, in frame ``patient``.
        metres_per_unit: the file's unit, 0.001 where it is in millimetres.

    Raises:
        MeshError: the file is missing, unreadable or without triangles, or meshio is needed and
            not installed.
    """
    path = Path(path)
    if not os.path.isfile(path):
        raise MeshError(f"{path}: there is no such surface file")
    faces: NDArray[np.integer]
    try:
        if path.suffix.lower() == ".obj":
            points, faces = parse_wavefront(path.read_text(encoding="utf-8", errors="replace"))
        else:
            points, faces = _faces_by_meshio(path)
        places, joined = np.unique(points, axis=0, return_inverse=True)
        triangles = joined.reshape(-1)[faces]
        proper = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
        used, triangles = np.unique(triangles[proper], return_inverse=True)
        return TriangleSurface(
            places[used] * metres_per_unit, triangles.reshape(-1, 3).astype(np.int32)
        )
    except MeshError as error:
        raise MeshError(f"{path}: {error}") from error


def _faces_by_meshio(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    mesh = read_with_meshio(
        path, "this is not a surface that can be read: give an OBJ, STL, PLY or VTK file"
    )
    parts = [np.empty((0, 3), dtype=np.int64)]
    for block in mesh.cells:
        if block.type in _CORNERS and block.data.shape[1:] != (_CORNERS[block.type],):
            raise MeshError(f"the file has a {block.type} of {block.data.shape[1:]} corners")
        if block.type == "triangle":
            parts.append(block.data.astype(np.int64))
        elif block.type == "quad":
            quads = block.data.astype(np.int64)
            parts += [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
    points = np.asarray(mesh.points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise MeshError(f"the file has points of shape {points.shape}: give three coordinates")
    return points, np.concatenate(parts)


def _steps(length: float, spacing: float) -> NDArray[np.float64]:
    """Return evenly spaced coordinates over a length around 0, at most ``spacing`` apart."""
    count = math.ceil(length / spacing - 1e-9)
    if count > 2000:
        raise MeshError(
            f"the sheet would have {count} steps of {spacing:g} m along {length:g} m: give a "
            f"wider spacing"
        )
    return length * (np.arange(count + 1) / count - 0.5)


def _sheet(profile: NDArray[np.float64], y: NDArray[np.float64]) -> TriangleSurface:
    """Sweep a profile (M, 2) of x and z along y to a sheet, with alternating diagonals."""
    m, n = len(profile), len(y)
    vertices = np.empty((m, n, 3))
    vertices[:, :, 0] = profile[:, :1]
    vertices[:, :, 1] = y
    vertices[:, :, 2] = profile[:, 1:]
    index = np.arange(m * n).reshape(m, n)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    even = (np.add.outer(np.arange(m - 1), np.arange(n - 1)) % 2 == 0)[..., None]
    # Diagonals that alternate give the springs no preferred direction across the sheet.
    first = np.where(even, np.stack([a, c, b], -1), np.stack([a, d, b], -1))
    second = np.where(even, np.stack([a, d, c], -1), np.stack([b, d, c], -1))
    triangles = np.stack([first, second], axis=2).reshape(-1, 3)
    return TriangleSurface(vertices.reshape(-1, 3), triangles.astype(np.int32))


def parse_wavefront(text: str) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return points (N, 3), in the file's unit, and triangles (T, 3); polygons become fans.

    Raises:
        MeshError: a vertex without three numbers, a face of fewer than three vertices, or one that
            names a vertex that is not there; with the line's number.
    """
    points: list[list[float]] = []
    triangles: list[tuple[int, int, int]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        try:
            if words[:1] == ["v"]:
                points.append([float(word) for word in words[1:4]])
                if len(points[-1]) != 3:
                    raise ValueError("a vertex has three coordinates")
            elif words[:1] == ["f"]:
                face = [_index(word.split("/")[0], len(points)) for word in words[1:]]
                if len(face) < 3:
                    raise ValueError("a face has three vertices or more")
                triangles += [(face[0], b, c) for b, c in pairwise(face[1:])]
        except ValueError as error:
            raise MeshError(
                f"line {number}: {short_repr(line.strip())}: {str(error)[:100]}"
            ) from error
    return (
        np.array(points, dtype=np.float64).reshape(-1, 3),
        np.array(triangles, dtype=np.int32).reshape(-1, 3),
    )


def _index(word: str, count: int) -> int:
    index = int(word)
    if not (1 <= index <= count or -count <= index <= -1):
        raise ValueError(f"there is no vertex {index} among the {count} so far")
    return index - 1 if index > 0 else count + index
