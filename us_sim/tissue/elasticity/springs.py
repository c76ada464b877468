"""Mass-spring tissue: springs and dampers along a mesh's edges.

Springs of any arrangement that pull along the lines between their ends obey Cauchy's relations:
as a material they have lambda = mu, which is Poisson's ratio 1/4 (M. Born and K. Huang, Dynamical
Theory of Crystal Lattices, 1954, section 11).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from us_sim.kernels import njit
from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.mesh.tetrahedral_mesh import EDGES, TetrahedralMesh


class SpringNetwork(NamedTuple):
    """Voigt elements: a spring and a damper side by side (the paper's appendix)."""

    edges: NDArray[np.int32]  # (E, 2), the nodes it joins
    stiffness: NDArray[np.float64]  # (E,), N/m
    damping: NDArray[np.float64]  # (E,), N s/m
    rest_length: NDArray[np.float64]  # (E,), m

    def compute_forces(
        self, positions: NDArray[np.float64], velocity: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return (N, 3) N on the nodes, for positions (N, 3) m and velocities (N, 3) m/s."""
        force = np.empty_like(positions)
        spring_forces(self, np.ascontiguousarray(positions), np.ascontiguousarray(velocity), force)
        return force

    def drop_fixed(self, fixed: NDArray[np.bool_]) -> SpringNetwork:
        """Return the network without springs between two fixed nodes, which have no effect."""
        kept = ~fixed[self.edges].all(axis=1)
        return SpringNetwork(
            self.edges[kept], self.stiffness[kept], self.damping[kept], self.rest_length[kept]
        )

    def factor_stiffness(self, nodes: NDArray[np.float64]) -> csr_array:
        """Return B (E, 3N), (N/m)^0.5; B'B is the stiffness around unstretched ``nodes``."""
        along = nodes[self.edges[:, 1]] - nodes[self.edges[:, 0]]
        along *= (np.sqrt(self.stiffness) / np.linalg.norm(along, axis=1))[:, None]
        count = len(self.edges)
        columns = (3 * self.edges[:, :, None] + np.arange(3)).reshape(count, 6)
        rows = np.repeat(np.arange(count), 6)
        entries = np.concatenate([-along, along], axis=1).ravel()
        return csr_array((entries, (rows, columns.ravel())), shape=(count, 3 * len(nodes)))


def build_springs(
    mesh: TetrahedralMesh,
    materials: TissueMaterials,
    stiffness_factor: float = 0.002,
    damping_factor: float = 0.1,
) -> SpringNetwork:
    """Make springs of all edges of all tetrahedra; duplicates merge (the paper's Algorithm 1).

    Args:
        mesh: of the tissue.
        materials: of its tetrahedra.
        stiffness_factor: m, spring constant over Young's modulus, for one tetrahedron's edge. The
            paper gives it as a bare number, but it is a length: the right one grows with the mesh's
            spacing, as `fit_springs` shows.
        damping_factor: s, damping constant over spring constant.
    """
    return _network(mesh, stiffness_factor * materials.young_modulus, damping_factor)


def fit_springs(
    mesh: TetrahedralMesh, materials: TissueMaterials, damping_factor: float = 0.1
) -> SpringNetwork:
    """Make springs as stiff as the linear elasticity of the same mesh, whatever its spacing.

    Equal springs k along a tetrahedron's six edges of lengths L store sum(k L**2) e**2 / 2 in a
    swelling by the strain e, a material with lambda = mu stores 15 mu V e**2 / 2; averaged over
    all orientations, any other strain gives the same k = 15 mu V / sum(L**2), since a symmetric
    fourth-order tensor has one invariant under rotations that is not zero (the springs of G. Lame
    and A. Cauchy; A. van Gelder, Approximate Simulation of Elastic Membranes by Triangulated Spring
    Meshes, J. Graphics Tools 3, 1998, does likewise by edge). With mu = E / 2 (1 + nu), at the
    springs' own ratio of 1/4, the length that Algorithm 1 hides in its constant is
    6 V / sum(L**2).

    Args:
        mesh: of the tissue.
        materials: of its tetrahedra.
        damping_factor: s, damping constant over spring constant.
    """
    ends = mesh.nodes[mesh.tetrahedra][:, EDGES]
    squares = ((ends[:, :, 1] - ends[:, :, 0]) ** 2).sum(axis=(1, 2))
    shear = materials.young_modulus / 2.5
    return _network(mesh, 15 * shear * mesh.volumes / squares, damping_factor)


def _network(mesh: TetrahedralMesh, stiffness: NDArray, damping_factor: float) -> SpringNetwork:
    """Make six equal springs of stiffness (M,) N/m in each tetrahedron; duplicates merge."""
    ends = np.sort(mesh.tetrahedra[:, EDGES].astype(np.int64), axis=2)
    count = len(mesh.nodes)
    known = mesh.edges[:, 0].astype(np.int64) * count + mesh.edges[:, 1]
    which = np.searchsorted(known, ends[:, :, 0] * count + ends[:, :, 1])
    merged = np.zeros(len(mesh.edges))
    np.add.at(merged, which, stiffness[:, None])
    rest_length = np.empty(len(mesh.edges))
    _lengths(mesh.edges, mesh.nodes, rest_length)
    return SpringNetwork(mesh.edges, merged, damping_factor * merged, rest_length)


@njit(cache=True, nogil=True, error_model="numpy")
def _lengths(edges, nodes, length):
    """Fill length (E,), rounded as in `spring_forces`, so that nothing pulls at rest."""
    for e in range(len(edges)):
        x = nodes[edges[e, 1], 0] - nodes[edges[e, 0], 0]
        y = nodes[edges[e, 1], 1] - nodes[edges[e, 0], 1]
        z = nodes[edges[e, 1], 2] - nodes[edges[e, 0], 2]
        length[e] = math.sqrt(x * x + y * y + z * z)


@njit(cache=True, nogil=True, error_model="numpy")
def spring_forces(springs, positions, velocity, force):
    """Fill force (N, 3) with the paper's eq. (1), along each spring, on both its nodes.

    It is fastest with edges in the order of their first nodes, whose numbers then stay in
    registers.
    """
    edges, stiffness, damping, rest_length = springs
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
