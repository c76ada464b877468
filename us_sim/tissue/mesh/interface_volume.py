"""The volume of a part of a mesh, corrected by moving the nodes between it and the rest.

A surface of few flat triangles, within a tolerance of a round one, encloses too little.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.mesh_faces import boundary_triangles
from us_sim.geometry.normals import vertex_normals
from us_sim.tissue.mesh.check import signed_volumes
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh

_STEPS = 3
_HALVINGS = 4
_LEFT = 0.2
"""Part of a tetrahedron's volume that it keeps in one step."""


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
