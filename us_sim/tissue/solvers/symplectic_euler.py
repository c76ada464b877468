"""The paper's time integration (eqs. 3 to 5) of a spring network that a moving probe enters.

Forces change velocities, and the new velocities move the nodes: here a kilogram of free springs
drifts on at the speed it was given.

>>> import numpy as np
>>> from us_sim.geometry.collider import Sphere
>>> from us_sim.tissue.solvers.symplectic_euler import advance_frame
>>> from us_sim.tissue.elasticity.volume_term import VolumeTerm
>>> edges, one = np.array([[0, 1]], dtype=np.int32), np.ones(1)
>>> positions, velocity = np.array([[0.0, 0, 0], [1.0, 0, 0]]), np.array([[0.0, 0, 2], [0.0, 0, 2]])
>>> advance_frame(
...     edges, 100.0 * one, 0.1 * one, one, np.ones(2), positions, velocity, np.zeros((2, 3)),
...     0.01, 1, 20, Sphere(0.03).offset_box, False, np.empty((0, 3, 3)), np.empty((0, 3)),
...     np.empty(0, np.int32), np.empty(0, bool), np.empty((0, 3)), np.zeros((2, 3)),
...     (*VolumeTerm.nothing(2).arrays, np.empty(0), np.empty(0)), 0.0,
... )
>>> positions.round(6).tolist()
[[0.0, 0.0, 0.4], [1.0, 0.0, 0.4]]
"""

from __future__ import annotations

from numba import njit

from us_sim.tissue.contact.penetration import pushing_gap
from us_sim.tissue.elasticity.springs import spring_forces
from us_sim.tissue.elasticity.volume_term import add_volume_forces

__all__ = ["advance_frame"]


@njit(cache=True, nogil=True, error_model="numpy")
def advance_frame(
    edges,
    stiffness,
    damping,
    rest_length,
    inverse_mass,
    positions,
    velocity,
    force,
    time_step,
    substeps,
    steps,
    box,
    forward,
    rotations,
    origins,
    reachable,
    touched,
    normal,
    wrench,
    volume,
    damping_factor,
):
    """Moves positions and velocity (N, 3) by ``steps`` of ``substeps`` each, symplectic Euler.

    The probe is at rotations (steps, 3, 3) and origins (steps, 3), or nowhere when these are empty.
    Fills touched (C,) and normal (C, 3) of the reachable (C,) nodes as they are in the last
    sub-step, and wrench (2, 3) with the mean force and torque on the probe in its frame. A volume
    term is given by its `VolumeTerm.arrays`, an array (M,) to write on, and its yield_area.
    """
    tetrahedra, rest_volume, element, nodal, inverse_weight, mean, change, yield_area = volume
    for step in range(steps):
        for _sub in range(substeps):
            spring_forces(edges, stiffness, damping, rest_length, positions, velocity, force)
            if len(tetrahedra) > 0:
                add_volume_forces(
                    tetrahedra,
                    rest_volume,
                    element,
                    nodal,
                    inverse_weight,
                    mean,
                    change,
                    yield_area,
                    damping_factor,
                    positions,
                    velocity,
                    force,
                )
            for i in range(len(positions)):
                for axis in range(3):
                    v = velocity[i, axis] + time_step * inverse_mass[i] * force[i, axis]
                    # What runs ahead of a press decays to denormal numbers, ten times as slow.
                    velocity[i, axis] = v if abs(v) > 1e-30 else 0.0
            for i in range(len(positions)):
                for axis in range(3):
                    positions[i, axis] += time_step * velocity[i, axis]
            if len(origins) > 0:
                touched[:] = False
                _stop_at_probe(
                    inverse_mass,
                    positions,
                    velocity,
                    time_step * steps * substeps,
                    box,
                    forward,
                    rotations[step],
                    origins[step],
                    reachable,
                    touched,
                    normal,
                    wrench,
                )


@njit(cache=True, nogil=True, error_model="numpy")
def _stop_at_probe(
    inverse_mass,
    positions,
    velocity,
    duration,
    box,
    forward,
    rotation,
    origin,
    reachable,
    touched,
    normal,
    wrench,
):
    """Puts nodes that have entered the probe onto it and takes away their velocity towards it.

    The impulses on the probe, over ``duration``, are added to wrench (2, 3).
    """
    r = rotation
    for k in range(len(reachable)):
        i = reachable[k]
        a = positions[i, 0] - origin[0]
        b = positions[i, 1] - origin[1]
        c = positions[i, 2] - origin[2]
        x = r[0, 0] * a + r[1, 0] * b + r[2, 0] * c
        y = r[0, 1] * a + r[1, 1] * b + r[2, 1] * c
        z = r[0, 2] * a + r[1, 2] * b + r[2, 2] * c
        gap, u, v, w = pushing_gap(box, forward, 0.0, x, y, z)
        if gap >= 0.0:
            continue
        nx = r[0, 0] * u + r[0, 1] * v + r[0, 2] * w
        ny = r[1, 0] * u + r[1, 1] * v + r[1, 2] * w
        nz = r[2, 0] * u + r[2, 1] * v + r[2, 2] * w
        positions[i, 0] -= gap * nx
        positions[i, 1] -= gap * ny
        positions[i, 2] -= gap * nz
        along = velocity[i, 0] * nx + velocity[i, 1] * ny + velocity[i, 2] * nz
        if along >= 0.0:
            continue
        velocity[i, 0] -= along * nx
        velocity[i, 1] -= along * ny
        velocity[i, 2] -= along * nz
        touched[k] = True
        normal[k, 0] = nx
        normal[k, 1] = ny
        normal[k, 2] = nz
        push = along / (inverse_mass[i] * duration)
        x -= gap * u
        y -= gap * v
        z -= gap * w
        wrench[0, 0] += push * u
        wrench[0, 1] += push * v
        wrench[0, 2] += push * w
        wrench[1, 0] += push * (y * w - z * v)
        wrench[1, 1] += push * (z * u - x * w)
        wrench[1, 2] += push * (x * v - y * u)
