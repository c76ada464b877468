"""Tetrahedral meshes of organs from files, placed in frame ``patient``.

Gmsh's own formats are read here, after its reference manual ("MSH file format", 4.1, and the
legacy versions 1 and 2): meshio 5.3 takes a tetrahedron's node 0 for the last node of the file and
refuses version 1, which older organ meshes come in. meshio reads all other formats.

>>> import tempfile
>>> from pathlib import Path
>>> from us_sim.tissue.mesh.file import read_mesh
>>> file = Path(tempfile.mkdtemp()) / "corner.msh"
>>> _ = file.write_text("$NOD\\n4\\n1 0 0 0\\n2 90 0 0\\n3 0 90 0\\n4 0 0 90\\n$ENDNOD\\n"
...                     "$ELM\\n1\\n1 4 1 1 4 1 2 3 4\\n$ENDELM\\n")
>>> mesh, report = read_mesh(file, metres_per_unit=0.001)
>>> f"{mesh.volumes.sum() * 1e6:.1f} ml"
'121.5 ml'
"""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError
from us_sim.geometry.mesh_file import read_with_meshio
from us_sim.geometry.pose import Pose
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, repair

VERSIONS = ("2", "2.1", "2.2", "4.1")
# How many nodes an element has: points, lines and triangles, and tetrahedra (4 and 11).
_NODES_OF = {1: 2, 2: 3, 8: 3, 9: 6, 15: 1, 4: 4, 11: 10}
_TETRAHEDRA = (4, 11)
Rows = list[tuple[int, NDArray[np.int64]]]  # Elements by type, and the numbers of their nodes


def parse_gmsh(content: bytes) -> tuple[NDArray[np.float64], NDArray[np.int64], int]:
    """The tetrahedra of a file; of quadratic ones the corners.

    Returns:
        Points (N, 3) in the file's unit, tetrahedra (M, 4) as rows of points, and how many of them
        are quadratic in the file.

    Raises:
        MeshError: a part is missing, shorter or longer than it says or not made of numbers, an
            element is of another kind of volume, or one names a node that is not there.
    """
    words = _part(content, b"MeshFormat").split(None, 3)
    version, binary = words[0].decode("latin-1"), words[1:2] == [b"1"]
    if version not in VERSIONS or words[2:3] != [b"8"]:
        raise MeshError(f"the file is of Gmsh's format {version}: save it as version 4.1 or 2.2")
    nodes = _Numbers(_part(content, b"Nodes"), binary)
    elements = _Numbers(_part(content, b"Elements"), binary)
    if version == "4.1":
        numbers, points = _nodes_of_blocks(nodes)
        rows = _elements_of_blocks(elements)
    else:
        numbers, points = _nodes_one_by_one(nodes)
        rows = _elements_one_by_one(elements)
    if nodes.left or elements.left:
        raise MeshError("a part of the file holds more than it says")
    corners = [named[:, :4] for kind, named in rows if kind in _TETRAHEDRA]
    if not sum(map(len, corners)):
        raise MeshError(
            "the file has no tetrahedra: give a mesh of the body's volume, not of its surface"
        )
    tetrahedra = row_numbers(numbers, np.concatenate(corners))
    return points, tetrahedra, sum(len(named) for kind, named in rows if kind == 11)


def _part(content: bytes, name: bytes) -> bytes:
    """The bytes between ``$Name`` and ``$EndName``."""
    _, found, rest = content.partition(b"$" + name)
    # Numbers in binary may look like the end; but the true end is the last one.
    body, closed, _ = rest.rpartition(b"$End" + name)
    if not (found and closed and body.strip()):
        raise MeshError(f"the file has no whole part ${name.decode()} … $End{name.decode()}")
    return body.removeprefix(b"\r").removeprefix(b"\n")


class _Numbers:
    """The numbers of a part one after the other: words of a text, or bytes."""

    def __init__(self, part: bytes, binary: bool) -> None:
        self.binary = binary
        self._part = part
        self._at = 0
        if not binary:
            try:
                self._words = np.array(part.split(), dtype=np.float64)
            except ValueError as error:
                raise MeshError(
                    f"the file has something else where a number should be: {str(error)[:100]}"
                ) from error

    @property
    def left(self) -> bool:
        """Whether there are more numbers."""
        if self.binary:
            return bool(self._part[self._at :].strip())
        return self._at < len(self._words)

    def count(self) -> int:
        """A count that stands in a line of its own, as text even in a binary file."""
        if not self.binary:
            return int(self.whole("u8", 1)[0])
        line, _, _ = self._part[self._at :].partition(b"\n")
        self._at += len(line) + 1
        if not line.strip().isdigit() or len(line) > 20:
            raise MeshError("the file has something else where a count should be")
        return int(line)

    def take(self, kind: str, count: int) -> NDArray[np.generic]:
        """The next numbers of a type."""
        width = np.dtype(kind).itemsize if self.binary else 1
        length = len(self._part) if self.binary else len(self._words)
        if count * width > length - self._at:
            raise MeshError("a part of the file holds fewer numbers than it says")
        begin = self._at
        self._at += count * width
        if self.binary:
            taken: NDArray[np.generic] = np.frombuffer(self._part[begin : self._at], f"<{kind}")
            return taken
        return self._words[begin : self._at]

    def whole(self, kind: str, count: int) -> NDArray[np.int64]:
        """The next whole numbers, each below 2^53."""
        taken: NDArray[Any] = self.take(kind, count)
        if not (np.abs(taken.astype(np.float64)) < 2.0**53).all() or (taken % 1 != 0).any():
            raise MeshError("the file has no whole number where one should be")
        return taken.astype(np.int64)


def _nodes_of_blocks(numbers: _Numbers) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    blocks, total, *_ = numbers.whole("u8", 4)
    named, points = [np.empty(0, np.int64)], [np.empty((0, 3))]
    for _ in range(blocks):
        _, _, parametric = numbers.whole("i4", 3)
        (count,) = numbers.whole("u8", 1)
        if parametric:
            raise MeshError("the file has parametric nodes: save it without them")
        named.append(numbers.whole("u8", count))
        points.append(numbers.take("f8", 3 * count).astype(np.float64).reshape(-1, 3))
    if sum(map(len, named)) != total:
        raise MeshError(f"the file says it has {total} nodes, and holds {sum(map(len, named))}")
    return np.concatenate(named), np.concatenate(points)


def _elements_of_blocks(numbers: _Numbers) -> Rows:
    blocks, total, *_ = numbers.whole("u8", 4)
    rows: Rows = []
    for _ in range(blocks):
        _, _, kind = numbers.whole("i4", 3)
        (count,) = numbers.whole("u8", 1)
        width = 1 + _width(kind)
        rows.append((int(kind), numbers.whole("u8", count * width).reshape(-1, width)[:, 1:]))
    held = sum(len(named) for _, named in rows)
    if held != total:
        raise MeshError(f"the file says it has {total} elements, and holds {held}")
    return rows


def _nodes_one_by_one(numbers: _Numbers) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    count = numbers.count()
    if numbers.binary:
        row = np.dtype([("number", "<i4"), ("place", "<f8", 3)])
        data = numbers.take("u1", count * row.itemsize).tobytes()
        rows = np.frombuffer(data, row)
        return rows["number"].astype(np.int64), rows["place"]
    table = numbers.take("f8", 4 * count).astype(np.float64).reshape(-1, 4)
    if (table[:, 0] % 1 != 0).any() or not (np.abs(table[:, 0]) < 2.0**53).all():
        raise MeshError("a node of the file does not begin with a whole number")
    return table[:, 0].astype(np.int64), table[:, 1:]


def _elements_one_by_one(numbers: _Numbers) -> Rows:
    total = numbers.count()
    found: dict[int, list[NDArray[np.int64]]] = {}
    done = 0
    while done < total:
        if numbers.binary:
            kind, count, tags = numbers.whole("i4", 3)
            if count < 1:
                raise MeshError("the file has a block of no elements")
        else:
            _, kind, tags = numbers.whole("i4", 3)
            count = np.int64(1)
        width = _width(kind)
        if not 0 <= tags < 100:
            raise MeshError(f"an element of the file has {tags} tags")
        skip = tags + int(numbers.binary)  # in binary its own number is here, too
        block = numbers.whole("i4", count * (skip + width)).reshape(count, -1)
        found.setdefault(int(kind), []).append(block[:, skip:])
        done += int(count)
    return [(kind, np.concatenate(blocks)) for kind, blocks in found.items()]


def _width(kind: np.int64) -> int:
    if int(kind) not in _NODES_OF:
        raise MeshError(
            f"the file has elements of Gmsh's type {kind}: mesh the body with tetrahedra only"
        )
    return _NODES_OF[int(kind)]


def row_numbers(numbers: NDArray[np.int64], corners: NDArray[np.int64]) -> NDArray[np.int64]:
    """The rows of the nodes that corners name by their numbers.

    Raises:
        MeshError: two nodes have one number, or a corner is no node.
    """
    order = np.argsort(numbers, kind="stable")
    twice = np.flatnonzero(np.diff(numbers[order]) == 0)
    if len(twice):
        raise MeshError(f"two nodes of the file have the number {numbers[order[twice[0]]]}")
    if not len(numbers):
        raise MeshError("the file has no nodes")
    place = order[np.searchsorted(numbers, corners, sorter=order).clip(0, len(numbers) - 1)]
    lost = corners[numbers[place] != corners]
    if len(lost):
        raise MeshError(f"a tetrahedron of the file names node {lost[0]}, which is not there")
    return place


_TETRAHEDRON = 4
_ON_ITS_SURFACE = (1, 2, 15)


def parse_gmsh_one(text: str) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Points (N, 3) in the file's unit, and tetrahedra (M, 4) as rows of points.

    Raises:
        MeshError: a part is missing, shorter than it says or not made of numbers, an element is
            of another kind of volume, or one names a node that is not there.
    """
    rows = [row.split() for row in _lines(text, "$NOD", "$ENDNOD")]
    if any(len(row) != 4 for row in rows):
        raise MeshError("a node of the file is not a number and three coordinates")
    try:
        numbers = np.array([int(row[0]) for row in rows], dtype=np.int64)
        points = np.array([row[1:] for row in rows], dtype=np.float64).reshape(-1, 3)
        elements = [[int(word) for word in row.split()] for row in _lines(text, "$ELM", "$ENDELM")]
        largest = max((max(element) for element in elements), default=0)
        if largest > np.iinfo(np.int64).max:
            raise OverflowError(f"{largest} is no node")
    except (ValueError, OverflowError) as error:
        raise MeshError(f"the file has something else where a number should be: {error}") from error
    if any(len(element) < 6 or len(element) != 5 + element[4] for element in elements):
        raise MeshError("an element of the file has more or fewer nodes than it says")
    other = {element[1] for element in elements} - {_TETRAHEDRON, *_ON_ITS_SURFACE}
    if other:
        raise MeshError(
            f"the file has elements of Gmsh's type {min(other)}: mesh the body with linear "
            f"tetrahedra (type {_TETRAHEDRON}) only"
        )
    named = [element[5:] for element in elements if element[1] == _TETRAHEDRON]
    if any(len(corners) != 4 for corners in named):
        raise MeshError("a tetrahedron of the file does not have four nodes")
    if not named:
        raise MeshError("the file has no tetrahedra")
    tetrahedra = row_numbers(numbers, np.array(named))
    return points, tetrahedra


def _lines(text: str, begin: str, end: str) -> list[str]:
    """The lines of a part, without the first, which says how many they are."""
    _, found, rest = text.partition(begin)
    body, closed, _ = rest.partition(end)
    if not (found and closed):
        raise MeshError(f"the file has no whole part {begin} … {end}")
    lines = body.split("\n")
    lines = [line for line in map(str.strip, lines) if line]
    if not lines or not lines[0].isdecimal() or int(lines[0]) != len(lines) - 1:
        raise MeshError(
            f"the part {begin} of the file has {max(len(lines) - 1, 0)} lines, but says "
            f"{lines[0] if lines else 'nothing'}"
        )
    if len(lines) == 1:
        raise MeshError(f"the part {begin} of the file is empty")
    return lines[1:]


_NO_MESH = (
    "this is not a tetrahedral mesh that can be read: give a Gmsh, VTK or VTU file, whole and of "
    "an unstructured grid"
)

_SIZES = (1e-3, 2.5)  # Sizes of bodies, m: a smaller or larger one is in the wrong unit
_USUAL_SIZES = (0.01, 0.8)  # m, sizes of organs: any other is remarked on
# Cells that a volume mesh may hold beside tetrahedra: their corners, edges and faces.
_ON_THEIR_SURFACE = ("vertex", "line", "line3", "triangle", "triangle6", "polygon")


def read_mesh(
    path: Path | str, metres_per_unit: float = 1.0, pose: Pose | None = None
) -> tuple[TetrahedralMesh, tuple[str, ...]]:
    """A mesh from a Gmsh, VTK or VTU file, or any other with tetrahedra that meshio reads.

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
            nodes = pose.apply(nodes)
        mesh, repaired = repair(nodes, tetrahedra)
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
        start = file.read(64).lstrip()
    if start.startswith(b"$NOD"):
        return *parse_gmsh_one(path.read_text(encoding="utf-8", errors="replace")), ()
    if start.startswith(b"$MeshFormat") and _version(start) in VERSIONS:
        points, tetrahedra, quadratic = parse_gmsh(path.read_bytes())
        return points, tetrahedra, (_straightened(quadratic),) if quadratic else ()
    content = read_with_meshio(path, _NO_MESH)
    parts: list[NDArray[np.integer]] = []
    report = []
    for block in content.cells:
        if block.type == "tetra":
            parts.append(block.data)
        elif block.type == "tetra10":
            parts.append(block.data[:, :4])
            report.append(_straightened(len(block.data)))
        elif block.type not in _ON_THEIR_SURFACE and len(block.data):
            raise MeshError(
                f"the file has {len(block.data)} cells of type {block.type}: mesh the body with "
                f"tetrahedra only"
            )
    if not sum(map(len, parts)):
        raise MeshError(
            "the file has no tetrahedra: give a mesh of the body's volume, not of its surface"
        )
    points = np.asarray(content.points, dtype=np.float64)
    return points, np.concatenate(parts), tuple(report)


def _version(start: bytes) -> str:
    return b" ".join(start.split()[1:2]).decode("latin-1")


def _straightened(count: int) -> str:
    return f"straightened the edges of {count} quadratic tetrahedra"
