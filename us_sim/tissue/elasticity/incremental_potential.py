"""The potential that an implicit Euler step of damped springs and volumes minimises.

A step of h from x0 with velocity v minimises, over positions x,

    |x - x0 - h v|**2 M / 2 h**2 + W(x) + (b / h) D(x)

(M. Ortiz and L. Stainier, The variational formulation of viscoplastic constitutive updates, Comput.
Methods Appl. Mech. Engrg. 171, 1999), where W is sum of k (L - L0)**2 / 2 over springs and of
V e (J - 1)**2 / 2 over volumes, and D the same with the lengths and volumes at x0 for those at
rest: damping by b times the stiffness. A damped spring is then only a stiffer one of another
length, k (1 + b / h) and (L0 + L(x0) b / h) / (1 + b / h), and a volume likewise.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from us_sim.kernels import njit
from us_sim.tissue.elasticity.springs import SpringNetwork, VolumeTerm, area_vectors, push_corners


class IncrementalPotential:
    """Value, forces and curvature of the function above.

    Args:
        springs, volume: of the tissue.
        mass: (N,) kg.
        time_step: h, s.
        damping_factor: b, s.
    """

    def __init__(
        self,
        springs: SpringNetwork,
        volume: VolumeTerm,
        mass: NDArray[np.float64],
        time_step: float,
        damping_factor: float,
    ) -> None:
        self._springs = (springs.edges, springs.stiffness)
        self._rest_length = springs.rest_length
        self._volume = volume.arrays
        self._rest_volume = volume.rest_volume
        self._time_step = time_step
        self._stiffening = 1.0 + damping_factor / time_step
        self._inertia = mass / time_step**2
        self._lengths = np.empty_like(self._rest_length)
        self._volumes = np.empty_like(self._rest_volume)
        self._target = np.zeros((len(mass), 3))

    @property
    def viscous_part(self) -> float:
        """Fraction of the elastic energy at a step's start that `evaluate` does not count there."""
        return 1.0 - 1.0 / self._stiffening

    def begin(self, positions: NDArray[np.float64], velocity: NDArray[np.float64]) -> None:
        """Start a step from positions (N, 3) m and velocity (N, 3) m/s."""
        _set_targets(
            *(self._springs[0], self._rest_length, self._volume.tetrahedra, self._rest_volume),
            *(positions, self._stiffening, self._lengths, self._volumes),
        )
        self._target = positions + self._time_step * velocity

    def evaluate(self, positions: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """J, up to a constant of the step, and minus its gradient (N, 3) N, at positions (N, 3)."""
        return self._value(self._lengths, self._volumes, positions, self._stiffening, self._inertia)

    def elastic(self, positions: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        """Energy W, J, and its forces (N, 3) N, without inertia and damping."""
        return self._value(
            self._rest_length, self._rest_volume, positions, 1.0, np.zeros_like(self._inertia)
        )

    def _value(
        self,
        lengths: NDArray,
        volumes: NDArray,
        positions: NDArray,
        stiffening: float,
        inertia: NDArray,
    ) -> tuple[float, NDArray]:
        force = np.zeros_like(positions)
        value = _add_spring_forces(*self._springs, lengths, positions, force)
        value += _add_volume_forces(self._volume, volumes, positions, force)
        value = stiffening * value + _add_inertia(
            inertia, self._target, positions, stiffening, force
        )
        return value, force

    def curvature(self, positions: NDArray[np.float64], direction: NDArray[np.float64]) -> float:
        """J, second derivative along direction (N, 3) m, without terms that could be negative."""
        elastic = _spring_curvature(*self._springs, self._lengths, positions, direction)
        elastic += _volume_curvature(self._volume, positions, direction)
        inertia = float(self._inertia @ np.einsum("ij,ij->i", direction, direction))
        return self._stiffening * elastic + inertia


@njit(cache=True, nogil=True, error_model="numpy")
def _set_targets(edges, rest_length, tetrahedra, rest_volume, x, stiffening, length, volume):
    """Fills length (E,) and volume (M,) to which a step from x (N, 3) draws springs and volumes."""
    viscous = 1.0 - 1.0 / stiffening  # exactly zero without viscosity
    for e in range(len(edges)):
        u = x[edges[e, 1], 0] - x[edges[e, 0], 0]
        v = x[edges[e, 1], 1] - x[edges[e, 0], 1]
        w = x[edges[e, 1], 2] - x[edges[e, 0], 2]
        now = math.sqrt(u * u + v * v + w * w)
        length[e] = rest_length[e] + viscous * (now - rest_length[e])
    for t in range(len(tetrahedra)):
        now = area_vectors(x, tetrahedra, t)[0]
        volume[t] = rest_volume[t] + viscous * (now - rest_volume[t])


@njit(cache=True, nogil=True, error_model="numpy")
def _add_inertia(inertia, target, positions, stiffening, force):
    """Turns force (N, 3) into that of a step; returns the energy of inertia (N,) N/m, J."""
    value = 0.0
    for i in range(len(positions)):
        for axis in range(3):
            lag = target[i, axis] - positions[i, axis]
            value += 0.5 * inertia[i] * lag * lag
            force[i, axis] = stiffening * force[i, axis] + inertia[i] * lag
    return value


@njit(cache=True, nogil=True, error_model="numpy")
def _add_spring_forces(edges, stiffness, rest_length, x, force):
    """Adds the forces of springs to force (N, 3), and returns their energy, J."""
    energy = 0.0
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        u, v, w = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
        length = math.sqrt(u * u + v * v + w * w)
        pull = stiffness[e] * (length - rest_length[e])
        energy += 0.5 * pull * (length - rest_length[e])
        pull = pull / length if length > 0.0 else 0.0
        force[i, 0] += pull * u
        force[i, 1] += pull * v
        force[i, 2] += pull * w
        force[j, 0] -= pull * u
        force[j, 1] -= pull * v
        force[j, 2] -= pull * w
    return energy


@njit(cache=True, nogil=True, error_model="numpy")
def _add_volume_forces(volumes, target_volume, x, force):
    """Adds the forces of volumes to force (N, 3), and returns their energy, J."""
    tetrahedra, rest_volume, element, nodal = volumes[:4]
    inverse_weight, mean = volumes.inverse_weight, volumes.mean
    energy = 0.0
    mean[:] = 0.0
    for t in range(len(tetrahedra) if len(mean) > 0 else 0):
        volume = area_vectors(x, tetrahedra, t)[0]
        quarter = 0.25 * nodal[t] * (volume - target_volume[t])
        for corner in range(4):
            mean[tetrahedra[t, corner]] += quarter
    for i in range(len(mean)):
        energy += 0.5 * mean[i] * mean[i] * inverse_weight[i]
        mean[i] *= inverse_weight[i]
    for t in range(len(tetrahedra)):
        a, b, c, d = tetrahedra[t, 0], tetrahedra[t, 1], tetrahedra[t, 2], tetrahedra[t, 3]
        volume, px, py, pz, qx, qy, qz, rx, ry, rz = area_vectors(x, tetrahedra, t)
        change = volume - target_volume[t]
        push = -element[t] * change / rest_volume[t]
        energy -= 0.5 * push * change
        if len(mean) > 0:
            push -= 0.25 * nodal[t] * (mean[a] + mean[b] + mean[c] + mean[d])
        push /= 6.0
        push_corners(tetrahedra, t, push, px, py, pz, qx, qy, qz, rx, ry, rz, force)
    return energy


@njit(cache=True, nogil=True, error_model="numpy")
def _spring_curvature(edges, stiffness, rest_length, x, direction):
    """J, second derivative of the springs' energy along direction (N, 3), no spring's below 0."""
    total = 0.0
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        u, v, w = x[j, 0] - x[i, 0], x[j, 1] - x[i, 1], x[j, 2] - x[i, 2]
        p = direction[j, 0] - direction[i, 0]
        q = direction[j, 1] - direction[i, 1]
        r = direction[j, 2] - direction[i, 2]
        square = u * u + v * v + w * w
        if square == 0.0:
            continue
        along = u * p + v * q + w * r
        along = along * along / square
        tension = max(0.0, 1.0 - rest_length[e] / math.sqrt(square))
        total += stiffness[e] * (along + tension * max(0.0, p * p + q * q + r * r - along))
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _volume_curvature(volumes, x, direction):
    """J, second derivative of the volumes' energy along direction (N, 3), without their bending."""
    tetrahedra, rest_volume, element, nodal = volumes[:4]
    inverse_weight, mean = volumes.inverse_weight, volumes.mean
    total = 0.0
    mean[:] = 0.0
    y = direction
    for t in range(len(tetrahedra)):
        a, b, c, d = tetrahedra[t, 0], tetrahedra[t, 1], tetrahedra[t, 2], tetrahedra[t, 3]
        _, px, py, pz, qx, qy, qz, rx, ry, rz = area_vectors(x, tetrahedra, t)
        rate = (y[b, 0] - y[a, 0]) * px + (y[b, 1] - y[a, 1]) * py + (y[b, 2] - y[a, 2]) * pz
        rate += (y[c, 0] - y[a, 0]) * qx + (y[c, 1] - y[a, 1]) * qy + (y[c, 2] - y[a, 2]) * qz
        rate += (y[d, 0] - y[a, 0]) * rx + (y[d, 1] - y[a, 1]) * ry + (y[d, 2] - y[a, 2]) * rz
        rate /= 6.0
        total += element[t] * rate * rate / rest_volume[t]
        if len(mean) > 0:
            quarter = 0.25 * nodal[t] * rate
            mean[a] += quarter
            mean[b] += quarter
            mean[c] += quarter
            mean[d] += quarter
    for i in range(len(mean)):
        total += mean[i] * mean[i] * inverse_weight[i]
    return total
