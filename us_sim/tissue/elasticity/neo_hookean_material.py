"""Neo-Hookean material at one point, and the constants of tetrahedra: solid, crushed, or emptying.

Energy density of the deformation gradient F = I + h, with J = det F (B. Smith, F. de Goes and
T. Kim, Stable Neo-Hookean Flesh Simulation, ACM Trans. Graph. 37, 2018, eq. 13, without the
logarithmic barrier):

    mu/2 (|F|^2 - 3) - mu (J - 1) + bulk/2 (J - 1)^2,    bulk = lambda + mu.

It is a polynomial, so it holds for inverted tissue too, and linearised at rest it is Hooke's law.
But a finite force can press a tetrahedron to nothing, as where a vein closes or under a probe's
edge. So below a quarter of its volume (J0) a term is added that begins with two continuous
derivatives and grows without bound,

    wall (J0 - J)^3 / (3 J0 J),

with the modulus of `barrier_modulus`, and that goes on below a fiftieth as its Taylor polynomial of
second order, so that it is defined everywhere. Everything is written in h, not F, so that small
strains keep all their digits in single precision. A 3x3 matrix is a tuple of nine numbers, row by
row. The functions are compiled into the loops that call them, which LLVM vectorises.

**A vessel whose blood leaves.** Blood leaves a vein along it while its pressure stays the veins',
p, so that the energy is local: pressure times the volume that left. At rest the tension of the
vessel's wall carries p. As the lumen's volume ratio j falls, the tension falls with its square,
since the wall is the stiffer the more it is stretched (Y. C. Fung, Biomechanics: Circulation,
2nd ed., 1997, chapter 4), and is gone at 1 - e:

    dU/dj = p (m^2 - 1),    m = max(1 - (1 - j) / e, 0).

From there on the outside presses with p alone until the vessel is empty. A slack wall of thickness
h and radius R would add K = E h^3 / (12 (1 - nu^2) R^3) (A. H. Shapiro, Steady Flow in Collapsible
Tubes, J. Biomech. Eng. 99, 1977), and buckles at 3 K: 10 to 40 Pa for a vein of 3 mm radius and 0.3
mm thickness, little beside p, and left out.

A tetrahedron of which a fraction f is lumen bears one pressure q in both parts (A. Reuss,
Berechnung der Fließgrenze von Mischkristallen, ZAMM 9, 1929). With the solid's bulk modulus K,

    J - 1 = f (j - 1) + (1 - f) q / K,    q = dU/dj,

which is a quadratic equation for m. U(J) is convex and has two continuous derivatives. When the
lumen is empty, its walls touch and the solid is pressed: there the wall term above begins, as
stiff as the solid.

>>> import numpy as np
>>> from us_sim.tissue.elasticity.neo_hookean_material import lumen_energy, lumen_table
>>> whole = lumen_table(np.ones(1), np.array([1000.0]), np.ones(1), np.ones(1))[0]
>>> pressures = [float(lumen_energy(ratio - 1.0, whole)[1]) for ratio in (1.0, 0.9, 0.8, 0.5, 0.2)]
>>> np.round(pressures).tolist()
[0.0, -750.0, -1000.0, -1000.0, -1000.0]
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import SolverError
from us_sim.kernels import njit
from us_sim.tissue.elasticity.linear_tetrahedra import shape_gradients
from us_sim.tissue.elasticity.materials import TissueMaterials, volumetric_split
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh

# How loops are compiled: with fused multiply-adds, but NaN stays NaN.
LOOP: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract", "nsz"},
}

# How the functions that these loops call are compiled.
INLINED: dict[str, Any] = {**LOOP, "forceinline": True}
ONE, HALF = np.float32(1.0), np.float32(0.5)
# Numbers that are exact in any precision. Literals would turn single precision into double.
_THREE = np.float32(3.0)
# Volume ratios J at which a tetrahedron begins to resist being crushed, and is crushed.
_BARRIER_ONSET, _CRUSHED = np.float32(0.25), np.float32(0.02)


@njit(**INLINED)
def inner_product(a, b):
    """Return the sum of the products of the entries of two matrices."""
    return (
        (a[0] * b[0] + a[1] * b[1] + a[2] * b[2])
        + (a[3] * b[3] + a[4] * b[4] + a[5] * b[5])
        + (a[6] * b[6] + a[7] * b[7] + a[8] * b[8])
    )


@njit(**INLINED)
def cofactor_change(h):
    """Return cof(I + h) - I; cof F is the derivative of det F."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = h
    return (
        (yy * zz - yz * zy) + (yy + zz),
        (yz * zx - yx * zz) - yx,
        (yx * zy - yy * zx) - zx,
        (xz * zy - xy * zz) - xy,
        (xx * zz - xz * zx) + (xx + zz),
        (xy * zx - xx * zy) - zy,
        (xy * yz - xz * yy) - xz,
        (xz * yx - xx * yz) - yz,
        (xx * yy - xy * yx) + (xx + yy),
    )


@njit(**INLINED)
def cofactor_slope(h, d):
    """Return the change of cof(I + h) for a small change d of h."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = h
    dxx, dxy, dxz, dyx, dyy, dyz, dzx, dzy, dzz = d
    return (
        (yy * dzz + zz * dyy - yz * dzy - zy * dyz) + (dyy + dzz),
        (yz * dzx + zx * dyz - yx * dzz - zz * dyx) - dyx,
        (yx * dzy + zy * dyx - yy * dzx - zx * dyy) - dzx,
        (xz * dzy + zy * dxz - xy * dzz - zz * dxy) - dxy,
        (xx * dzz + zz * dxx - xz * dzx - zx * dxz) + (dxx + dzz),
        (xy * dzx + zx * dxy - xx * dzy - zy * dxx) - dzy,
        (xy * dyz + yz * dxy - xz * dyy - yy * dxz) - dxz,
        (xz * dyx + yx * dxz - xx * dyz - yz * dxx) - dyz,
        (xx * dyy + yy * dxx - xy * dyx - yx * dxy) + (dxx + dyy),
    )


@njit(**INLINED)
def _volume_change_beyond_trace(h):
    """Return det(I + h) - 1 - trace h."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = h
    first = yy * zz - yz * zy
    return (
        first
        + (xx * zz - xz * zx)
        + (xx * yy - xy * yx)
        + (xx * first + xy * (yz * zx - yx * zz) + xz * (yx * zy - yy * zx))
    )


@njit(**INLINED)
def volume_change(h):
    """Return J - 1, that is det(I + h) - 1."""
    return (h[0] + h[4] + h[8]) + _volume_change_beyond_trace(h)


@njit(**INLINED)
def barrier_from(change, onset):
    """Return the barrier term that begins at J = onset, and its two slopes by J = change + 1.

    All are over the modulus of the wall.
    """
    ratio = ONE + change
    held = _CRUSHED if ratio < _CRUSHED else ratio
    beyond = ratio - held
    missing = onset - held
    missing = missing if missing > 0 else ONE - ONE
    per = ONE / held
    scale = missing / (_THREE * onset)
    value = scale * missing * missing * per
    slope = -scale * missing * (held + held + onset) * per * per
    both = held * (held + onset) + onset * onset
    curvature = (scale + scale) * both * per * per * per
    return (
        value + beyond * (slope + HALF * curvature * beyond),
        slope + curvature * beyond,
        curvature,
    )


@njit(**INLINED)
def barrier_term(change):
    """Return the barrier of solid tissue, and its two slopes by the change of volume."""
    return barrier_from(change, _BARRIER_ONSET)


@njit(**INLINED)
def energy_density(h, shear, bulk, wall):
    """Return the energy density that the module's docstring states."""
    beyond = _volume_change_beyond_trace(h)
    change = (h[0] + h[4] + h[8]) + beyond
    plain = shear * (HALF * inner_product(h, h) - beyond) + HALF * (bulk * change * change)
    return plain + wall * barrier_term(change)[0]


@njit(**INLINED)
def piola_stress(h, shear, pressure):
    """Return the first Piola-Kirchhoff stress mu F + (p - mu) cof F.

    p is the slope by J of the energy without the shear's.
    """
    c = cofactor_change(h)
    k = pressure - shear
    return (
        (shear * h[0] + k * c[0]) + pressure,
        shear * h[1] + k * c[1],
        shear * h[2] + k * c[2],
        shear * h[3] + k * c[3],
        (shear * h[4] + k * c[4]) + pressure,
        shear * h[5] + k * c[5],
        shear * h[6] + k * c[6],
        shear * h[7] + k * c[7],
        (shear * h[8] + k * c[8]) + pressure,
    )


@njit(**INLINED)
def _stress_slope(h, c, d, shear, k, rise):
    """Return the change of the stress for a small change d of h.

    c is cof(I + h) - I, k = p - mu and rise the change of p.
    """
    e = cofactor_slope(h, d)
    return (
        (shear * d[0] + k * e[0]) + (rise * c[0] + rise),
        (shear * d[1] + k * e[1]) + rise * c[1],
        (shear * d[2] + k * e[2]) + rise * c[2],
        (shear * d[3] + k * e[3]) + rise * c[3],
        (shear * d[4] + k * e[4]) + (rise * c[4] + rise),
        (shear * d[5] + k * e[5]) + rise * c[5],
        (shear * d[6] + k * e[6]) + rise * c[6],
        (shear * d[7] + k * e[7]) + rise * c[7],
        (shear * d[8] + k * e[8]) + (rise * c[8] + rise),
    )


@njit(**INLINED)
def volume_slope(h, d):
    """Return the change of J for a small change d of h."""
    return inner_product(cofactor_change(h), d) + (d[0] + d[4] + d[8])


@njit(**INLINED)
def bulk_slope(change, element, wall):
    """Return the rise of the pressure with J = change + 1: by element, and by the barrier."""
    return element + wall * barrier_term(change)[2]


@njit(**INLINED)
def stress_rise(h, d, shear, bulk, k, nodal):
    """Return the change of the stress for small changes d of h, and nodal of the mean pressure.

    bulk is the `bulk_slope` at h, and k is p - mu.
    """
    c = cofactor_change(h)
    rise = bulk * (inner_product(c, d) + (d[0] + d[4] + d[8])) + nodal
    return _stress_slope(h, c, d, shear, k, rise)


@njit(**INLINED)
def diagonal_block(g, c, shear, bulk):
    """Return mu g.g I + bulk (cof F g)(cof F g)' as (xx, xy, xz, yy, yz, zz); c is cof F - I.

    This is how a node with the shape gradient g resists its own displacement; the rest of the
    stress does not contribute.
    """
    x = (c[0] * g[0] + c[1] * g[1] + c[2] * g[2]) + g[0]
    y = (c[3] * g[0] + c[4] * g[1] + c[5] * g[2]) + g[1]
    z = (c[6] * g[0] + c[7] * g[1] + c[8] * g[2]) + g[2]
    plain = shear * (g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
    return (
        plain + bulk * x * x,
        bulk * x * y,
        bulk * x * z,
        plain + bulk * y * y,
        bulk * y * z,
        plain + bulk * z * z,
    )


_FIRMNESS = 5.0


def barrier_modulus(
    tetrahedra: NDArray[np.integer], shear: NDArray[np.float64], count: int
) -> NDArray[np.float64]:
    """Return (M,) Pa, the modulus of each tetrahedron's wall.

    Args:
        tetrahedra: (M, 4) node indices.
        shear: (M,) Pa, shear moduli.
        count: number of nodes.
    """
    return _FIRMNESS * _mean_with_stiffest(tetrahedra, shear, count)


def barrier_strength(mesh: TetrahedralMesh, materials: TissueMaterials) -> NDArray[np.float64]:
    """Return (N,) N, a measure of the force that the walls around each node withstand.

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


def _mean_with_stiffest(tetrahedra: NDArray, shear: NDArray, count: int) -> NDArray:
    """Return (M,) Pa, geometric means of each shear modulus and the largest around it."""
    around = np.zeros(count)
    np.maximum.at(around, tetrahedra, np.broadcast_to(shear[:, None], tetrahedra.shape))
    return np.asarray(np.sqrt(shear * around[tetrahedra].max(axis=1)))


CONSTANTS = 6  # Numbers that the law of a lumen needs, see `lumen_table`
_SLACK = 0.2  # Fraction of its volume, e above, that a vein has lost when its wall is slack
# Shear modulus of a lumen over that of the solid that stands in for it. Blood has none; this one
# keeps the mesh inside in shape. In the arm it is a tenth of the pressure, so that flattening the
# mesh takes a tenth of the work of emptying it.
_SOFTNESS = 0.05
# Volume ratio at which the walls of an empty lumen begin to touch: they have a thickness.
_TOUCHING = 0.2
# Modulus of the wall of a tetrahedron with an empty lumen, over the bulk modulus of the solid in
# it: pressed by a tenth of its volume it then resists about as the solid does.
_PRESSED = 5.0
_ALL = 0.99  # Fraction of lumen from which a tetrahedron is no solid at all
_TWO, _FOUR = np.float32(2.0), np.float32(4.0)
_LEAST = np.float32(1e-12)


@dataclass(frozen=True, eq=False)
class NeoHookeanConstants:
    """Constants of each tetrahedron for the neo-Hookean sums.

    The first four are of `volumetric_split` and `barrier_modulus`; where there is a lumen, all but
    the shear modulus are zero, and a row of ``lumen`` says how it resists.
    """

    shear: NDArray[np.float64]  # (M,), Pa
    element: NDArray[np.float64]  # (M,), Pa
    nodal: NDArray[np.float64]  # (M,), Pa
    wall: NDArray[np.float64]  # (M,), Pa
    lumen: NDArray[np.float64]  # (M, CONSTANTS), see `lumen_table`; zero where there is none

    def lumen_energies(self, mesh: TetrahedralMesh) -> NDArray[np.float64]:
        """Return (M, CONSTANTS), for energies in J; ``lumen`` is for their densities."""
        energies = self.lumen.copy()
        energies[:, [0, 4]] *= mesh.volumes[:, None]
        return energies


def neo_hookean_constants(mesh: TetrahedralMesh, materials: TissueMaterials) -> NeoHookeanConstants:
    """Return the constants of solids, and of lumens where materials have them.

    A tetrahedron with a lumen takes no part in the averages of `volumetric_split`, so that it may
    lose its volume whatever its neighbours do.
    """
    split = volumetric_split(materials)
    emptied = _drained_fraction(materials)
    shear = split.shear * (1.0 - (1.0 - _SOFTNESS) * emptied)
    wall = barrier_modulus(mesh.tetrahedra, shear, len(mesh.nodes))
    lumen = lumen_table(emptied, materials.lumen_pressure, split.element, wall)
    solid = materials.lumen_fraction == 0.0
    return NeoHookeanConstants(
        shear, split.element * solid, split.nodal * solid, wall * solid, lumen
    )


def _drained_fraction(materials: TissueMaterials) -> NDArray[np.float64]:
    """Return (M,), the fraction of each tetrahedron that may leave it, above that of its lumen.

    A tetrahedron's contents move as one. So of the lumen f in one that loses f of its volume,
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
    """Return (M, CONSTANTS), each lumen's law; zero where there is no lumen.

    The columns are p (Pa), a = (1 - f) p / K, b = f e, 1 / (2 a + b), the modulus of the wall
    (Pa), and the volume ratio at which it begins.

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
def lumen_energy(change, constants):
    """Return the energy density of a tetrahedron with lumen, and its two slopes by J = change + 1.

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
    barrier = barrier_from(change, onset)
    return (
        value + wall * barrier[0],
        pressure * s * two + wall * barrier[1],
        curvature + wall * barrier[2],
    )
