"""Contact of particles with the moving probe, as the rigid limit of the paper's repulsion.

>>> import numpy as np
>>> from us_sim.geometry.collider import Sphere
>>> from us_sim.skin.contact import push_out
>>> particle, velocity = np.array([[0.0, 0, 0]]), np.array([[0.1, 0, -0.5]])
>>> normal, touched = np.zeros((1, 3)), np.zeros(1, dtype=bool)
>>> above, pressed = np.array([0.0, 0, 0, 0, 0, 0, 1]), np.array([0, 0, 0.002, 0, 0, 0, 1])
>>> sphere = Sphere(0.03).offset_box
>>> push_out(particle, velocity, normal, touched, sphere, above, pressed, 0.5)
1
>>> particle, velocity
(array([[0.   , 0.   , 0.001]]), array([[0.1, 0. , 0. ]]))
"""

from __future__ import annotations

import numpy as np

from us_sim.geometry.collider_distance import offset_box_distance
from us_sim.kernels import njit

__all__ = ["push_out"]


@njit(cache=True, nogil=True, error_model="numpy")
def push_out(x, v, normal, touched, box, start, end, fraction):
    """Puts particles inside the collider on its surface; returns how many.

    The probe is at ``fraction`` of the path from ``start`` to ``end``. ``touched`` (N,) and
    ``normal`` (N, 3) tell which particles, and the collider's outward normals there.
    """
    cosine = start[3] * end[3] + start[4] * end[4] + start[5] * end[5] + start[6] * end[6]
    sign = 1.0 if cosine >= 0.0 else -1.0
    qx = start[3] + fraction * (sign * end[3] - start[3])
    qy = start[4] + fraction * (sign * end[4] - start[4])
    qz = start[5] + fraction * (sign * end[5] - start[5])
    qw = start[6] + fraction * (sign * end[6] - start[6])
    scale = 2.0 / (qx * qx + qy * qy + qz * qz + qw * qw)
    r00 = 1.0 - scale * (qy * qy + qz * qz)
    r01 = scale * (qx * qy - qw * qz)
    r02 = scale * (qx * qz + qw * qy)
    r10 = scale * (qx * qy + qw * qz)
    r11 = 1.0 - scale * (qx * qx + qz * qz)
    r12 = scale * (qy * qz - qw * qx)
    r20 = scale * (qx * qz - qw * qy)
    r21 = scale * (qy * qz + qw * qx)
    r22 = 1.0 - scale * (qx * qx + qy * qy)
    px = start[0] + fraction * (end[0] - start[0])
    py = start[1] + fraction * (end[1] - start[1])
    pz = start[2] + fraction * (end[2] - start[2])
    # The whole collider lies within this distance of its middle.
    middle = box[2] + box[3]
    reach = box[3] + np.sqrt(box[0] ** 2 + box[1] ** 2 + box[2] ** 2)
    contacts = 0
    for i in range(len(x)):
        touched[i] = False
        a = x[i, 0] - px
        b = x[i, 1] - py
        c = x[i, 2] - pz
        if (a + r02 * middle) ** 2 + (b + r12 * middle) ** 2 + (c + r22 * middle) ** 2 > reach**2:
            continue
        distance, lx, ly, lz = offset_box_distance(
            box,
            r00 * a + r10 * b + r20 * c,
            r01 * a + r11 * b + r21 * c,
            r02 * a + r12 * b + r22 * c,
        )
        if distance >= 0.0:
            continue
        nx = r00 * lx + r01 * ly + r02 * lz
        ny = r10 * lx + r11 * ly + r12 * lz
        nz = r20 * lx + r21 * ly + r22 * lz
        x[i, 0] -= distance * nx
        x[i, 1] -= distance * ny
        x[i, 2] -= distance * nz
        into = min(v[i, 0] * nx + v[i, 1] * ny + v[i, 2] * nz, 0.0)
        v[i, 0] -= into * nx
        v[i, 1] -= into * ny
        v[i, 2] -= into * nz
        normal[i, 0] = nx
        normal[i, 1] = ny
        normal[i, 2] = nz
        touched[i] = True
        contacts += 1
    return contacts
