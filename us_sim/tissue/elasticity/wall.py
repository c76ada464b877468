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

__all__ = ["wall_modulus"]

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
    around = np.zeros(count)
    np.maximum.at(around, tetrahedra, np.broadcast_to(shear[:, None], tetrahedra.shape))
    largest = around[tetrahedra].max(axis=1)
    return np.asarray(_FIRMNESS * np.sqrt(shear * largest))
