"""A tissue as small as can be, on which a solver calls the same kernels as on another.

>>> from us_sim.tissue.model import TissueModel
>>> from us_sim.tissue.solvers.rehearsal import rehearsal_model
>>> len(rehearsal_model(TissueModel.block()).mesh.tetrahedra)
40
"""

from __future__ import annotations

import numpy as np

from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, box_mesh
from us_sim.tissue.model import TissueModel


def rehearsal_model(model: TissueModel) -> TissueModel:
    """A tissue of eight cells, like another in what decides which kernels are used: a box mesh or
    another, the highest Poisson's ratio, how far moduli are apart, lumens, and the probe.
    """
    side = np.linspace(-0.01, 0.01, 3)
    mesh = box_mesh(side, side, side + 0.01)
    if model.mesh.planes is None:
        mesh = TetrahedralMesh(mesh.nodes, mesh.tetrahedra)
    own, count = model.materials, len(mesh.tetrahedra)
    hollow = np.arange(count) == 0
    return TissueModel(
        mesh,
        TissueMaterials(
            np.linspace(own.young_modulus.min(), own.young_modulus.max(), count),
            np.full(count, own.poisson_ratio.max()),
            np.full(count, own.density.max()),
            hollow * own.lumen_fraction.max(),
            hollow * own.lumen_pressure.max(),
        ),
        mesh.nodes[:, 2] > 0.015,
        model.collider,
        np.flatnonzero(mesh.nodes[:, 2] == 0.0).astype(np.int32),
    )
