"""A cylinder pressed between platens to which it sticks, by the elements of `fem_nonlinear`.

The platens' nodes are moved in steps, and Newton's method with a line search brings the others to
balance. From about a fifth of compression on the bulging side folds onto the platens: a penalty
keeps its nodes between them, without friction.

>>> from us_sim.evaluation.measured.stuck_cylinder import StuckCylinder
>>> StuckCylinder(0.025, 0.03, (6, 4)).press([0.05, 0.1]).round(6).tolist()
[0.000511, 0.001098]
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from us_sim.errors import SolverError
from us_sim.geometry.collider import Sphere
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import uniform_material
from us_sim.tissue.elasticity.neo_hookean import NeoHookean
from us_sim.tissue.linear_algebra.sparse_factors import FactoredStiffness
from us_sim.tissue.linear_algebra.two_level import conjugate_gradients
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, box_mesh
from us_sim.tissue.model import TissueModel

Array = NDArray[np.float64]

_POISSON_RATIO = 0.49  # Nearly incompressible; 0.4999 resists a small compression by 2 % more
_BALANCED = 1e-4  # Unbalanced force over the platen's
_MOST_STEPS, _MOST_ITERATIONS = 60, 300
_FORCING = 0.05  # Residual of a step's linear solution, over that before
_FIRMNESS = 30.0  # Of a platen at a node that folds onto it, over shear modulus times cell size


class StuckCylinder:
    """The cylinder, of a nearly incompressible material of shear modulus 1 Pa.

    Args:
        radius: m.
        height: m.
        counts: of cells across and along it.
        stiffening: of the material.
    """

    def __init__(
        self, radius: float, height: float, counts: tuple[int, int], stiffening: float = 0.0
    ) -> None:
        self._height, self._firmness = height, _FIRMNESS * 2 * radius / counts[0]
        mesh = _cylinder(radius, height, *counts)
        law = Material(2 * (1 + _POISSON_RATIO), _POISSON_RATIO, stiffening=stiffening)
        materials = uniform_material(mesh, law)
        self._z = mesh.nodes[:, 2]
        self._moved = self._z < 1e-9
        fixed = self._moved | (self._z > height - 1e-9)
        nobody = np.zeros(0, dtype=np.int32)
        model = TissueModel(mesh, materials, fixed, Sphere(radius), nobody)
        self._tissue = NeoHookean(mesh, materials, np.float64)
        self._factor = FactoredStiffness(model)

    def press(self, compressions: Sequence[float]) -> Array:
        """(C,) m2, a platen's force over the shear modulus, at rising parts (C,) of the height.

        Raises:
            SolverError: the cylinder does not come to balance.
        """
        displacement = np.zeros((3, self._tissue.count))
        rate, before, forces = np.zeros_like(displacement), 0.0, []
        for compression in compressions:
            start = displacement + (compression - before) * rate
            start[:, self._factor.fixed] = 0.0
            start[2, self._moved] = compression * self._height
            found, force = self._balance(start, compression)
            rate, before = (found - displacement) / (compression - before), compression
            displacement = found
            forces.append(force)
        return np.array(forces)

    def _balance(self, displacement: Array, compression: float) -> tuple[Array, float]:
        """The balanced displacement (3, N) m, and the platen's force, N."""
        tissue, factor = self._tissue, self._factor
        residual = np.empty_like(displacement)
        for _ in range(_MOST_STEPS):
            energy = self._energy(displacement, compression, residual)
            beyond = self._beyond(displacement, compression)
            folded = np.flatnonzero(beyond)
            force = float(
                residual[2, self._moved].sum() - self._firmness * beyond.clip(max=0.0).sum()
            )
            residual[:, factor.fixed] = 0.0
            size = float(np.linalg.norm(residual))
            if size <= _BALANCED * abs(force):
                return displacement, force
            tissue.linearise(displacement)
            springs, normals = np.full(len(folded), self._firmness), np.zeros((len(folded), 3))
            normals[:, 2] = 1.0
            factor.prepare(displacement, folded, normals, springs)

            def product(change: NDArray, image: NDArray, folded: NDArray = folded) -> None:
                tissue.tangent_product(change, image)
                image[2, folded] += self._firmness * change[2, folded]

            solved = conjugate_gradients(
                product, factor, -residual, _MOST_ITERATIONS, _FORCING * size
            )
            step = solved.direction if solved.curved else solved.solution
            slope = float(np.vdot(residual, step))
            if slope > 0.0:
                step, slope = -step, -slope
            length, trial = 1.0, np.empty_like(residual)
            while length > 1e-6:
                there = self._energy(displacement + length * step, compression, trial)
                if there <= energy + 1e-4 * length * slope:
                    break
                length /= 2
            displacement = displacement + length * step
        raise SolverError(
            f"the cylinder does not come to balance at {100 * compression:.0f} % of compression"
        )

    def _beyond(self, displacement: Array, compression: float) -> Array:
        """(N,) m, how far nodes are beyond a platen: below zero above it, above zero below."""
        place = self._z + displacement[2]
        beyond = place - place.clip(compression * self._height, self._height)
        beyond[self._factor.fixed] = 0.0
        return np.asarray(beyond)

    def _energy(self, displacement: Array, compression: float, slope: Array) -> float:
        """J, with that of nodes beyond the platens; its slope overwrites ``slope``, (3, N) N."""
        beyond = self._beyond(displacement, compression)
        energy = self._tissue.energy_and_forces(displacement, slope)
        slope[2] += self._firmness * beyond
        return energy + self._firmness / 2 * float(beyond @ beyond)


def _cylinder(radius: float, height: float, across: int, along: int) -> TetrahedralMesh:
    """Of a box whose square sections are mapped to discs, with thinner layers at the platens."""
    side, even = np.linspace(-1, 1, across + 1), np.linspace(0, 1, along + 1)
    layers = (even + (1 - np.cos(np.pi * even)) / 2) / 2
    box = box_mesh(side, side, layers)
    x, y, z = box.nodes.T
    disc = np.stack([x * np.sqrt(1 - y**2 / 2), y * np.sqrt(1 - x**2 / 2)])
    nodes = np.column_stack([*(radius * disc), height * z])
    return TetrahedralMesh(nodes, box.tetrahedra)
