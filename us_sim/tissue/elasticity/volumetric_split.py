"""The volumetric split: bulk stiffness divided between tetrahedra and nodes, against locking.

A mesh of linear tetrahedra has about five times as many tetrahedra as nodes: were each to keep its
volume, nothing could move. So the bulk stiffness beyond a moderate one resists only the average
change of volume around each node (J. Bonet and A. J. Burton, A simple average nodal pressure
tetrahedral element for incompressible and nearly incompressible dynamic explicit applications,
Commun. Numer. Meth. Engng. 14, 1998), and the moderate part stays with the tetrahedra, which
stabilises the pressures (M. A. Puso and J. Solberg, A stabilized nodally integrated tetrahedral,
Int. J. Numer. Meth. Engng. 67, 2006).

>>> from us_sim.tissue.elasticity.volumetric_split import volumetric_split
>>> from us_sim.tissue.elasticity.material import Material
>>> from us_sim.tissue.elasticity.materials import uniform_material
>>> from us_sim.tissue.mesh.tetrahedral_mesh import box_mesh
>>> mesh = box_mesh([0.0, 0.1], [0.0, 0.1], [0.0, 0.1])
>>> split = volumetric_split(uniform_material(mesh, Material(10e3, 0.45, 1000.0)))
>>> bool(abs(split.element + split.nodal - 10 * split.shear).max() < 1e-9)
True
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from us_sim.tissue.elasticity.materials import TissueMaterials

_ELEMENT_LIMIT = 5.0
"""lambda + mu over mu at Poisson's ratio 0.4: up to there linear tetrahedra do not lock."""


@dataclass(frozen=True, eq=False)
class VolumetricSplit:
    """Shear modulus mu, and lambda + mu in two parts, of each tetrahedron."""

    shear: NDArray[np.float64]  # (M,), Pa
    element: NDArray[np.float64]  # (M,), Pa, resists the tetrahedron's own change of volume
    nodal: NDArray[np.float64]  # (M,), Pa, resists the average change of volume around its nodes


def volumetric_split(materials: TissueMaterials) -> VolumetricSplit:
    """Split lambda + mu, the coefficient of (J - 1)^2 / 2 in a stable neo-Hookean energy.

    (B. Smith, F. de Goes and T. Kim, Stable Neo-Hookean Flesh Simulation, ACM Trans. Graph. 37,
    2018, without its logarithmic barrier.)
    """
    ratio = materials.poisson_ratio
    shear = materials.young_modulus / (2 * (1 + ratio))
    whole = shear / (1 - 2 * ratio)
    limit = _ELEMENT_LIMIT * shear
    # At the limit itself rounding must not leave the nodes any stiffness.
    element = np.where(whole > limit * (1 + 1e-9), limit, whole)
    return VolumetricSplit(shear, element, whole - element)
