"""Mass-spring tissue: springs and dampers along a mesh's edges, and resistance to volume change.

Springs of any arrangement that pull along the lines between their ends obey Cauchy's relations:
as a material they have lambda = mu, which is Poisson's ratio 1/4 (M. Born and K. Huang, Dynamical
Theory of Crystal Lattices, 1954, section 11). The missing part of lambda is added as an energy of
volume, as M. Teschner et al., A Versatile and Robust Model for Geometrically Complex Deformable
Solids, CGI 2004, do, here with the coefficients of elasticity and divided between tetrahedra and
nodes by `volumetric_split`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array, vstack

from us_sim.kernels import njit
from us_sim.tissue.elasticity.materials import TissueMaterials, volumetric_split
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh

# The six edges of a tetrahedron.
_CORNERS = np.array([[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]])


class SpringArrays(NamedTuple):
    """The arrays of a `SpringNetwork` that kernels take."""

    edges: NDArray[np.int32]  # (E, 2)
    stiffness: NDArray[np.float64]  # (E,), N/m
    damping: NDArray[np.float64]  # (E,), N s/m
    rest_length: NDArray[np.float64]  # (E,), m


@dataclass(frozen=True, eq=False)
class SpringNetwork:
    """Voigt elements: a spring and a damper side by side (the paper's appendix)."""

    edges: NDArray[np.int32]  # (E, 2), the nodes it joins
    stiffness: NDArray[np.float64]  # (E,), N/m
    damping: NDArray[np.float64]  # (E,), N s/m
    rest_length: NDArray[np.float64]  # (E,), m
    # (M,), Pa, both lambda and mu of the springs of each tetrahedron; empty without a mesh
    lame_constant: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))

    @property
    def arrays(self) -> SpringArrays:
        """The arrays that kernels take."""
        return SpringArrays(self.edges, self.stiffness, self.damping, self.rest_length)

    def forces(
        self, positions: NDArray[np.float64], velocity: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """(N, 3) N on the nodes, for positions (N, 3) m and velocities (N, 3) m/s."""
        force = np.empty_like(positions)
        spring_forces(
            self.arrays, np.ascontiguousarray(positions), np.ascontiguousarray(velocity), force
        )
        return force

    def without(self, fixed: NDArray[np.bool_]) -> SpringNetwork:
        """The network without the springs between two fixed nodes, which have no effect."""
        kept = ~fixed[self.edges].all(axis=1)
        return SpringNetwork(
            self.edges[kept],
            self.stiffness[kept],
            self.damping[kept],
            self.rest_length[kept],
            self.lame_constant,
        )

    def factor(self, nodes: NDArray[np.float64]) -> csr_array:
        """B (E, 3N), (N/m)^0.5, such that B'B is the stiffness around unstretched ``nodes``."""
        along = nodes[self.edges[:, 1]] - nodes[self.edges[:, 0]]
        along *= (np.sqrt(self.stiffness) / np.linalg.norm(along, axis=1))[:, None]
        count = len(self.edges)
        columns = (3 * self.edges[:, :, None] + np.arange(3)).reshape(count, 6)
        rows = np.repeat(np.arange(count), 6)
        entries = np.concatenate([-along, along], axis=1).ravel()
        return csr_array((entries, (rows, columns.ravel())), shape=(count, 3 * len(nodes)))


def springs_of(
    mesh: TetrahedralMesh,
    materials: TissueMaterials,
    stiffness_factor: float = 0.002,
    damping_factor: float = 0.1,
) -> SpringNetwork:
    """The paper's Algorithm 1: all edges of all tetrahedra become springs, duplicates merge.

    Args:
        stiffness_factor: m, spring constant over Young's modulus, for one tetrahedron's edge. The
            paper gives it as a bare number, but it is a length: the right one grows with the mesh's
            spacing, as `fitted_springs` shows.
        damping_factor: s, damping constant over spring constant.
    """
    return _network(mesh, stiffness_factor * materials.young_modulus, damping_factor)


def fitted_springs(
    mesh: TetrahedralMesh,
    materials: TissueMaterials,
    damping_factor: float = 0.1,
    *,
    with_volume: bool = True,
) -> SpringNetwork:
    """Springs as stiff as the linear elasticity of the same mesh, whatever its spacing.

    Equal springs k along a tetrahedron's six edges of lengths L store sum(k L**2) e**2 / 2 in a
    swelling by the strain e, a material with lambda = mu stores 15 mu V e**2 / 2; averaged over
    all orientations, any other strain gives the same k = 15 mu V / sum(L**2), since a symmetric
    fourth-order tensor has one invariant under rotations that is not zero (the springs of G. Lame
    and A. Cauchy; A. van Gelder, Approximate Simulation of Elastic Membranes by Triangulated Spring
    Meshes, J. Graphics Tools 3, 1998, does likewise by edge). With mu = E / 2 (1 + nu) the length
    that Algorithm 1 hides in its constant is 15 V / (2 (1 + nu) sum(L**2)).

    Args:
        damping_factor: s, damping constant over spring constant.
        with_volume: match mu, since a volume term will add the missing part of lambda. Otherwise,
            and below Poisson's ratio 1/4, match Young's modulus, at the springs' own ratio of 1/4.
    """
    ratio = np.maximum(materials.poisson_ratio, 0.25) if with_volume else 0.25
    shear = materials.young_modulus / (2 * (1 + ratio))
    return _network(mesh, 15 * shear * mesh.volumes / _squares(mesh), damping_factor)


def _network(mesh: TetrahedralMesh, stiffness: NDArray, damping_factor: float) -> SpringNetwork:
    """Six equal springs of stiffness (M,) N/m in each tetrahedron; duplicates merge."""
    merged = np.zeros(len(mesh.edges))
    np.add.at(merged, _edges_of_tetrahedra(mesh), stiffness[:, None])
    rest_length = np.empty(len(mesh.edges))
    _lengths(mesh.edges, mesh.nodes, rest_length)
    lame_constant = stiffness * _squares(mesh) / (15 * mesh.volumes)
    return SpringNetwork(mesh.edges, merged, damping_factor * merged, rest_length, lame_constant)


def _squares(mesh: TetrahedralMesh) -> NDArray[np.float64]:
    """(M,) m2, sum of the squared lengths of each tetrahedron's edges."""
    ends = mesh.nodes[mesh.tetrahedra][:, _CORNERS]
    return ((ends[:, :, 1] - ends[:, :, 0]) ** 2).sum(axis=(1, 2))


def _edges_of_tetrahedra(mesh: TetrahedralMesh) -> NDArray[np.intp]:
    ends = np.sort(mesh.tetrahedra[:, _CORNERS].astype(np.int64), axis=2)
    count = len(mesh.nodes)
    known = mesh.edges[:, 0].astype(np.int64) * count + mesh.edges[:, 1]
    return np.searchsorted(known, ends[:, :, 0] * count + ends[:, :, 1])


@njit(cache=True, nogil=True, error_model="numpy")
def _lengths(edges, nodes, length):
    """Fills length (E,), rounded as in `spring_forces`, so that nothing pulls at rest."""
    for e in range(len(edges)):
        x = nodes[edges[e, 1], 0] - nodes[edges[e, 0], 0]
        y = nodes[edges[e, 1], 1] - nodes[edges[e, 0], 1]
        z = nodes[edges[e, 1], 2] - nodes[edges[e, 0], 2]
        length[e] = math.sqrt(x * x + y * y + z * z)


@njit(cache=True, nogil=True, error_model="numpy")
def spring_forces(springs, positions, velocity, force):
    """Fills force (N, 3) with the paper's eq. (1), along each spring, on both its nodes.

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


# A tetrahedron yields when the sum of its squared face areas over that at rest exceeds this.
_YIELD = 1.5
_ROUNDING = 1e-9  # Fraction of the shear modulus below which a nodal part is rounding


class VolumeArrays(NamedTuple):
    """The arrays of a `VolumeTerm` that kernels take, of M tetrahedra and N nodes."""

    tetrahedra: NDArray[np.int32]  # (M, 4)
    rest_volume: NDArray[np.float64]  # (M,), m3
    element: NDArray[np.float64]  # (M,), Pa
    nodal: NDArray[np.float64]  # (M,), Pa
    inverse_weight: NDArray[np.float64]  # (N,), 1/(N m), 0 where a node has no weight
    yield_area: NDArray[np.float64]  # (M,), m4
    damping_time: float  # s
    mean: NDArray[np.float64]  # (N,), or empty where no node has weight; kernels write on it
    change: NDArray[np.float64]  # (M,), m3; kernels write on it


@dataclass(frozen=True, eq=False)
class VolumeTerm:
    """Energy of volume of each tetrahedron and of the tetrahedra around each node.

    It is sum of V e (J - 1)**2 / 2 over tetrahedra and of C q**2 / 2 over nodes, where q is the
    mean of J - 1 around a node, weighted by n V / 4, and C is the sum of these weights.
    """

    tetrahedra: NDArray[np.int32]  # (M, 4)
    rest_volume: NDArray[np.float64]  # (M,), m3
    element: NDArray[np.float64]  # (M,), Pa, e
    nodal: NDArray[np.float64]  # (M,), Pa, n
    node_weight: NDArray[np.float64]  # (N,), N m, C
    damping_time: float  # s, viscosity over stiffness
    # (M,) m4, the sum of squared derivatives of 6 times the volume at which a tetrahedron yields,
    # see `volume_term`; infinite where it never does
    yield_area: NDArray[np.float64]

    @classmethod
    def empty(cls, count: int) -> VolumeTerm:
        """The term without a tetrahedron, for ``count`` nodes."""
        none = np.zeros(0)
        return cls(np.zeros((0, 4), np.int32), none, none, none, np.zeros(count), 0.0, none)

    @cached_property
    def arrays(self) -> VolumeArrays:
        """The arrays that kernels take."""
        inverse = np.zeros_like(self.node_weight)
        np.divide(1.0, self.node_weight, out=inverse, where=self.node_weight > 0)
        return VolumeArrays(
            self.tetrahedra,
            self.rest_volume,
            self.element,
            self.nodal,
            inverse,
            self.yield_area,
            self.damping_time,
            mean=np.zeros_like(inverse) if self.nodal.any() else np.zeros(0),
            change=np.zeros_like(self.rest_volume),
        )

    def forces(
        self, positions: NDArray[np.float64], velocity: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """(N, 3) N on the nodes, for positions (N, 3) m and velocities (N, 3) m/s."""
        force = np.zeros_like(positions)
        add_volume_forces(
            self.arrays, np.ascontiguousarray(positions), np.ascontiguousarray(velocity), force
        )
        return force

    def factor(self, nodes: NDArray[np.float64]) -> csr_array:
        """B (rows, 3N), (N/m)^0.5, such that B'B is the stiffness around undeformed ``nodes``."""
        gradient = _volume_gradients(nodes[self.tetrahedra]) / self.rest_volume[:, None, None]
        count, many = len(nodes), len(self.tetrahedra)
        columns = (3 * self.tetrahedra[:, :, None] + np.arange(3)).reshape(many, 12)
        rows = np.repeat(np.arange(many), 12)
        divergence = csr_array((gradient.ravel(), (rows, columns.ravel())), (many, 3 * count))
        own = np.sqrt(self.element * self.rest_volume)
        tetrahedral = csr_array(divergence.multiply(own[:, None]))
        weight = np.repeat(self.nodal * self.rest_volume / 4, 4)
        place = (self.tetrahedra.ravel(), np.repeat(np.arange(many), 4))
        mean = csr_array((weight, place), shape=(count, many))
        scale = np.zeros(count)
        np.divide(1.0, np.sqrt(self.node_weight), out=scale, where=self.node_weight > 0)
        around = csr_array((mean @ divergence).multiply(scale[:, None]))
        stacked = [part for part in (tetrahedral, around) if part.nnz]
        return csr_array(vstack(stacked)) if stacked else csr_array((0, 3 * count))


def volume_term(
    mesh: TetrahedralMesh,
    materials: TissueMaterials,
    springs: SpringNetwork,
    damping_time: float = 0.0,
    *,
    yielding: bool = False,
) -> VolumeTerm:
    """The difference between the material's lambda and the spring network's, as a volume term.

    Where the springs alone resist a change of volume more than the material would, that is below
    Poisson's ratio 1/4 or with springs too stiff, nothing is taken off: a negative resistance could
    make the tissue collapse.

    Args:
        damping_time: s, viscosity over stiffness.
        yielding: whether a tetrahedron whose faces have grown beyond `_YIELD` resists no more than
            it does there. Its stiffness grows with the square of its faces, and so, without this,
            a mesh stretched far out of shape would need ever shorter explicit steps.
    """
    split = volumetric_split(materials)
    lacking = split.element - split.shear - springs.lame_constant
    element = np.maximum(lacking, 0.0)
    nodal = split.nodal + np.minimum(lacking, 0.0)
    nodal[nodal < _ROUNDING * split.shear] = 0.0
    weight = np.zeros(len(mesh.nodes))
    rest_volume = np.empty(len(mesh.tetrahedra))
    _measure(mesh.tetrahedra, mesh.nodes, rest_volume)
    np.add.at(weight, mesh.tetrahedra, (nodal * rest_volume / 4)[:, None])
    yield_area = np.full(len(rest_volume), np.inf)
    if yielding:
        area = 36 * (_volume_gradients(mesh.nodes[mesh.tetrahedra]) ** 2).sum(axis=(1, 2))
        yield_area = _YIELD * area
    return VolumeTerm(
        mesh.tetrahedra, rest_volume, element, nodal, weight, damping_time, yield_area
    )


def _volume_gradients(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """(M, 4, 3) m2, derivative of each tetrahedron's volume by its corners (M, 4, 3) m."""
    b, c, d = (corners[:, i] - corners[:, 0] for i in (1, 2, 3))
    gradient = np.empty_like(corners)
    gradient[:, 1] = np.cross(c, d) / 6
    gradient[:, 2] = np.cross(d, b) / 6
    gradient[:, 3] = np.cross(b, c) / 6
    gradient[:, 0] = -gradient[:, 1:].sum(axis=1)
    return gradient


@njit(cache=True, nogil=True, error_model="numpy")
def area_vectors(x, tetrahedra, t):
    """Volume of tetrahedron t, and 6 times its derivatives by the last three corners' positions.

    Positions x (N, 3). A tetrahedron's volume comes out to the last bit the same everywhere, so
    that nothing presses at rest.
    """
    a, b, c, d = tetrahedra[t, 0], tetrahedra[t, 1], tetrahedra[t, 2], tetrahedra[t, 3]
    bx, by, bz = x[b, 0] - x[a, 0], x[b, 1] - x[a, 1], x[b, 2] - x[a, 2]
    cx, cy, cz = x[c, 0] - x[a, 0], x[c, 1] - x[a, 1], x[c, 2] - x[a, 2]
    dx, dy, dz = x[d, 0] - x[a, 0], x[d, 1] - x[a, 1], x[d, 2] - x[a, 2]
    px, py, pz = cy * dz - cz * dy, cz * dx - cx * dz, cx * dy - cy * dx
    qx, qy, qz = dy * bz - dz * by, dz * bx - dx * bz, dx * by - dy * bx
    rx, ry, rz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
    return (bx * px + by * py + bz * pz) / 6.0, px, py, pz, qx, qy, qz, rx, ry, rz


@njit(cache=True, nogil=True, error_model="numpy")
def push_corners(tetrahedra, t, push, px, py, pz, qx, qy, qz, rx, ry, rz, force):
    """Adds to force (N, 3) a push (Pa) on tetrahedron t along its `area_vectors` p, q and r."""
    a, b, c, d = tetrahedra[t, 0], tetrahedra[t, 1], tetrahedra[t, 2], tetrahedra[t, 3]
    force[a, 0] -= push * (px + qx + rx)
    force[a, 1] -= push * (py + qy + ry)
    force[a, 2] -= push * (pz + qz + rz)
    force[b, 0] += push * px
    force[b, 1] += push * py
    force[b, 2] += push * pz
    force[c, 0] += push * qx
    force[c, 1] += push * qy
    force[c, 2] += push * qz
    force[d, 0] += push * rx
    force[d, 1] += push * ry
    force[d, 2] += push * rz


@njit(cache=True, nogil=True, error_model="numpy")
def _yielded(yield_area, px, py, pz, qx, qy, qz, rx, ry, rz):
    """The factor by which yielding reduces a tetrahedron's strain, and its stress."""
    sx, sy, sz = px + qx + rx, py + qy + ry, pz + qz + rz
    area = px * px + py * py + pz * pz + qx * qx + qy * qy + qz * qz
    area += rx * rx + ry * ry + rz * rz + sx * sx + sy * sy + sz * sz
    return 1.0 if area <= yield_area else math.sqrt(yield_area / area)


@njit(cache=True, nogil=True, error_model="numpy")
def _measure(tetrahedra, nodes, volume):
    for t in range(len(tetrahedra)):
        volume[t] = area_vectors(nodes, tetrahedra, t)[0]


@njit(cache=True, nogil=True, error_model="numpy")
def add_volume_forces(volumes, positions, velocity, force):
    """Adds to force (N, 3) that of the volume term at positions and velocity (N, 3).

    Its `change` is left with volumes above those at rest, as if moved on for the damping time.
    """
    tetrahedra, rest_volume, element, nodal = volumes[:4]
    inverse_weight, yield_area, damping_time, mean, change = volumes[4:]
    mean[:] = 0.0
    y = velocity
    for t in range(len(tetrahedra)):
        volume, px, py, pz, qx, qy, qz, rx, ry, rz = area_vectors(positions, tetrahedra, t)
        change[t] = volume - rest_volume[t]
        a, b, c, d = tetrahedra[t, 0], tetrahedra[t, 1], tetrahedra[t, 2], tetrahedra[t, 3]
        if damping_time > 0.0:
            rate = (y[b, 0] - y[a, 0]) * px + (y[b, 1] - y[a, 1]) * py + (y[b, 2] - y[a, 2]) * pz
            rate += (y[c, 0] - y[a, 0]) * qx + (y[c, 1] - y[a, 1]) * qy + (y[c, 2] - y[a, 2]) * qz
            rate += (y[d, 0] - y[a, 0]) * rx + (y[d, 1] - y[a, 1]) * ry + (y[d, 2] - y[a, 2]) * rz
            change[t] += damping_time * rate / 6.0
        change[t] *= _yielded(yield_area[t], px, py, pz, qx, qy, qz, rx, ry, rz)
        if len(mean) > 0:
            quarter = 0.25 * nodal[t] * change[t]
            mean[a] += quarter
            mean[b] += quarter
            mean[c] += quarter
            mean[d] += quarter
    for i in range(len(mean)):
        mean[i] *= inverse_weight[i]
    for t in range(len(tetrahedra)):
        a, b, c, d = tetrahedra[t, 0], tetrahedra[t, 1], tetrahedra[t, 2], tetrahedra[t, 3]
        _, px, py, pz, qx, qy, qz, rx, ry, rz = area_vectors(positions, tetrahedra, t)
        push = -element[t] * change[t] / rest_volume[t]
        if len(mean) > 0:
            push -= 0.25 * nodal[t] * (mean[a] + mean[b] + mean[c] + mean[d])
        push *= _yielded(yield_area[t], px, py, pz, qx, qy, qz, rx, ry, rz) / 6.0
        push_corners(tetrahedra, t, push, px, py, pz, qx, qy, qz, rx, ry, rz, force)
