"""Contact of a surface with the moving probe, as the rigid limit of the paper's repulsion.

Particles inside the collider are put on its surface. Then the middles of the triangles' parts are,
so that no edge of the probe comes through between them; a triangle's particles follow by weight and
mass, as an impulse would send them (M. Mueller et al., Position based dynamics, J. Vis. Commun.
Image Represent. 18, 2007). They are pushed one after the other, which leaves them within a few
hundredths of their distance from where the energy is least.

>>> import numpy as np
>>> from us_sim.geometry.collider import Sphere
>>> from us_sim.skin.contact import PartArrays, push_out
>>> particle, way, none = np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((0, 3))
>>> above, pressed = np.array([0.0, 0, 0, 0, 0, 0, 1]), np.array([0, 0, 0.002, 0, 0, 0, 1])
>>> parts = PartArrays(none.astype(np.uint32), np.zeros(1, int), none)
>>> push_out(particle, way, np.ones(1), parts, 0.0, Sphere(0.03).offset_box, above, pressed, 0.5)
1
>>> particle, way
(array([[0.   , 0.   , 0.001]]), array([[0.   , 0.   , 0.001]]))
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.collider_distance import offset_box_distance
from us_sim.kernels import njit


class PartArrays(NamedTuple):
    """Parts of a surface's triangles, as the kernel takes them."""

    triangles: NDArray[np.uint32]  # (T, 3) particles
    first: NDArray[np.integer]  # (T + 1,) where a triangle's parts begin
    weights: NDArray[np.float64]  # (P, 3) of the particles in each part's middle


@njit(cache=True, nogil=True, error_model="numpy")
def push_out(x, way, mass, parts, longest, box, start, end, fraction):
    """Puts particles and parts inside the collider on its surface; returns how many.

    The probe is at ``fraction`` of the path from ``start`` to ``end``. ``way`` (N, 3) m is set to
    how far each particle of ``mass`` (N,) kg was pushed. No side of a triangle is longer than
    ``longest`` (m). The collider is convex, so it reaches no triangle with a corner that is farther
    off than that.
    """
    r, p = _place(start, end, fraction)
    # The whole collider lies within this distance of its middle.
    middle = box[2] + box[3]
    reach = box[3] + np.sqrt(box[0] ** 2 + box[1] ** 2 + box[2] ** 2)
    away = np.empty(len(x))  # m, of each particle from the collider, or less
    contacts = 0
    for i in range(len(x)):
        way[i] = 0.0
        a, b, c = x[i, 0] - p[0], x[i, 1] - p[1], x[i, 2] - p[2]
        square = (a + r[0, 2] * middle) ** 2
        square += (b + r[1, 2] * middle) ** 2 + (c + r[2, 2] * middle) ** 2
        if square > reach**2:
            away[i] = np.sqrt(square) - reach
            continue
        away[i] = _push_particle(x, way, i, box, r, p)
        if away[i] < 0.0:
            away[i] = 0.0
            contacts += 1
    triangles, first, weights = parts
    for t in range(len(triangles)):
        i, j, k = triangles[t]
        if max(away[i], away[j], away[k]) > longest:
            continue
        if _is_parallel(way[i], way[j]) and _is_parallel(way[i], way[k]):
            continue  # on one flat side
        gaps = away[i], away[j], away[k]
        for m in range(first[t], first[t + 1]):
            contacts += _push_part(x, way, (i, j, k), gaps, mass, weights[m], box, r, p)
    for i in range(len(x)):
        if way[i, 0] != 0.0 or way[i, 1] != 0.0 or way[i, 2] != 0.0:
            _push_particle(x, way, i, box, r, p)
    return contacts


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _is_parallel(a, b):
    """Whether two vectors (3,) are, and neither is zero."""
    dot = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    squares = (a[0] ** 2 + a[1] ** 2 + a[2] ** 2) * (b[0] ** 2 + b[1] ** 2 + b[2] ** 2)
    return squares > 0.0 and dot > 0.0 and dot * dot >= (1.0 - 1e-12) * squares


@njit(cache=True, nogil=True, error_model="numpy")
def _place(start, end, fraction):
    """Rotation (3, 3) and place (3,) on the way from one placement to another."""
    cosine = start[3] * end[3] + start[4] * end[4] + start[5] * end[5] + start[6] * end[6]
    sign = 1.0 if cosine >= 0.0 else -1.0
    qx = start[3] + fraction * (sign * end[3] - start[3])
    qy = start[4] + fraction * (sign * end[4] - start[4])
    qz = start[5] + fraction * (sign * end[5] - start[5])
    qw = start[6] + fraction * (sign * end[6] - start[6])
    scale = 2.0 / (qx * qx + qy * qy + qz * qz + qw * qw)
    r = np.empty((3, 3))
    r[0, 0] = 1.0 - scale * (qy * qy + qz * qz)
    r[0, 1] = scale * (qx * qy - qw * qz)
    r[0, 2] = scale * (qx * qz + qw * qy)
    r[1, 0] = scale * (qx * qy + qw * qz)
    r[1, 1] = 1.0 - scale * (qx * qx + qz * qz)
    r[1, 2] = scale * (qy * qz - qw * qx)
    r[2, 0] = scale * (qx * qz - qw * qy)
    r[2, 1] = scale * (qy * qz + qw * qx)
    r[2, 2] = 1.0 - scale * (qx * qx + qy * qy)
    return r, start[:3] + fraction * (end[:3] - start[:3])


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _distance(box, r, a, b, c):
    """Distance (m) and the collider's normal at a place (a, b, c) m from the probe's origin."""
    distance, lx, ly, lz = offset_box_distance(
        box,
        r[0, 0] * a + r[1, 0] * b + r[2, 0] * c,
        r[0, 1] * a + r[1, 1] * b + r[2, 1] * c,
        r[0, 2] * a + r[1, 2] * b + r[2, 2] * c,
    )
    return (
        distance,
        r[0, 0] * lx + r[0, 1] * ly + r[0, 2] * lz,
        r[1, 0] * lx + r[1, 1] * ly + r[1, 2] * lz,
        r[2, 0] * lx + r[2, 1] * ly + r[2, 2] * lz,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _push_particle(x, way, i, box, r, p):
    """Puts a particle on the collider's surface if it is inside; returns its distance before."""
    distance, nx, ny, nz = _distance(box, r, x[i, 0] - p[0], x[i, 1] - p[1], x[i, 2] - p[2])
    if distance < 0.0:
        for axis, n in enumerate((nx, ny, nz)):
            x[i, axis] -= distance * n
            way[i, axis] -= distance * n
    return distance


@njit(cache=True, nogil=True, error_model="numpy")
def _push_part(x, way, corners, gaps, mass, weight, box, r, p):
    """Puts the place of weights (3,) among three particles on the collider's surface if it is
    inside; returns how many. The particles are ``gaps`` (3,) m away from the collider.
    """
    a, b, c, light = -p[0], -p[1], -p[2], 0.0
    for q in range(3):
        w, i = weight[q], corners[q]
        light += w * w / mass[i]
        a += w * x[i, 0]
        b += w * x[i, 1]
        c += w * x[i, 2]
    for q in range(3):
        i = corners[q]
        square_way = (a + p[0] - x[i, 0]) ** 2 + (b + p[1] - x[i, 1]) ** 2
        square_way += (c + p[2] - x[i, 2]) ** 2
        if gaps[q] ** 2 > square_way:
            return 0  # no place so near a particle is inside
    distance, nx, ny, nz = _distance(box, r, a, b, c)
    if distance >= 0.0:
        return 0
    for q in range(3):
        length = -distance * weight[q] / (mass[corners[q]] * light)
        for axis, n in enumerate((nx, ny, nz)):
            x[corners[q], axis] += length * n
            way[corners[q], axis] += length * n
    return 1
