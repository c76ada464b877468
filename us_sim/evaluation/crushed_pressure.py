"""Pressures of tetrahedra that are crushed, and of lumens that empty, written down again.

As `independent_residual`, this is NumPy on formulas, and shares nothing with the solvers.

>>> import numpy as np
>>> from us_sim.evaluation.crushed_pressure import lumen_pressure
>>> one = np.ones(3)
>>> pressures = lumen_pressure(np.array([0.0, -0.1, -0.5]), one, 1000 * one, one, one)
>>> pressures.round().tolist()
[0.0, -750.0, -1000.0]
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh

Array = NDArray[np.float64]

_CROWDED, _CRUSHED = 1 / 4, 1 / 50
"""Volume ratios below which a nonlinear tetrahedron resists being crushed, and more simply so."""

_WALL = 5.0
"""Modulus of that resistance, over the geometric mean of a tetrahedron's own shear modulus and the
largest among the tetrahedra with which it shares a node."""

LUMEN_SHEAR, _LUMEN_SLACK, _LUMEN_TOUCHING, _LUMEN_PRESSED = 1 / 20, 1 / 5, 1 / 5, 5.0
"""Of lumens: shear modulus over that of the solid that stands in; strain until the wall is slack;
least volume ratio at which the walls touch; how much firmer than the solid is what is emptied."""


def emptied_fraction(materials: TissueMaterials) -> Array:
    """(M,), of each tetrahedron, that its lumen may lose."""
    return np.asarray(1 - (1 - materials.lumen_fraction) ** 2)


def wall_modulus(mesh: TetrahedralMesh, shear: Array) -> Array:
    """(M,) Pa, how firmly each tetrahedron resists being crushed."""
    nodes, modulus = mesh.tetrahedra.ravel(), np.repeat(shear, 4)
    order = np.argsort(modulus, kind="stable")
    largest = np.zeros(len(mesh.nodes))
    largest[nodes[order]] = modulus[order]  # of each node's values the last one written stays
    return np.asarray(_WALL * np.sqrt(shear * largest[mesh.tetrahedra].max(axis=1)))


def crowding(ratio: Array, onset: Array | float = _CROWDED) -> Array:
    """Derivative by J of (J0 - J)**3 / 3 J0 J below J0, straight on from where J is tiny."""
    held = np.clip(ratio, _CRUSHED, onset)
    missing = onset - held
    slope = -(missing**2) * (2 * held + onset) / (3 * onset * held**2)
    square = held**2 + onset * held + onset**2
    rise = 2 * missing * square / (3 * onset * held**3)
    return slope + rise * np.minimum(ratio - _CRUSHED, 0)


def lumen_pressure(
    swelling: Array, empties: Array, blood: Array, bulk: Array, wall: Array
) -> Array:
    """Pa, of tetrahedra of which a fraction ``empties`` can leave, at the pressure of the blood.

    Lumen and solid are in series: of a pressure p (m**2 - 1) the former swells by its fraction
    times 0.2 (m - 1), the latter, where the pressure is all of its bulk's, by what Hooke says.
    """
    solid = (1 - empties) * blood / bulk
    eased = _LUMEN_SLACK * empties
    left = np.maximum(solid + eased + swelling, 0.0)
    stretch = np.array(
        [
            np.roots([a, b, -rest]).max() if a > 1e-9 * b else rest / b
            for a, b, rest in zip(solid, eased, left, strict=True)
        ]
    ).reshape(left.shape)
    onset = np.maximum(1 - empties - solid, _LUMEN_TOUCHING)
    firm = np.maximum(wall, _LUMEN_PRESSED * (1 - empties) * bulk)
    return np.asarray(blood * (stretch**2 - 1) + firm * crowding(1 + swelling, onset))
