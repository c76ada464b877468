"""Selections of a mesh's nodes to be fixed or touched: by face, by normal, and by label.

>>> from us_sim.tissue.mesh.node_selection import face_nodes
>>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
>>> mesh = box_mesh([-0.05, 0.0, 0.05], [-0.05, 0.05], [0.0, 0.05, 0.1])
>>> mesh.nodes[face_nodes(mesh, "top"), 2]
array([0., 0., 0., 0., 0., 0.])
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError
from us_sim.tissue.elasticity.materials import LabelFractions
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh

FACES = {
    "top": ((2, False),),
    "bottom": ((2, True),),
    "left": ((0, False),),
    "right": ((0, True),),
    "front": ((1, False),),
    "back": ((1, True),),
    "sides": ((0, False), (0, True), (1, False), (1, True)),
}
"""Faces of a box by name, as (axis, at its maximum). In frame patient z points into the tissue, so
that the skin is the face of smallest z."""


_MARGIN = 0.05
"""Distance from a bounding box's face, over the box's size, up to which nodes count as on the face;
for meshes that are no box."""

_FEW, _FEW_PART = 10, 0.01
"""Nodes, also as a part of all, below which what is held is remarked on as little."""

_GRAZING = 0.1
"""The cosine to -z below which a probe that comes along +z would only graze the surface."""


def held_remark(name: str, nodes: NDArray[np.integer], mesh: TetrahedralMesh) -> str | None:
    """How many nodes a name in a scene's ``fixed`` holds, for a person.

    Of a mesh from a file, which may touch its bounding box at single nodes, and where they are few.
    """
    count, of = len(nodes), len(mesh.nodes)
    said = f"fixed: `{name}` holds {count} of {of} nodes"
    if count < max(_FEW, _FEW_PART * of):
        return f"{said}, which is little; see tissue.fixed and tissue.mesh.margin"
    return None if mesh.planes is not None else said


def face_nodes(mesh: TetrahedralMesh, face: str, margin: float | None = None) -> NDArray[np.int32]:
    """(K,) nodes at a face of the mesh's bounding box, ascending.

    Of a box mesh, those in the plane of the face; of any other, those of its boundary that are
    near to it, since an organ touches its bounding box at single nodes.

    Args:
        face: a name from `FACES`; ``top`` is the skin, ``sides`` are the four that stand on it.
        margin: m, how near, for a mesh that is no box; by default a twentieth of its size along
            that axis.

    Raises:
        MeshError: there is no such face.
    """
    if face not in FACES:
        raise MeshError(f"a box has no face {face!r}: its faces are {', '.join(FACES)}")
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    rounding = 1e-9 * float((high - low).max())
    eligible = np.ones(len(mesh.nodes), dtype=bool)
    near = np.zeros(3)
    if mesh.planes is None:
        eligible[:] = False
        eligible[mesh.boundary] = True
        near[:] = _MARGIN * (high - low) if margin is None else margin
    chosen = np.zeros(len(mesh.nodes), dtype=bool)
    for axis, at_maximum in FACES[face]:
        plane = (high if at_maximum else low)[axis]
        chosen |= np.abs(mesh.nodes[:, axis] - plane) <= near[axis] + rounding
    return np.flatnonzero(chosen & eligible).astype(np.int32)


def facing_nodes(mesh: TetrahedralMesh) -> NDArray[np.int32]:
    """(K,) nodes of the boundary that look towards the probe, which comes along +z, ascending.

    Those whose normal, of the adjacent triangles weighted by area, is less than 84 degrees off -z.
    """
    a, b, c = (mesh.nodes[mesh.boundary[:, corner]] for corner in range(3))
    areas = np.cross(b - a, c - a)
    normals = np.zeros_like(mesh.nodes)
    for corner in range(3):
        np.add.at(normals, mesh.boundary[:, corner], areas)
    lengths = np.linalg.norm(normals, axis=1)
    return np.flatnonzero(-normals[:, 2] > _GRAZING * lengths).astype(np.int32)


def nodes_in_label(
    mesh: TetrahedralMesh, fractions: LabelFractions, label: int
) -> NDArray[np.int32]:
    """(K,) nodes whose tetrahedra are mostly filled by a label, such as bone, ascending."""
    filled = fractions.of(label)
    around = mesh.tetrahedra.ravel()
    volume = np.bincount(around, np.repeat(mesh.volumes, 4), len(mesh.nodes))
    inside = np.bincount(around, np.repeat(mesh.volumes * filled, 4), len(mesh.nodes))
    return np.flatnonzero(inside > 0.5 * volume).astype(np.int32)
