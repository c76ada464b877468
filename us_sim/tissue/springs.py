"""Springs and dampers along the edges of a tetrahedral mesh, and how long a step they allow.

>>> from us_sim.tissue.materials import Material, uniform_material
>>> from us_sim.tissue.mesh import box_mesh, uniform_planes
>>> from us_sim.tissue.springs import springs_of
>>> planes = uniform_planes(0.0, 0.1, 5)
>>> mesh = box_mesh(planes, planes, planes)
>>> springs = springs_of(mesh, uniform_material(mesh, Material(10e3, 0.45, 1000.0)))
>>> len(springs.edges), float(springs.stiffness.min())
(540, 20.0)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.linalg import eigsh

from us_sim.errors import SolverError
from us_sim.tissue.materials import TissueMaterials
from us_sim.tissue.mesh import TetrahedralMesh
from us_sim.tissue.model import TissueModel

__all__ = ["SpringNetwork", "spring_forces", "springs_of", "stabilised", "step_limit"]

# Masses and sub-steps stay this far from the bound on stability.
_MARGIN = 1.05


@dataclass(frozen=True, eq=False)
class SpringNetwork:
    """Voigt elements: a spring and a damper side by side (the paper's appendix)."""

    edges: NDArray[np.int32]  # (E, 2), the nodes it joins
    stiffness: NDArray[np.float64]  # (E,), N/m
    damping: NDArray[np.float64]  # (E,), N s/m
    rest_length: NDArray[np.float64]  # (E,), m

    def forces(
        self, positions: NDArray[np.float64], velocity: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """(N, 3) N on the nodes, for positions (N, 3) m and velocities (N, 3) m/s."""
        force = np.empty_like(positions)
        spring_forces(
            self.edges,
            self.stiffness,
            self.damping,
            self.rest_length,
            np.ascontiguousarray(positions),
            np.ascontiguousarray(velocity),
            force,
        )
        return force

    def without(self, fixed: NDArray[np.bool_]) -> SpringNetwork:
        """The network without springs between two fixed nodes, which never do anything."""
        kept = ~fixed[self.edges].all(axis=1)
        return SpringNetwork(
            self.edges[kept], self.stiffness[kept], self.damping[kept], self.rest_length[kept]
        )

    def node_stiffness(self, count: int) -> NDArray[np.float64]:
        """(N,) N/m, sum of the springs at each of ``count`` nodes."""
        total = np.zeros(count)
        np.add.at(total, self.edges, self.stiffness[:, None])
        return total

    def highest_frequency(
        self,
        nodes: NDArray[np.float64],
        mass: NDArray[np.float64],
        fixed: NDArray[np.bool_],
    ) -> float:
        """1/s, the largest circular frequency of small undamped oscillations around ``nodes``.

        By Lanczos iterations on the linearised network with masses (N,) kg.
        """
        number = np.where(fixed, -1, np.cumsum(~fixed) - 1)
        count = int((~fixed).sum())
        root = np.sqrt(mass[~fixed])
        along = nodes[self.edges[:, 1]] - nodes[self.edges[:, 0]]
        along /= np.linalg.norm(along, axis=1)[:, None]
        blocks = self.stiffness[:, None, None] * along[:, :, None] * along[:, None, :]
        rows, columns, entries = [], [], []
        for a, b, sign in ((0, 0, 1.0), (1, 1, 1.0), (0, 1, -1.0), (1, 0, -1.0)):
            i, j = number[self.edges[:, a]], number[self.edges[:, b]]
            free = (i >= 0) & (j >= 0)
            i, j = i[free], j[free]
            scaled = sign * blocks[free] / (root[i] * root[j])[:, None, None]
            rows.append(np.broadcast_to(3 * i[:, None, None] + np.arange(3)[:, None], scaled.shape))
            columns.append(np.broadcast_to(3 * j[:, None, None] + np.arange(3), scaled.shape))
            entries.append(scaled)
        place = tuple(np.concatenate([p.ravel() for p in part]) for part in (rows, columns))
        matrix = csr_array(
            (np.concatenate([e.ravel() for e in entries]), place), shape=(3 * count, 3 * count)
        )
        if 3 * count <= 30:
            return math.sqrt(np.linalg.eigvalsh(matrix.toarray())[-1])
        start = np.random.default_rng(0).standard_normal(3 * count)
        largest = eigsh(matrix, k=1, which="LA", v0=start, tol=1e-4, return_eigenvectors=False)
        return math.sqrt(largest[0])


def springs_of(
    mesh: TetrahedralMesh,
    materials: TissueMaterials,
    stiffness_factor: float = 0.002,
    damping_factor: float = 0.1,
) -> SpringNetwork:
    """The paper's Algorithm 1: all edges of all tetrahedra become springs, duplicates merge.

    Args:
        mesh, materials: of the tissue.
        stiffness_factor: m, spring constant over Young's modulus, for one tetrahedron's edge.
        damping_factor: s, damping constant over spring constant.
    """
    corners = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])
    ends = np.sort(mesh.tetrahedra[:, corners].reshape(-1, 2).astype(np.int64), axis=1)
    count = len(mesh.nodes)
    known = mesh.edges[:, 0].astype(np.int64) * count + mesh.edges[:, 1]
    place = np.searchsorted(known, ends[:, 0] * count + ends[:, 1])
    stiffness = np.zeros(len(known))
    np.add.at(stiffness, place, np.repeat(stiffness_factor * materials.young_modulus, 6))
    rest_length = np.empty(len(known))
    _lengths(mesh.edges, mesh.nodes, rest_length)
    return SpringNetwork(mesh.edges, stiffness, damping_factor * stiffness, rest_length)


def step_limit(frequency: float, damping_factor: float) -> float:
    """s, the longest stable step of symplectic Euler for stiffness-proportional damping.

    A mode of circular frequency w with damping constant b times its stiffness is stable as long as
    dt**2 + 2 b dt < 4 / w**2.

    Args:
        frequency: w, 1/s.
        damping_factor: b, s.
    """
    span = 4 / frequency**2
    return span / (damping_factor + math.sqrt(damping_factor**2 + span))


def stabilised(
    model: TissueModel,
    springs: SpringNetwork,
    time_step: float,
    damping_factor: float,
    stabilisation: str,
    maximum_substeps: int,
) -> tuple[NDArray[np.float64], int, str]:
    """Masses (N,) kg and number of sub-steps that make a step stable, and what was done, in words.

    Whether a step is stable, and what it needs, is judged by w**2 <= 2 max(sum of a node's springs
    over its mass), which holds however the springs turn and stretch. The limit in the words is the
    one of small oscillations around rest.

    Args:
        model: whose lumped masses are simulated where possible.
        springs: its network.
        time_step: s, asked for.
        damping_factor: s, damping constant over spring constant.
        stabilisation: ``mass_scaling`` or ``substeps``.
        maximum_substeps: of one step.

    Raises:
        SolverError: more sub-steps than allowed.
    """
    mass, free = model.lumped_mass, ~model.fixed
    stiffness = springs.node_stiffness(len(mass))
    span = time_step**2 + 2 * damping_factor * time_step
    needed = 0.5 * _MARGIN * span * stiffness
    if not (needed > mass)[free].any():
        return mass, 1, ""
    limit = step_limit(
        springs.highest_frequency(model.mesh.nodes, mass, model.fixed), damping_factor
    )
    unstable = f"steps beyond {1e3 * limit:.2g} ms are unstable"
    if stabilisation == "mass_scaling":
        scaled = np.maximum(mass, needed)
        factor = (scaled / mass)[free]
        low, high = factor.min(), factor.max()
        return scaled, 1, f"masses scaled {low:.0f} to {high:.0f} times: unscaled, {unstable}"
    bound = math.sqrt(2 * _MARGIN * (stiffness / mass)[free].max())
    substeps = math.ceil(time_step / step_limit(bound, damping_factor))
    if substeps > maximum_substeps:
        raise SolverError(
            f"msds needs {substeps} sub-steps for each step of {1e3 * time_step:g} ms, more than "
            f"maximum_substeps = {maximum_substeps}: use stabilisation mass_scaling, or lower "
            f"damping_factor"
        )
    return mass, substeps, f"{substeps} sub-steps a step: undivided, {unstable}"


@njit(cache=True, nogil=True, error_model="numpy")
def _lengths(edges, nodes, length):
    """Fills length (E,), rounded as in `spring_forces`, so that nothing pulls at rest."""
    for e in range(len(edges)):
        x = nodes[edges[e, 1], 0] - nodes[edges[e, 0], 0]
        y = nodes[edges[e, 1], 1] - nodes[edges[e, 0], 1]
        z = nodes[edges[e, 1], 2] - nodes[edges[e, 0], 2]
        length[e] = math.sqrt(x * x + y * y + z * z)


@njit(cache=True, nogil=True, error_model="numpy")
def spring_forces(edges, stiffness, damping, rest_length, positions, velocity, force):
    """Fills force (N, 3) with the paper's eq. (1), along each spring, on both its nodes.

    Edges in the order of their first nodes are quick: that node's numbers then stay in registers.
    """
    force[:] = 0.0
    e = 0
    while e < len(edges):
        i = edges[e, 0]
        xi = positions[i, 0]
        yi = positions[i, 1]
        zi = positions[i, 2]
        ui = velocity[i, 0]
        vi = velocity[i, 1]
        wi = velocity[i, 2]
        fx = fy = fz = 0.0
        while e < len(edges) and edges[e, 0] == i:
            j = edges[e, 1]
            x = positions[j, 0] - xi
            y = positions[j, 1] - yi
            z = positions[j, 2] - zi
            length = math.sqrt(x * x + y * y + z * z)
            if length > 0.0:  # else there is no direction to push in
                one = 1.0 / length
                stretching = (
                    x * (velocity[j, 0] - ui)
                    + y * (velocity[j, 1] - vi)
                    + z * (velocity[j, 2] - wi)
                ) * one
                pull = (stiffness[e] * (length - rest_length[e]) + damping[e] * stretching) * one
                fx += pull * x
                fy += pull * y
                fz += pull * z
                force[j, 0] -= pull * x
                force[j, 1] -= pull * y
                force[j, 2] -= pull * z
            e += 1
        force[i, 0] += fx
        force[i, 1] += fy
        force[i, 2] += fz
