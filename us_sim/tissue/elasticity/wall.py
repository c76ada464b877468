"""How firmly each tetrahedron resists being crushed, beyond what its material does.

A finite force can press a stable neo-Hookean tetrahedron to nothing, as where a vein closes or
under a probe's edge; then `neo_hookean_point` adds a wall. It need not be physical, but it has to
hold whatever the neighbours press with. So its modulus is the geometric mean of the tetrahedron's
own shear modulus and the largest around it, times a factor that was found by trying: weaker ones
let tetrahedra turn inside out, and Newton's method then takes longer, not less long.

>>> import numpy as np
>>> from us_sim.tissue.elasticity.wall import wall_modulus
>>> wall_modulus(np.array([[0, 1, 2, 3], [1, 2, 3, 4]]), np.array([100.0, 10000.0]), 5)
array([ 5000., 50000.])
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.tissue.elasticity.linear_tetrahedra import shape_gradients
from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh

_FIRMNESS = 5.0


def wall_modulus(
    tetrahedra: NDArray[np.integer], shear: NDArray[np.float64], count: int
) -> NDArray[np.float64]:
    """(M,) Pa, of the wall of each tetrahedron.

    Args:
        tetrahedra: (M, 4) node indices.
        shear: (M,) Pa, shear moduli.
        count: number of nodes.
    """
    return _FIRMNESS * _mean_with_stiffest(tetrahedra, shear, count)


def withstood_force(mesh: TetrahedralMesh, materials: TissueMaterials) -> NDArray[np.float64]:
    """(N,) N, a measure of the force that the walls around each node withstand.

    It is the sum, over the tetrahedra at the node, of shear modulus times a third of a face, where
    none counts as stiffer than the weakest wall there: a stiff tetrahedron bears more, but a soft
    one beside it would be turned inside out.
    """
    shear = materials.young_modulus / (2 * (1 + materials.poisson_ratio))
    tetrahedra, count = mesh.tetrahedra, len(mesh.nodes)
    weakest = np.full(count, np.inf)
    np.minimum.at(weakest, tetrahedra, _mean_with_stiffest(tetrahedra, shear, count)[:, None])
    counted = np.minimum(shear[:, None], weakest[tetrahedra])
    area = mesh.volumes[:, None] * np.linalg.norm(shape_gradients(mesh), axis=2)
    total = np.zeros(count)
    np.add.at(total, tetrahedra, counted * area)
    return total


def _mean_with_stiffest(
    tetrahedra: NDArray[np.integer], shear: NDArray[np.float64], count: int
) -> NDArray[np.float64]:
    """(M,) Pa, geometric mean of a tetrahedron's shear modulus and the largest around it."""
    around = np.zeros(count)
    np.maximum.at(around, tetrahedra, np.broadcast_to(shear[:, None], tetrahedra.shape))
    return np.asarray(np.sqrt(shear * around[tetrahedra].max(axis=1)))
