"""The stable neo-Hookean material at one point, as a function of the displacement's gradient.

Energy density of the deformation gradient F = I + h, with J = det F (B. Smith, F. de Goes and
T. Kim, Stable Neo-Hookean Flesh Simulation, ACM Trans. Graph. 37, 2018, eq. 13, without the
logarithmic barrier):

    mu/2 (|F|^2 - 3) - mu (J - 1) + bulk/2 (J - 1)^2,    bulk = lambda + mu.

It is a polynomial, so it holds for inverted tissue too, and linearised at rest it is Hooke's law.
But a finite force can press a tetrahedron to nothing, as under a probe's edge. So below a quarter
of its volume (J0) a term is added that begins with two continuous derivatives and grows without
bound,

    wall (J0 - J)^3 / (3 J0 J),

with the modulus of `us_sim.tissue.elasticity.wall`, and that goes on below a fiftieth as its Taylor
polynomial of second order, so that it is defined everywhere.

Everything is written in h, not F, so that small strains keep all their digits in single precision.

A 3x3 matrix is a tuple of nine numbers, row by row. These functions are compiled into the loops
that call them, which LLVM then turns into vector instructions.

>>> from us_sim.tissue.elasticity.neo_hookean_point import stress, volume_change
>>> quarter_turn = (-1.0, -1.0, 0.0, 1.0, -1.0, 0.0, 0.0, 0.0, 0.0)
>>> volume_change(quarter_turn)
0.0
>>> stress(quarter_turn, 3000.0, 0.0) == (0.0,) * 9
True
"""

from __future__ import annotations

from typing import Any

import numpy as np

from us_sim.kernels import njit

LOOP: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract", "nsz"},
}
"""How loops are compiled: with fused multiply-adds, but NaN stays NaN."""

INLINED: dict[str, Any] = {**LOOP, "forceinline": True}
"""How the functions that these loops call are compiled."""

ONE, HALF = np.float32(1.0), np.float32(0.5)
_THREE = np.float32(3.0)
"""Numbers that are exact in any precision. Literals would turn single precision into double."""

_CROWDED, _CRUSHED = np.float32(0.25), np.float32(0.02)
"""Volume ratios J at which a tetrahedron begins to resist being crushed, and is crushed."""


@njit(**INLINED)
def inner(a, b):
    """The sum of the products of the entries of two matrices."""
    return (
        (a[0] * b[0] + a[1] * b[1] + a[2] * b[2])
        + (a[3] * b[3] + a[4] * b[4] + a[5] * b[5])
        + (a[6] * b[6] + a[7] * b[7] + a[8] * b[8])
    )


@njit(**INLINED)
def cofactor_change(h):
    """cof(I + h) - I; cof F is the derivative of det F."""
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
    """The change of cof(I + h) for a small change d of h."""
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
    """det(I + h) - 1 - trace h."""
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
    """J - 1, that is det(I + h) - 1."""
    return (h[0] + h[4] + h[8]) + _volume_change_beyond_trace(h)


@njit(**INLINED)
def crowding_below(change, onset):
    """The term against being crushed that begins at J = onset, over its modulus, and its two slopes
    by J = change + 1.
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
def crowding(change):
    """That of a solid."""
    return crowding_below(change, _CROWDED)


@njit(**INLINED)
def energy_density(h, shear, bulk, wall):
    """The energy density above."""
    beyond = _volume_change_beyond_trace(h)
    change = (h[0] + h[4] + h[8]) + beyond
    plain = shear * (HALF * inner(h, h) - beyond) + HALF * (bulk * change * change)
    return plain + wall * crowding(change)[0]


@njit(**INLINED)
def stress(h, shear, pressure):
    """First Piola-Kirchhoff stress mu F + (p - mu) cof F; p is the other energy's slope by J."""
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
    """The change of the stress for a small change d of h.

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
    """The change of J for a small change d of h."""
    return inner(cofactor_change(h), d) + (d[0] + d[4] + d[8])


@njit(**INLINED)
def bulk_slope(change, element, wall):
    """How fast the pressure rises with J = change + 1: by element, and against being crushed."""
    return element + wall * crowding(change)[2]


@njit(**INLINED)
def stress_rise(h, d, shear, bulk, k, nodal):
    """The change of the stress for a small change d of h and a change nodal of the mean pressure.

    bulk is the `bulk_slope` at h, and k is p - mu.
    """
    c = cofactor_change(h)
    rise = bulk * (inner(c, d) + (d[0] + d[4] + d[8])) + nodal
    return _stress_slope(h, c, d, shear, k, rise)


@njit(**INLINED)
def block(g, c, shear, bulk):
    """(xx, xy, xz, yy, yz, zz) of mu g.g I + bulk (cof F g)(cof F g)', c being cof F - I.

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
