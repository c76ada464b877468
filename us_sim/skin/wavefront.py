"""Triangles of Wavefront OBJ files, as modelling programs write them.

Only vertex positions and faces are read. Texture coordinates and normals, which have counts of
their own, are passed over: that is where general mesh readers stumble over real files.

>>> from us_sim.skin.wavefront import parse_wavefront
>>> points, triangles = parse_wavefront("v 0 0 0\\nv 1 0 0\\nv 1 1 0\\nv 0 1 0\\nf 1/7 2/8 3/9 4/7")
>>> triangles
array([[0, 1, 2],
       [0, 2, 3]], dtype=int32)
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError
from us_sim.settings.spelling import shown


def parse_wavefront(text: str) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Points (N, 3), in the file's unit, and triangles (T, 3); polygons are split into fans.

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
            raise MeshError(f"line {number}: {shown(line.strip())}: {str(error)[:100]}") from error
    return (
        np.array(points, dtype=np.float64).reshape(-1, 3),
        np.array(triangles, dtype=np.int32).reshape(-1, 3),
    )


def _index(word: str, count: int) -> int:
    """A vertex's index from 0; in the file it counts from 1, or backwards from the latest."""
    index = int(word)
    if not (1 <= index <= count or -count <= index <= -1):
        raise ValueError(f"there is no vertex {index} among the {count} so far")
    return index - 1 if index > 0 else count + index
