"""Tetrahedra in the second and fourth version of Gmsh's file format, as text or binary.

Every number is taken from the file or refused: node numbers that are not there, 0 among them, and
counts beyond what the file holds. The format: Gmsh reference manual, "MSH file format" (4.1) and
"MSH file format version 2 (Legacy)".

>>> from us_sim.tissue.mesh.gmsh import parse_gmsh
>>> points, tetrahedra, quadratic = parse_gmsh(b'''$MeshFormat
... 2.2 0 8
... $EndMeshFormat
... $Nodes
... 4
... 7 0 0 0
... 8 1 0 0
... 9 0 1 0
... 3 0 0 1
... $EndNodes
... $Elements
... 1
... 1 4 2 1 1 7 8 9 3
... $EndElements''')
>>> tetrahedra
array([[0, 1, 2, 3]])
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError

VERSIONS = ("2", "2.1", "2.2", "4.1")

_NODES_OF = {1: 2, 2: 3, 8: 3, 9: 6, 15: 1, 4: 4, 11: 10}
"""How many nodes an element has: points, lines and triangles, and tetrahedra (4 and 11)."""
_TETRAHEDRA = (4, 11)

Rows = list[tuple[int, NDArray[np.int64]]]
"""Elements by type, and the numbers of their nodes."""


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
    """What lies between ``$Name`` and ``$EndName``."""
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
        """The next whole numbers, none of them beyond what a count or a node's number can be."""
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
