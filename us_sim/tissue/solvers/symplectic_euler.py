"""The paper's time integration (eqs. 3 to 5) of a spring network that a moving probe enters.

Forces change velocities, and the new velocities move the nodes: here a kilogram of free springs
drifts on at its initial speed.

>>> import numpy as np
>>> from us_sim.geometry.collider import Sphere
>>> from us_sim.tissue.elasticity.springs import SpringArrays
>>> from us_sim.tissue.elasticity.springs import VolumeTerm
>>> from us_sim.tissue.solvers.symplectic_euler import (
...     Contact, Particles, ProbeMotion, advance_frame,
... )
>>> edges, one = np.array([[0, 1]], dtype=np.int32), np.ones(1)
>>> springs = SpringArrays(edges, 100.0 * one, 0.1 * one, one)
>>> positions, velocity = np.array([[0.0, 0, 0], [1.0, 0, 0]]), np.array([[0.0, 0, 2], [0.0, 0, 2]])
>>> particles = Particles(np.ones(2), positions, velocity, np.zeros((2, 3)))
>>> away = ProbeMotion(Sphere(0.03).offset_box, False, np.empty((0, 3, 3)), np.empty((0, 3)))
>>> volumes, contact = VolumeTerm.nothing(2).arrays, Contact.at(np.empty(0, np.int32))
>>> advance_frame(springs, volumes, particles, away, contact, 0.01, 1, 20)
>>> positions.round(6).tolist()
[[0.0, 0.0, 0.4], [1.0, 0.0, 0.4]]
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from us_sim.geometry.collider_distance import turned, turned_back
from us_sim.kernels import njit
from us_sim.tissue.contact.penetration import pushing_gap
from us_sim.tissue.elasticity.springs import add_volume_forces, spring_forces


class Particles(NamedTuple):
    """Masses, where they are and how fast they move; kernels write on all but the masses."""

    inverse_mass: NDArray[np.float64]  # (N,), 1/kg, 0 where a particle is fixed
    positions: NDArray[np.float64]  # (N, 3), m
    velocity: NDArray[np.float64]  # (N, 3), m/s
    force: NDArray[np.float64]  # (N, 3), N


class ProbeMotion(NamedTuple):
    """The probe's shape, and where it is in each step; in S = 0 steps when there is no probe."""

    box: NDArray[np.float64]  # the collider's `offset_box`
    forward: bool  # see `us_sim.tissue.contact.penetration.only_forward`
    rotations: NDArray[np.float64]  # (S, 3, 3), probe to patient
    origins: NDArray[np.float64]  # (S, 3), m


class Contact(NamedTuple):
    """Which particles the probe can touch, and what kernels find out about them."""

    reachable: NDArray[np.int32]  # (C,), the particles
    touched: NDArray[np.bool_]  # (C,), in the last sub-step
    normal: NDArray[np.float64]  # (C, 3), where the probe pushes them
    wrench: NDArray[np.float64]  # (2, 3), N and N m on the probe in its frame, mean of the frame

    @classmethod
    def at(cls, reachable: NDArray[np.int32]) -> Contact:
        """A contact in which nothing is touched."""
        count = len(reachable)
        return cls(reachable, np.zeros(count, bool), np.zeros((count, 3)), np.zeros((2, 3)))


@njit(cache=True, nogil=True, error_model="numpy")
def advance_frame(springs, volumes, particles, probe, contact, time_step, substeps, steps):
    """Moves the particles by ``steps`` of ``substeps`` of ``time_step`` (s) each, symplectic Euler.

    Args:
        springs: their `SpringArrays`.
        volumes: their `VolumeArrays`.
        particles: `Particles`, moved here.
        probe: `ProbeMotion` of S = ``steps`` steps, or of none.
        contact: `Contact`, filled in here as of the last sub-step; its wrench is added to.
    """
    inverse_mass, positions, velocity, force = particles
    duration = time_step * steps * substeps
    for step in range(steps):
        for _sub in range(substeps):
            spring_forces(springs, positions, velocity, force)
            if len(volumes.tetrahedra) > 0:
                add_volume_forces(volumes, positions, velocity, force)
            for i in range(len(positions)):
                for axis in range(3):
                    v = velocity[i, axis] + time_step * inverse_mass[i] * force[i, axis]
                    # Ahead of a press motion decays to denormal numbers, ten times as slow.
                    velocity[i, axis] = v if abs(v) > 1e-30 else 0.0
            for i in range(len(positions)):
                for axis in range(3):
                    positions[i, axis] += time_step * velocity[i, axis]
            if len(probe.origins) > 0:
                contact.touched[:] = False
                _stop_at_probe(particles, probe, step, contact, duration)


@njit(cache=True, nogil=True, error_model="numpy")
def _stop_at_probe(particles, probe, step, contact, duration):
    """Puts particles that have entered the probe onto it; they lose their velocity towards it.

    The impulses on the probe, over ``duration`` (s), are added to the wrench.
    """
    inverse_mass, positions, velocity, _ = particles
    reachable, touched, normal, wrench = contact
    r, origin = probe.rotations[step], probe.origins[step]
    for k in range(len(reachable)):
        i = reachable[k]
        a = positions[i, 0] - origin[0]
        b = positions[i, 1] - origin[1]
        c = positions[i, 2] - origin[2]
        x, y, z = turned_back(r, a, b, c)
        gap, u, v, w = pushing_gap(probe.box, probe.forward, 0.0, x, y, z)
        if gap >= 0.0:
            continue
        nx, ny, nz = turned(r, u, v, w)
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
