"""Tetrahedra in the first version of Gmsh's file format, which older organ meshes come in.

The format: Gmsh reference manual, "MSH file format version 1 (Legacy)". Of the element types, 4
is a linear tetrahedron; points, lines and triangles (15, 1, 2) are its corners, edges and faces.

>>> from us_sim.tissue.mesh.gmsh_one import parse_gmsh_one
>>> nodes, tetrahedra = parse_gmsh_one('''$NOD
... 4
... 7 0 0 0
... 8 1 0 0
... 9 0 1 0
... 3 0 0 1
... $ENDNOD
... $ELM
... 1
... 1 4 1 1 4 7 8 9 3
... $ENDELM''')
>>> tetrahedra
array([[0, 1, 2, 3]])
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError
from us_sim.tissue.mesh.gmsh import row_numbers

_TETRAHEDRON = 4
_ON_ITS_SURFACE = (1, 2, 15)


def parse_gmsh_one(text: str) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Points (N, 3) in the file's unit, and tetrahedra (M, 4) as rows of points.

    Raises:
        MeshError: a part is missing, shorter than it says or not made of numbers, an element is
            of another kind of volume, or one names a node that is not there.
    """
    rows = [row.split() for row in _part(text, "$NOD", "$ENDNOD")]
    if any(len(row) != 4 for row in rows):
        raise MeshError("a node of the file is not a number and three coordinates")
    try:
        numbers = np.array([int(row[0]) for row in rows], dtype=np.int64)
        points = np.array([row[1:] for row in rows], dtype=np.float64).reshape(-1, 3)
        elements = [[int(word) for word in row.split()] for row in _part(text, "$ELM", "$ENDELM")]
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


def _part(text: str, begin: str, end: str) -> list[str]:
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
