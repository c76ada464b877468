"""Strain stiffening: an energy beside the neo-Hookean one, which grows with its third power.

With the neo-Hookean material's own shear energy over its modulus,

    e = (|F|^2 - 3) / 2 - (J - 1),    F = I + h,    J = det F,

which is (I1 - 3) / 2 where no volume changes, and a material's ``stiffening`` s, its energy density
and stress are

    mu s / 3 max(e, 0)^3    and    mu s max(e, 0)^2 (F - cof F),

so that the shear modulus grows from mu to mu (1 + s e^2). That is the third term of O. H. Yeoh
(Some forms of the strain energy function for rubber, Rubber Chem. Technol. 66, 1993, eq. 7), with
C30 = mu s / 24. At rest neither stress nor stiffness changes, and hardly up to a third of
compression.

|F|^2 and -J are polyconvex, and max(e, 0)^3 is convex and never falls with e. So for s >= 0 the
energy is polyconvex, hence elliptic (J. M. Ball, Convexity conditions and existence theorems in
nonlinear elasticity, Arch. Rational Mech. Anal. 63, 1977): it softens in no direction. Without a
root, logarithm or pole it has a stress and two continuous derivatives where tissue is inverted.

Only the tetrahedra that stiffen are summed, so that others take no longer.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import DTypeLike, NDArray

from us_sim.kernels import njit
from us_sim.tissue.elasticity.linear_tetrahedra import shape_gradients
from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.elasticity.neo_hookean_material import (
    INLINED,
    LOOP,
    ONE,
    cofactor_change,
    cofactor_slope,
    inner,
    neo_hookean_constants,
    shear_energy,
)
from us_sim.tissue.elasticity.nodal_sums import (
    LANES,
    OUT,
    ROWS,
    SHAPE,
    gather,
    gradient,
    in_lanes,
    nine,
    put_forces,
    put_nine,
    put_six,
    scatter,
    three,
)
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh

_MODULUS, _CONSTANTS = SHAPE + 9, SHAPE + 10  # Row of the constants of V mu s; their number
_ENERGY = OUT + 12  # Row of energies, behind those of forces
# Rows that the tangent needs: the displacement's gradient, V mu s e^2, 2 V mu s e; their number.
_GRADIENT, _SHEAR, _RISE, _TANGENT = np.int64(0), 9, 10, 11


@njit(**INLINED)
def _beyond(h):
    """max(e, 0)."""
    e = shear_energy(h)
    return e if e > 0 else ONE - ONE


@njit(**INLINED)
def _direction(h):
    """F - cof F, the derivative of e."""
    c = cofactor_change(h)
    return (
        h[0] - c[0],
        h[1] - c[1],
        h[2] - c[2],
        h[3] - c[3],
        h[4] - c[4],
        h[5] - c[5],
        h[6] - c[6],
        h[7] - c[7],
        h[8] - c[8],
    )


@njit(**INLINED)
def _sum(a, x, b, y):
    """The matrix a x + b y."""
    return (
        a * x[0] + b * y[0],
        a * x[1] + b * y[1],
        a * x[2] + b * y[2],
        a * x[3] + b * y[3],
        a * x[4] + b * y[4],
        a * x[5] + b * y[5],
        a * x[6] + b * y[6],
        a * x[7] + b * y[7],
        a * x[8] + b * y[8],
    )


@njit(**INLINED)
def _stress_rise(h, d, shear, rise):
    """The change of the stress for a small change d of h."""
    n = _direction(h)
    bent = _sum(shear, d, -shear, cofactor_slope(h, d))
    return _sum(ONE, bent, rise * inner(n, d), n)


@njit(**INLINED)
def _block(g, n, shear, rise):
    """(xx, xy, xz, yy, yz, zz), how a node with the shape gradient g resists its displacement."""
    x = n[0] * g[0] + n[1] * g[1] + n[2] * g[2]
    y = n[3] * g[0] + n[4] * g[1] + n[5] * g[2]
    z = n[6] * g[0] + n[7] * g[1] + n[8] * g[2]
    plain = shear * (g[0] * g[0] + g[1] * g[1] + g[2] * g[2])
    return (
        plain + rise * x * x,
        rise * x * y,
        rise * x * z,
        plain + rise * y * y,
        rise * y * z,
        plain + rise * z * z,
    )


@njit(**LOOP)
def _add_forces(displacement, nodes, constants, lanes, forces):
    total = 0.0
    for chunk in range(len(nodes)):
        gather(displacement, nodes[chunk], lanes)
        rows = constants[chunk]
        for w in range(LANES):
            h = gradient(lanes, rows, w)
            e, n = _beyond(h), _direction(h)
            shear = rows[_MODULUS * LANES + w] * e * e
            lanes[_ENERGY * LANES + w] = shear * e
            put_forces(_sum(shear, n, ONE - ONE, n), rows, w, lanes)
        for w in range(LANES):
            total += lanes[_ENERGY * LANES + w]
        scatter(lanes, nodes[chunk], forces)
    return total / 3.0


@njit(**LOOP)
def _linearise(displacement, nodes, constants, lanes, tangent):
    for chunk in range(len(nodes)):
        gather(displacement, nodes[chunk], lanes)
        rows = constants[chunk]
        kept = tangent[chunk]
        for w in range(LANES):
            h = gradient(lanes, rows, w)
            put_nine(h, kept, _GRADIENT, w)
            e, modulus = _beyond(h), rows[_MODULUS * LANES + w]
            kept[_SHEAR * LANES + w] = modulus * e * e
            kept[_RISE * LANES + w] = (modulus + modulus) * e


@njit(**LOOP)
def _add_product(change, nodes, constants, tangent, lanes, product):
    for chunk in range(len(nodes)):
        gather(change, nodes[chunk], lanes)
        rows = constants[chunk]
        kept = tangent[chunk]
        for w in range(LANES):
            h, d = nine(kept, _GRADIENT, w), gradient(lanes, rows, w)
            shear, rise = kept[_SHEAR * LANES + w], kept[_RISE * LANES + w]
            put_forces(_stress_rise(h, d, shear, rise), rows, w, lanes)
        scatter(lanes, nodes[chunk], product)


@njit(**LOOP)
def _add_blocks(nodes, constants, tangent, lanes, blocks):
    for chunk in range(len(nodes)):
        rows = constants[chunk]
        kept = tangent[chunk]
        for w in range(LANES):
            n = _direction(nine(kept, _GRADIENT, w))
            shear, rise = kept[_SHEAR * LANES + w], kept[_RISE * LANES + w]
            x, y, z = three(rows, SHAPE, w), three(rows, SHAPE + 3, w), three(rows, SHAPE + 6, w)
            o = (-(x[0] + y[0] + z[0]), -(x[1] + y[1] + z[1]), -(x[2] + y[2] + z[2]))
            put_six(_block(o, n, shear, rise), lanes, OUT, w)
            put_six(_block(x, n, shear, rise), lanes, OUT + 6, w)
            put_six(_block(y, n, shear, rise), lanes, OUT + 12, w)
            put_six(_block(z, n, shear, rise), lanes, OUT + 18, w)
        for corner in range(4):
            at = nodes[chunk, corner * LANES : (corner + 1) * LANES]
            for entry in range(6):
                values = blocks[entry]
                added = lanes[(OUT + 6 * corner + entry) * LANES :]
                for w in range(LANES):
                    values[at[w]] += added[w]


class Stiffening:
    """Energy, forces and tangent of the stiffening of a mesh, added to those of `NeoHookean`.

    Args:
        mesh: in frame ``patient``.
        materials: of each tetrahedron, of which some stiffen.
        dtype: of all fields.
    """

    def __init__(self, mesh: TetrahedralMesh, materials: TissueMaterials, dtype: DTypeLike) -> None:
        some = np.flatnonzero(materials.stiffening)
        rows = np.empty((len(some), _CONSTANTS))
        rows[:, SHAPE:_MODULUS] = shape_gradients(mesh)[some, 1:].reshape(-1, 9)
        shear = neo_hookean_constants(mesh, materials).shear
        rows[:, _MODULUS] = (mesh.volumes * shear * materials.stiffening)[some]
        # Lanes beyond the last tetrahedron name node 0 and have no stiffness.
        self._nodes = in_lanes(mesh.tetrahedra[some].astype(np.uint32))
        self._constants = in_lanes(rows).astype(dtype)
        self._tangent = np.zeros((len(self._nodes), _TANGENT * LANES), dtype=dtype)
        self._lanes = np.zeros(ROWS * LANES, dtype=dtype)

    def add_forces(self, displacement: NDArray, forces: NDArray) -> float:
        """Add the energy's slope to ``forces``, (3, N) N; returns the energy, J."""
        return float(_add_forces(displacement, self._nodes, self._constants, self._lanes, forces))

    def linearise(self, displacement: NDArray) -> None:
        """Set the displacement (3, N) m of `add_product` and `add_blocks`."""
        _linearise(displacement, self._nodes, self._constants, self._lanes, self._tangent)

    def add_product(self, change: NDArray, product: NDArray) -> None:
        """Add the change of the forces for a change (3, N) m of the displacement."""
        _add_product(change, self._nodes, self._constants, self._tangent, self._lanes, product)

    def add_blocks(self, blocks: NDArray) -> None:
        """Add to each node's block of the tangent, (6, N) N/m."""
        _add_blocks(self._nodes, self._constants, self._tangent, self._lanes, blocks)
