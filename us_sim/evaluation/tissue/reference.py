"""The true shape of a block under the probe: large deformation on fine quadratic elements.

Frictionless contact of the whole surface, not of nodes only, by augmented Lagrangian terms at the
surface's quadrature points (P. Wriggers, Computational Contact Mechanics, 2nd ed., 2006, 9.3.3),
and Newton's method with a line search. Elastic equilibrium without friction does not depend on the
path, so a pose is approached in a few steps from rest. The block lies between its mirror plane
y = 0 and its side; the probe must be as symmetric.

>>> from us_sim.geometry.collider import Sphere
>>> from us_sim.evaluation.tissue.reference import solve_contact
>>> planes = [-0.05, -0.02, 0.02, 0.05], [0.0, 0.02, 0.05], [0.0, 0.02, 0.05]
>>> soft = Material(10e3, 0.45, 1000.0)
>>> solution = solve_contact(planes, soft, Sphere(0.03), [Pose(position=[0.0, 0.0, 0.002])])
>>> bool(solution.force[2] < 0), bool(solution.penetration < 2e-5)
(True, True)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import bsr_array, csr_array, dia_array, kron
from scipy.sparse.linalg import LinearOperator, cg, splu
from scipy.spatial import KDTree

from us_sim.errors import SolverError
from us_sim.evaluation.tissue.cases import BlockScene
from us_sim.evaluation.tissue.finite_elements import NeoHookeanHexahedra
from us_sim.geometry.collider import Collider
from us_sim.geometry.pose import Pose
from us_sim.tissue.elasticity.material import Material

Array = NDArray[np.float64]

_SOFT = 200.0
"""Penalty (1/m, over Young's modulus) of the first poses: a soft contact converges quickly."""
_HARDER = (200.0, 200.0, 1000.0, 5000.0, 20000.0)
"""Penalties at the last pose; a hard contact is exact. The multipliers are updated each time."""
_AUGMENTATIONS = 4
_PENETRATION = 1.5e-5  # m, above which the multipliers are updated once more
_TOLERANCE = 1e-5  # unbalanced force over contact force at the last pose
_APPROACHING = 1e-2  # the same at the poses before
_NEWTON_STEPS = 60
_SHORTEST_STEP = 2.0**-12
_STIFFENED = (0.0, 1e-3, 1e-2, 0.1, 1.0)
"""Parts of the diagonal that are added to the tangent until it is definite (K. Levenberg, 1944)."""


@dataclass(frozen=True, eq=False)
class ContactSolution:
    """The equilibrium under the last pose."""

    block: NeoHookeanHexahedra  # the half with y >= 0
    displacement: Array  # (N, 3) m
    pressure: Array  # (S,) Pa, of the probe on the block's surface points
    force: Array  # (3,) N, of the whole tissue on the probe, frame probe
    volume: float  # m3, of the whole deformed block
    penetration: float  # m, the deepest point of the surface inside the probe

    def interpolate_displacement(self, points: Array) -> Array:
        """Interpolate the displacement (P, 3) m of rest positions (P, 3) m in the whole block."""
        side = np.where(points[:, 1:2] < 0, -1.0, 1.0) * [[0, 1, 0]] + [[1, 0, 1]]
        return self.block.interpolate_field(self.displacement, points * side) * side


def solve_contact(
    planes: Sequence[ArrayLike],
    material: Material,
    collider: Collider,
    poses: Sequence[Pose],
    start: ContactSolution | None = None,
) -> ContactSolution:
    """Find the equilibrium under the last pose; approach it through the others.

    Args:
        planes: m, of x, y >= 0 and z; the block is held at the last of z.
        material: of the whole block.
        collider: the probe's shape.
        poses: with y = 0 and turned about y only.
        start: another mesh's solution of the first pose, or of one near it.

    Raises:
        SolverError: a pose is not symmetric, or no equilibrium was found.
    """
    for pose in poses:
        if abs(pose.position[1]) > 1e-12 or abs(pose.rotation[1, 1] - 1) > 1e-12:
            raise SolverError(
                "the reference solution needs a probe that is symmetric about y = 0: move it along "
                "x and z, and turn it about y only"
            )
    block = NeoHookeanHexahedra(planes, material)
    search = _Search(block, collider)
    modulus = material.young_modulus
    penalties = np.array(_HARDER) * modulus
    search.penalty = _SOFT * modulus
    if start is not None:
        search.displacement = start.interpolate_displacement(block.nodes) * search.free
        nearest = KDTree(start.block.surface_points).query(block.surface_points)[1]
        search.push, penalties = start.pressure[nearest], penalties[3:]
    for pose in poses[:-1]:
        search.equilibrate(pose, _APPROACHING)
    for penalty in penalties:
        search.penalty = penalty
        search.equilibrate(poses[-1], _APPROACHING)
        search.push = search.compute_pressure(poses[-1])[0]
    for _ in range(_AUGMENTATIONS):
        search.equilibrate(poses[-1], _TOLERANCE)
        penetration = search.compute_penetration(poses[-1])
        if penetration <= _PENETRATION:
            break
        search.push = search.compute_pressure(poses[-1])[0]
    pressure, normal, _ = search.compute_pressure(poses[-1])
    total = 2.0 * ((block.surface_weights * pressure)[:, None] * normal).sum(axis=0)
    force = -(total * [1, 0, 1]) @ poses[-1].rotation
    volume = 2.0 * block.compute_volume(search.displacement)
    return ContactSolution(block, search.displacement, pressure, force, volume, penetration)


class _Search:
    """Newton's method on a block, with its displacement and contact multipliers."""

    def __init__(self, block: NeoHookeanHexahedra, collider: Collider) -> None:
        self.block, self.collider = block, collider
        self.penalty = 0.0
        self.displacement = np.zeros_like(block.nodes)
        self.push = np.zeros(len(block.surface_points))  # Pa, multipliers
        self.free = _find_movable(block, block.nodes)
        self._surface = csr_array(kron(block.surface_values, np.eye(3)))  # (3S, 3N)
        self._mask = _make_diagonal(self.free.ravel().astype(float))
        coarse = np.flatnonzero(_find_movable(block, block.corners).ravel())
        spread = csr_array(kron(block.from_corners, np.eye(3)))
        self._prolongation = (self._mask @ spread).tocsr()[:, coarse]

    def compute_pressure(self, pose: Pose) -> tuple[Array, Array, Array]:
        """Compute pressure (S,) Pa, its direction (S, 3) and curvature (S, 3, 3) at the surface."""
        gap, normal, curvature = self._measure_gaps(pose)
        return np.maximum(self.push - self.penalty * gap, 0.0), normal, curvature

    def compute_penetration(self, pose: Pose) -> float:
        """Compute the depth (m) of the deepest surface point inside the probe."""
        return max(0.0, -float(self._measure_gaps(pose)[0].min()))

    def equilibrate(self, pose: Pose, tolerance: float) -> None:
        """Iterate until the unbalanced force is below ``tolerance`` times the contact force."""
        energy = self._compute_energy(pose)
        for _ in range(_NEWTON_STEPS):
            unbalanced, load = self._compute_imbalance(pose)
            residual = float(np.linalg.norm(unbalanced))
            if residual <= tolerance * load or residual < 1e-12:
                return
            step = self._compute_step(pose, unbalanced)
            slope = float((unbalanced * step).sum())
            before, whole = self.displacement, energy
            length = 1.0
            while length > _SHORTEST_STEP:
                self.displacement = before + length * step
                energy = self._compute_energy(pose)
                # The rounding of the energy hides the last steps' gain.
                if energy <= whole + 1e-4 * length * slope + 1e-13 * abs(whole):
                    break
                length *= 0.5
            else:
                break
        raise SolverError(
            f"the reference solution found no equilibrium at {pose.position.tolist()} m: approach "
            f"the pose in smaller steps or on a finer mesh"
        )

    def _compute_step(self, pose: Pose, unbalanced: Array) -> Array:
        """Compute Newton's step (N, 3) m; stiffen the tangent if it is not definite."""
        tangent, right = self._assemble_tangent(pose), -unbalanced.ravel()
        for part in _STIFFENED:
            stiffer = bsr_array(_make_diagonal(part * tangent.diagonal()), blocksize=(3, 3))
            step = _solve_system(tangent + stiffer if part else tangent, right, self._prolongation)
            if step @ right > 0.0:
                break
        return step.reshape(-1, 3)

    def _compute_energy(self, pose: Pose) -> float:
        pressure, _, _ = self.compute_pressure(pose)
        contact = (self.block.surface_weights * pressure**2).sum() / (2 * self.penalty)
        return self.block.compute_energy(self.displacement) + float(contact)

    def _compute_imbalance(self, pose: Pose) -> tuple[Array, float]:
        """Compute the unbalanced forces (N, 3) N, and the norm of the contact forces."""
        pressure, normal, _ = self.compute_pressure(pose)
        weighted = (self.block.surface_weights * pressure)[:, None] * normal
        pushes = self.block.surface_values.T @ weighted
        unbalanced = (self.block.compute_forces(self.displacement) - pushes) * self.free
        return unbalanced, float(np.linalg.norm(pushes))

    def _assemble_tangent(self, pose: Pose) -> bsr_array:
        pressure, normal, curvature = self.compute_pressure(pose)
        local = self.penalty * normal[:, :, None] * normal[:, None, :]
        local -= pressure[:, None, None] * curvature
        local *= (self.block.surface_weights * (pressure > 0))[:, None, None]
        contact = self._surface.T @ _make_block_diagonal(local) @ self._surface
        matrix = self.block.assemble_stiffness(self.displacement) + contact
        held = _make_diagonal(1.0 - self.free.ravel())
        return (self._mask @ matrix @ self._mask + held).tobsr((3, 3))

    def _measure_gaps(self, pose: Pose) -> tuple[Array, Array, Array]:
        """Measure gaps (S,) m from surface points to the probe, with both derivatives."""
        points = self.block.surface_points + self.block.surface_values @ self.displacement
        *half, rounding = self.collider.offset_box
        rotation = pose.rotation
        local = (points - pose.position) @ rotation + [0.0, 0.0, half[2] + rounding]
        beyond = np.abs(local) - half
        outside = np.maximum(beyond, 0.0)
        distance = np.maximum(np.linalg.norm(outside, axis=1), 1e-9)
        normal = np.sign(local) * outside / distance[:, None]
        curved = (beyond > 0).astype(float)[:, :, None] * np.eye(3)
        curvature = (curved - normal[:, :, None] * normal[:, None, :]) / distance[:, None, None]
        return distance - rounding, normal @ rotation.T, rotation @ curvature @ rotation.T


def _solve_system(matrix: bsr_array, right: Array, prolongation: csr_array) -> Array:
    """Solve a symmetric system approximately, by conjugate gradients: (3N,).

    The preconditioner is the inverse of the diagonal's blocks, and the same mesh with linear
    elements, from whose nodes ``prolongation`` (3N, 3C) interpolates. If the matrix is not
    definite, the step may ascend.
    """
    rows = np.repeat(np.arange(len(matrix.indptr) - 1), np.diff(matrix.indptr))
    smooth = _make_block_diagonal(np.linalg.inv(matrix.data[rows == matrix.indices]))
    coarse = splu(
        (prolongation.T @ matrix @ prolongation).tocsc(),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )

    def apply_preconditioner(residual: Array) -> Array:
        corrected = prolongation @ coarse.solve(prolongation.T @ residual)
        return np.asarray(corrected + smooth @ residual)

    tolerance = 1e-3 * float(np.linalg.norm(right))
    preconditioner = LinearOperator(matrix.shape, apply_preconditioner)
    found, _ = cg(matrix, right, atol=tolerance, maxiter=400, M=preconditioner)
    return np.asarray(found)


def _make_block_diagonal(blocks: Array) -> bsr_array:
    """Make a block diagonal matrix (3B, 3B) of blocks (B, 3, 3)."""
    return bsr_array((blocks, np.arange(len(blocks)), np.arange(len(blocks) + 1)))


def _make_diagonal(entries: NDArray[np.floating]) -> dia_array:
    return dia_array((entries[None], [0]), shape=2 * entries.shape)


def _find_movable(block: NeoHookeanHexahedra, points: Array) -> NDArray[np.bool_]:
    """Find the components (P, 3) that may move: not the bottom's, nor out of the mirror plane."""
    free = np.ones(points.shape, dtype=bool)
    free[np.isclose(points[:, 1], block.planes[1][0]), 1] = False
    free[np.isclose(points[:, 2], block.planes[2][-1])] = False
    return free


def solve_reference(scene: BlockScene, sizes: Sequence[float]) -> list[ContactSolution]:
    """Solve the end of a scene's path on finer and finer meshes.

    Args:
        scene: its path is followed to the end.
        sizes: m, of the elements under the probe; each mesh starts from the one before.

    Raises:
        SolverError: no equilibrium was found.
    """
    solutions: list[ContactSolution] = []
    # Every second pose, and all of them where tissue hardly compresses.
    poses = scene.path[::-2][::-1] if scene.poisson_ratio <= 0.45 else scene.path
    for size in sizes:
        start, planes = solutions[-1] if solutions else None, scene.make_reference_planes(size)
        some = scene.path[-1:] if start else poses
        solutions.append(solve_contact(planes, scene.material, scene.collider, some, start))
    return solutions
