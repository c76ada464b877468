"""A vessel whose blood leaves: the energy by volume of a tetrahedron that lies in a vein.

Blood leaves a vein along it while its pressure stays the veins', p, so that the energy is local:
pressure times the volume that left. At rest the tension of the vessel's wall carries p. As the
lumen's volume ratio j falls, the tension falls with its square, since the wall is the stiffer the
more it is stretched (Y. C. Fung, Biomechanics: Circulation, 2nd ed., 1997, chapter 4), and is gone
at 1 - e:

    dU/dj = p (m^2 - 1),    m = max(1 - (1 - j) / e, 0).

From there on the outside presses with p alone until the vessel is empty. A slack wall of thickness
h and radius R would add K = E h^3 / (12 (1 - nu^2) R^3) (A. H. Shapiro, Steady Flow in Collapsible
Tubes, J. Biomech. Eng. 99, 1977), and buckles at 3 K: 10 to 40 Pa for a vein of 3 mm radius and 0.3
mm thickness, little beside p, and left out.

A tetrahedron of which a fraction f is lumen bears one pressure q in both parts (A. Reuss,
Berechnung der Fließgrenze von Mischkristallen, ZAMM 9, 1929). With the solid's bulk modulus K,

    J - 1 = f (j - 1) + (1 - f) q / K,    q = dU/dj,

which is a quadratic equation for m. U(J) is convex and has two continuous derivatives. When the
lumen is empty, its walls touch and the solid is pressed: there the wall of `neo_hookean_point`
begins, as stiff as the solid.

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
from numpy.typing import NDArray

from us_sim.errors import SolverError
from us_sim.kernels import njit
from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.elasticity.neo_hookean_point import HALF, INLINED, ONE, crowding_below
from us_sim.tissue.elasticity.volumetric_split import volumetric_split
from us_sim.tissue.elasticity.wall import wall_modulus
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh

CONSTANTS = 6
"""Numbers that the law of a lumen needs, see `lumen_table`."""

_SLACK = 0.2
"""Fraction of its volume, e above, that a vein has lost when its wall is slack."""

_SOFTNESS = 0.05
"""Shear modulus of a lumen over that of the solid that stands in for it. Blood has none; this one
keeps the mesh inside in shape. In the arm it is a tenth of the pressure, so that flattening the
mesh takes a tenth of what emptying takes."""

_TOUCHING = 0.2
"""Volume ratio at which the walls of an empty lumen begin to touch: they have a thickness."""

_PRESSED = 5.0
"""Modulus of the wall of a tetrahedron with an empty lumen, over the bulk modulus of the solid in
it: pressed by a tenth of its volume it then resists about as the solid does."""

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


def neo_hookean_constants(mesh: TetrahedralMesh, materials: TissueMaterials) -> NeoHookeanConstants:
    """The constants of solids, and of lumens where materials have them.

    A tetrahedron with a lumen takes no part in the averages of `volumetric_split`, so that it may
    lose its volume whatever its neighbours do.
    """
    split = volumetric_split(materials)
    emptied = _emptied(materials)
    shear = split.shear * (1.0 - (1.0 - _SOFTNESS) * emptied)
    wall = wall_modulus(mesh.tetrahedra, shear, len(mesh.nodes))
    lumen = lumen_table(emptied, materials.lumen_pressure, split.element, wall)
    solid = materials.lumen_fraction == 0.0
    return NeoHookeanConstants(
        shear, split.element * solid, split.nodal * solid, wall * solid, lumen
    )


def _emptied(materials: TissueMaterials) -> NDArray[np.float64]:
    """(M,), fraction of each tetrahedron that may leave it, somewhat more than that of its lumen.

    What a tetrahedron contains moves as one. So of the lumen f in one that loses f of its volume,
    f (1 - f) would stay to be seen: of the arm's vein, whose tetrahedra are almost as large as it
    is, a fifth. With 1 - (1 - f)^2 it is half of that.
    """
    return np.asarray(1.0 - (1.0 - materials.lumen_fraction) ** 2)


def lumen_table(
    fraction: NDArray[np.float64],
    pressure: NDArray[np.float64],
    bulk: NDArray[np.float64],
    wall: NDArray[np.float64],
) -> NDArray[np.float64]:
    """(M, CONSTANTS): p (Pa), a = (1 - f) p / K, b = f e, 1 / (2 a + b), the modulus of the wall
    (Pa), and the volume ratio at which it begins; zero where there is no lumen.

    Args:
        fraction: (M,), f.
        pressure: (M,) Pa, p.
        bulk: (M,) Pa, K.
        wall: (M,) Pa, the least modulus of the wall.
    """
    there = fraction > 0.0
    solid = 1.0 - fraction
    given, eased = solid * pressure / bulk, _SLACK * fraction
    per = np.divide(1.0, 2 * given + eased, out=np.zeros_like(given), where=there)
    firm = np.maximum(wall, _PRESSED * solid * bulk)
    onset = np.maximum(solid - given, _TOUCHING)
    return np.stack([pressure, given, eased, per, firm, onset], axis=1) * there[:, None]


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
