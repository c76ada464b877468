"""A vessel whose blood leaves: the energy by volume of a tetrahedron that lies in a vein.

Blood leaves a vein along it while its pressure stays the veins', p, so that the energy is local:
pressure times the volume that left. At rest the tension of the vessel's wall carries p. As the
lumen's volume ratio j falls, the tension falls with its square, as the wall's stiffness grows with
its stretch (Y. C. Fung, Biomechanics: Circulation, 1997, 4.10), and is gone at 1 - e:

    dU/dj = p (m^2 - 1),    m = max(1 - (1 - j) / e, 0).

From there on the outside presses with p alone until the vessel is empty. A slack wall of thickness
h and radius R resists its collapse with K = E h^3 / (12 (1 - nu^2) R^3) (A. H. Shapiro, Steady Flow
in Collapsible Tubes, J. Biomech. Eng. 99, 1977, eq. 2.5) and buckles at 3 K: of a vein, 10 to 40 Pa
of a kilopascal, which is left out. When it is empty, its walls touch: there the wall of
`neo_hookean_point` begins.

A tetrahedron of which a fraction f is lumen bears one pressure q in both parts (A. Reuss, Berechnung
der Fließgrenze von Mischkristallen, ZAMM 9, 1929). Of the solid's bulk modulus K,

    J - 1 = f (j - 1) + (1 - f) q / K,    q = dU/dj,

which is a quadratic equation for m. Both in series have the convex energy U(J) with the pressure q;
it has two continuous derivatives. All of J's change below 1 - f is the solid's, and there the wall
begins, too.

>>> import numpy as np
>>> from us_sim.tissue.elasticity.lumen import emptying, lumen_table
>>> whole = lumen_table(np.ones(1), np.array([1000.0]), np.ones(1), np.ones(1))[0]
>>> pressures = [float(emptying(ratio - 1.0, whole)[1]) for ratio in (1.0, 0.9, 0.8, 0.5, 0.2)]
>>> np.round(pressures).tolist()
[0.0, -750.0, -1000.0, -1000.0, -1000.0]
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import DTypeLike, NDArray

from us_sim.errors import SolverError
from us_sim.tissue.elasticity.lanes import LANES, in_lanes
from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.elasticity.neo_hookean_point import HALF, INLINED, ONE, crowding_below, volume_change
from us_sim.tissue.elasticity.volumetric_split import volumetric_split
from us_sim.tissue.elasticity.wall import wall_modulus
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh

__all__ = [
    "CONSTANTS",
    "NeoHookeanConstants",
    "emptied",
    "emptying",
    "in_groups",
    "lumen_table",
    "neo_hookean_constants",
    "require_solid",
]

CONSTANTS = 6
"""Numbers that the law of a lumen needs, see `lumen_table`."""

_SLACK = 0.2
"""Fraction of its volume, e above, that a vein has lost when its wall is slack."""

_SHEAR = 0.1
"""Shear modulus of a lumen over its pressure. Blood has none; this one keeps the mesh inside in
shape, and flattening it takes a tenth of what emptying takes."""

_TOUCHING = 0.1
"""Volume ratio at which the walls of an empty lumen begin to touch: they have a thickness."""

_ALL = 0.99
"""Fraction of lumen from which a tetrahedron is no solid at all."""

_TWO, _THREE, _FOUR = np.float32(2.0), np.float32(3.0), np.float32(4.0)
_LEAST = np.float32(1e-12)


@dataclass(frozen=True, eq=False)
class NeoHookeanConstants:
    """What the neo-Hookean sums need of each tetrahedron.

    The first four are those of `volumetric_split` and `wall_modulus`; where there is a lumen, all
    but the shear modulus are zero, and a row of ``lumen`` says how it resists.
    """

    shear: NDArray[np.float64]  # (M,), Pa
    element: NDArray[np.float64]  # (M,), Pa
    nodal: NDArray[np.float64]  # (M,), Pa
    wall: NDArray[np.float64]  # (M,), Pa
    lumen: NDArray[np.float64]  # (M, CONSTANTS), see `lumen_table`; zero where there is none

    def lumen_energies(self, mesh: TetrahedralMesh) -> NDArray[np.float64]:
        """(M, CONSTANTS), for energies in J where ``lumen`` is for their densities."""
        energies = self.lumen.copy()
        energies[:, [0, 4]] *= mesh.volumes[:, None]
        return energies


def neo_hookean_constants(
    mesh: TetrahedralMesh, materials: TissueMaterials
) -> NeoHookeanConstants:
    """The constants of solids, and of lumens where materials have them.

    A tetrahedron with a lumen takes no part in the averages of `volumetric_split`, so that it may
    lose its volume whatever its neighbours do.
    """
    split = volumetric_split(materials)
    fraction, pressure = materials.lumen_fraction, materials.lumen_pressure
    shear = (1 - fraction) * split.shear + fraction * _SHEAR * pressure
    wall = wall_modulus(mesh.tetrahedra, shear, len(mesh.nodes))
    lumen = lumen_table(fraction, pressure, split.element, wall)
    solid = fraction == 0.0
    return NeoHookeanConstants(
        shear, split.element * solid, split.nodal * solid, wall * solid, lumen
    )


def lumen_table(
    fraction: NDArray[np.float64],
    pressure: NDArray[np.float64],
    bulk: NDArray[np.float64],
    wall: NDArray[np.float64],
) -> NDArray[np.float64]:
    """(M, CONSTANTS): p (Pa), (1 - f) p / K, f e, and one over twice the former plus the latter;
    the modulus of the wall (Pa), and the volume ratio at which it begins. Without lumen, zero.

    Args:
        fraction: (M,), of lumen.
        pressure: (M,) Pa, in the lumen.
        bulk: (M,) Pa, lambda + mu of the solid beside it.
        wall: (M,) Pa.
    """
    there = fraction > 0.0
    table = np.zeros((len(fraction), CONSTANTS))
    given = np.where(there, (1 - fraction) * pressure / bulk, 0.0)
    eased = _SLACK * fraction
    table[:, 0] = np.where(there, pressure, 0.0)
    table[:, 1] = given
    table[:, 2] = eased
    np.divide(1.0, 2 * given + eased, out=table[:, 3], where=there)
    table[:, 4] = np.where(there, wall, 0.0)
    table[:, 5] = np.where(there, np.maximum(1 - fraction, _TOUCHING), 0.0)
    return table


def in_groups(table: NDArray, dtype: DTypeLike) -> tuple[NDArray[np.int32], NDArray]:
    """(C,) which row of the other array each group of `LANES` lines has, or -1 if it has no lumen;
    and (L, CONSTANTS * K * LANES) the constants of those that have one.

    Args:
        table: (R, K, CONSTANTS), volumes times those of `lumen_table`, of K tetrahedra a line.
        dtype: of the constants.
    """
    groups = -(-len(table) // LANES)
    padded = np.zeros((groups * LANES, *table.shape[1:]))
    padded[: len(table)] = table
    padded[..., 5] = np.where(padded[..., 0] > 0, padded[..., 5], 1.0)  # no division by zero
    there = padded[..., 0].reshape(groups, -1).any(axis=1)
    row = np.where(there, np.cumsum(there) - 1, -1).astype(np.int32)
    lines = padded.transpose(0, 2, 1).reshape(len(padded), -1)
    return row, in_lanes(lines).astype(dtype)[there]


def require_solid(mesh: TetrahedralMesh, materials: TissueMaterials) -> None:
    """Check that no connected part of a mesh is all lumen: nothing would hold it.

    Raises:
        SolverError: one is.
    """
    solid = mesh.tetrahedra[materials.lumen_fraction < _ALL]
    hollow = np.setdiff1d(np.arange(mesh.parts.max() + 1), mesh.parts[solid.ravel()])
    if len(hollow):
        raise SolverError(
            f"the part of the mesh around node {np.flatnonzero(mesh.parts == hollow[0])[0]} is "
            f"lumen everywhere, so that nothing holds it: only materials without lumen_pressure "
            f"are solid"
        )


@njit(**INLINED)
def emptied(h, lumen, i, per, w):
    """`emptying` of the i-th of ``per`` tetrahedra of lane w, times its volume."""
    v = i * LANES + w
    step = per * LANES
    return emptying(
        volume_change(h),
        (
            lumen[v],
            lumen[v + step],
            lumen[v + 2 * step],
            lumen[v + 3 * step],
            lumen[v + 4 * step],
            lumen[v + 5 * step],
        ),
    )


@njit(**INLINED)
def emptying(change, constants):
    """Energy density of a tetrahedron with lumen, its slope by J = change + 1 and that one's.

    With s = m - 1, the quadratic equation is a s^2 + (2 a + b) s = J - 1.
    """
    pressure, a, b, per, wall, onset = constants
    lowest = -(a + b)
    held = lowest if change < lowest else change
    root = ONE + _FOUR * a * per * per * held
    root = math.sqrt(root if root > _LEAST else _LEAST)
    s = _TWO * held * per / (ONE + root)
    two = s + _TWO
    value = s * s * (b * (s + _THREE) / _THREE + HALF * a * two * two) + (held - change)
    value *= pressure
    curvature = _TWO * pressure * (ONE + s) * per / root
    curvature = curvature if change > lowest else ONE - ONE
    crowded = crowding_below(change, onset)
    return (
        value + wall * crowded[0],
        pressure * s * two + wall * crowded[1],
        curvature + wall * crowded[2],
    )
