"""How much tissue is strained, as one number a node, for colours.

Of each tetrahedron the equivalent (von Mises) strain of the Green-Lagrange tensor E:
sqrt(2/3 e : e) with e the part of E without its trace, which is the elongation in uniaxial
stretch of what keeps its volume, to first order (Holzapfel, *Nonlinear Solid Mechanics*, 2000).
A node has the mean of the tetrahedra around it, weighted by their volumes at rest.

>>> import numpy as np
>>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
>>> from us_sim.viewer.meshes.equivalent_strain import EquivalentStrain
>>> mesh = box_mesh([0.0, 0.1], [0.0, 0.1], [0.0, 0.1])
>>> strain = EquivalentStrain(mesh)
>>> strain.of(mesh.nodes * [1.0, 1.0, 1.01]).round(4)
array([0.0067, 0.0067, 0.0067, 0.0067, 0.0067, 0.0067, 0.0067, 0.0067])
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh


class EquivalentStrain:
    """Of the states of one mesh, at its nodes."""

    def __init__(self, mesh: TetrahedralMesh) -> None:
        corners = mesh.nodes[mesh.tetrahedra]
        self._tetrahedra = mesh.tetrahedra
        self._inverse = np.linalg.inv(corners[:, 1:] - corners[:, :1])  # (M, 3, 3)
        self._volumes = mesh.volumes
        self._around = np.bincount(
            mesh.tetrahedra.ravel(), np.repeat(mesh.volumes, 4), minlength=len(mesh.nodes)
        )

    def of(self, nodes: NDArray[np.floating]) -> NDArray[np.float64]:
        """(N,) when the mesh's nodes are at (N, 3) m; 0 is without strain."""
        corners = nodes[self._tetrahedra]
        gradient = self._inverse @ (corners[:, 1:] - corners[:, :1])  # the transpose of F
        strain = 0.5 * (gradient @ gradient.transpose(0, 2, 1) - np.eye(3))
        strain -= np.trace(strain, axis1=1, axis2=2)[:, None, None] / 3.0 * np.eye(3)
        equivalent = np.sqrt(2.0 / 3.0 * np.einsum("mij,mij->m", strain, strain))
        weighted = np.repeat(self._volumes * equivalent, 4)
        summed = np.bincount(self._tetrahedra.ravel(), weighted, minlength=len(nodes))
        return summed / self._around
