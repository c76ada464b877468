"""Which nodes of a box mesh can be held or touched: by face, and by the label around them.

>>> from us_sim.tissue.box import face_nodes
>>> from us_sim.tissue.mesh import box_mesh
>>> mesh = box_mesh([-0.05, 0.0, 0.05], [-0.05, 0.05], [0.0, 0.05, 0.1])
>>> mesh.nodes[face_nodes(mesh, "top"), 2]
array([0., 0., 0., 0., 0., 0.])
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import MeshError
from us_sim.tissue.materials import label_fractions
from us_sim.tissue.mesh import TetrahedralMesh

__all__ = ["FACES", "face_nodes", "nodes_in_label"]

#: Faces of a box by name, as (axis, at its maximum). In frame patient z points into the tissue,
#: so that the skin is the face of smallest z.
FACES = {
    "top": ((2, False),),
    "bottom": ((2, True),),
    "left": ((0, False),),
    "right": ((0, True),),
    "front": ((1, False),),
    "back": ((1, True),),
    "sides": ((0, False), (0, True), (1, False), (1, True)),
}


def face_nodes(mesh: TetrahedralMesh, face: str) -> NDArray[np.int32]:
    """(K,) nodes in the plane of a face of the mesh's bounding box, ascending.

    Args:
        face: a name from `FACES`; ``top`` is the skin, ``sides`` are the four that stand on it.

    Raises:
        MeshError: there is no such face.
    """
    if face not in FACES:
        raise MeshError(f"a box has no face {face!r}: name one of {', '.join(FACES)}")
    low, high = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    tolerance = 1e-9 * float((high - low).max())
    chosen = np.zeros(len(mesh.nodes), dtype=bool)
    for axis, at_maximum in FACES[face]:
        plane = (high if at_maximum else low)[axis]
        chosen |= np.abs(mesh.nodes[:, axis] - plane) <= tolerance
    return np.flatnonzero(chosen).astype(np.int32)


def nodes_in_label(
    mesh: TetrahedralMesh,
    labels: NDArray[np.uint8],
    index_from_patient: NDArray[np.float64],
    label: int,
) -> NDArray[np.int32]:
    """(K,) nodes whose tetrahedra are mostly filled by a label, such as bone, ascending.

    Args:
        mesh, labels, index_from_patient: as in `us_sim.tissue.materials.label_fractions`.
        label: its number in ``labels``.

    Raises:
        MaterialError: as `us_sim.tissue.materials.label_fractions`.
    """
    present, fractions = label_fractions(mesh, labels, index_from_patient)
    filled = fractions[:, present == label].sum(axis=1)
    around = mesh.tetrahedra.ravel()
    volume = np.bincount(around, np.repeat(mesh.volumes, 4), len(mesh.nodes))
    inside = np.bincount(around, np.repeat(mesh.volumes * filled, 4), len(mesh.nodes))
    return np.flatnonzero(inside > 0.5 * volume).astype(np.int32)
