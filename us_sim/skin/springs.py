"""Forces and energy of prestrained edge springs and zero-length anchors (the paper, section V).

A spring's force at rest is taken off, since the anchors bear it: nothing pulls on a surface at
rest. Per unit of stiffness that is its ``rest_tension``.

>>> import numpy as np
>>> from us_sim.skin.springs import spring_forces
>>> rest = np.array([[0.0, 0, 0], [0.01, 0, 0]])
>>> edge, natural_length, rest_tension = np.array([[0, 1]]), np.array([0.01]), np.zeros((1, 3))
>>> force = np.empty((2, 3))
>>> pulled = rest + [[0.0, 0, 0], [0.001, 0, 0]]
>>> spring_forces(force, pulled, rest, edge, natural_length, rest_tension, 40.0, 4.0)
>>> np.round(force[:, 0], 6)
array([ 0.04 , -0.044])
"""

from __future__ import annotations

import numpy as np

from us_sim.kernels import njit

SHORTEST = 0.5
"""Fraction of its natural length below which a spring's force falls to zero with its length. The
force of a spring that turns over would otherwise jump, and no step would be stable."""


@njit(cache=True, nogil=True, error_model="numpy")
def spring_forces(force, x, rest, edges, natural_length, rest_tension, stiffness, anchor):
    """Fills force (N, 3) N with that of the edge springs and the anchors."""
    for i in range(len(x)):
        for a in range(3):
            force[i, a] = anchor * (rest[i, a] - x[i, a])
    if stiffness == 0.0:
        return
    for e in range(len(edges)):
        i = edges[e, 0]
        j = edges[e, 1]
        dx = x[j, 0] - x[i, 0]
        dy = x[j, 1] - x[i, 1]
        dz = x[j, 2] - x[i, 2]
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        stretch = 1.0 - natural_length[e] / max(length, SHORTEST * natural_length[e])
        fx = stiffness * (stretch * dx - rest_tension[e, 0])
        fy = stiffness * (stretch * dy - rest_tension[e, 1])
        fz = stiffness * (stretch * dz - rest_tension[e, 2])
        force[i, 0] += fx
        force[i, 1] += fy
        force[i, 2] += fz
        force[j, 0] -= fx
        force[j, 1] -= fy
        force[j, 2] -= fz


@njit(cache=True, nogil=True, error_model="numpy")
def spring_energy(x, v, rest, edges, natural_length, rest_tension, stiffness, anchor, mass):
    """J, energy of motion, anchors and springs, less that of the springs at rest."""
    total = 0.0
    for i in range(len(x)):
        for a in range(3):
            total += 0.5 * mass[i] * v[i, a] ** 2 + 0.5 * anchor * (x[i, a] - rest[i, a]) ** 2
    for e in range(len(edges)):
        i = edges[e, 0]
        j = edges[e, 1]
        length = 0.0
        at_rest = 0.0
        work = 0.0
        for a in range(3):
            length += (x[j, a] - x[i, a]) ** 2
            at_rest += (rest[j, a] - rest[i, a]) ** 2
            work += rest_tension[e, a] * (x[j, a] - x[i, a] - rest[j, a] + rest[i, a])
        stored = _stored(np.sqrt(length), natural_length[e])
        total += stiffness * (stored - _stored(np.sqrt(at_rest), natural_length[e]) - work)
    return total


@njit(inline="always", error_model="numpy")
def _stored(length, natural_length):
    """m², energy of a spring over its stiffness."""
    if length >= SHORTEST * natural_length:
        return 0.5 * (length - natural_length) ** 2
    slope = 1.0 / SHORTEST - 1.0
    at_shortest = 0.5 * ((1.0 - SHORTEST) * natural_length) ** 2
    return at_shortest + 0.5 * slope * ((SHORTEST * natural_length) ** 2 - length**2)
