"""The block of tissue that solvers press and slicers cut, and its meshes.

>>> from us_sim.evaluation.block import MESHES, block
>>> mesh = block(MESHES[0])
>>> len(mesh.nodes), len(mesh.tetrahedra)
(2000, 7695)
"""

from __future__ import annotations

from functools import cache

from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, box_mesh, uniform_planes

EXTENT = ((-0.1, 0.1), (-0.05, 0.05), (0.0, 0.1))  # m, along x, y and z

MESHES = ((20, 10, 10), (24, 12, 12), (28, 14, 14), (32, 16, 16))
"""Nodes along x, y and z of the paper's four meshes (section VI)."""

LARGEST_MESH = (64, 32, 32)  # nodes along x, y and z


@cache
def block(counts: tuple[int, int, int]) -> TetrahedralMesh:
    """The block at rest, with so many nodes along each axis."""
    return box_mesh(
        *(uniform_planes(*side, count) for side, count in zip(EXTENT, counts, strict=True))
    )
