"""Stiffness of linear (Cauchy strain) tetrahedra, and of those with averaged nodal pressures.

Averaged pressures keep nearly incompressible tetrahedra from locking. The equations are those of
the neo-Hookean material with the same `volumetric_split`, linearised at rest: K u + B' p = f and
B u = C p, with one pressure at each node whose surroundings are nearly incompressible. Kept as
unknowns, the pressures couple neighbours only; eliminated, they leave the stiffness K + B' C^-1 B,
which couples neighbours of neighbours.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import bsr_array, csr_array, dia_array

from us_sim.errors import SolverError
from us_sim.tissue.elasticity.materials import TissueMaterials, volumetric_split
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh


@lru_cache(maxsize=1)  # a solver asks for those of its mesh several times
def shape_gradients(mesh: TetrahedralMesh) -> NDArray[np.float64]:
    """Return (M, 4, 3) 1/m, gradients of the four linear shape functions of each tetrahedron."""
    corners = mesh.nodes[mesh.tetrahedra]
    inverse = np.linalg.inv(corners[:, 1:] - corners[:, :1])
    gradients = np.empty((len(corners), 4, 3))
    gradients[:, 1:] = inverse.transpose(0, 2, 1)
    gradients[:, 0] = -gradients[:, 1:].sum(axis=1)
    return gradients


def assemble_stiffness(mesh: TetrahedralMesh, materials: TissueMaterials) -> bsr_array:
    """Assemble the stiffness (3N, 3N) N/m: symmetric, in 3x3 blocks with sorted columns.

    A tetrahedron of volume V couples its nodes a and b by
    V (lambda ga gb' + mu gb ga' + mu (ga . gb) I), with g the shape functions' gradients and lambda
    and mu Lame's constants (Zienkiewicz and Taylor, The Finite Element Method 1, 5th ed., 6.2).
    """
    modulus, ratio = materials.young_modulus, materials.poisson_ratio
    first = modulus * ratio / ((1 + ratio) * (1 - 2 * ratio))
    return assemble_lame_stiffness(mesh, first, modulus / (2 * (1 + ratio)))


def assemble_lame_stiffness(
    mesh: TetrahedralMesh, first: NDArray[np.float64], second: NDArray[np.float64]
) -> bsr_array:
    """Assemble the stiffness as `assemble_stiffness`, from Lame's constants lambda, mu (M,) Pa."""
    count = len(mesh.nodes)
    first = first * mesh.volumes
    second = second * mesh.volumes
    gradients = shape_gradients(mesh)
    outer = gradients[:, :, None, :, None] * gradients[:, None, :, None, :]
    local = first[:, None, None, None, None] * outer
    local += second[:, None, None, None, None] * outer.swapaxes(3, 4)
    dots = second[:, None, None] * (gradients @ gradients.transpose(0, 2, 1))
    for axis in range(3):
        local[..., axis, axis] += dots

    rows = np.repeat(mesh.tetrahedra, 4, axis=1).ravel().astype(np.int64)
    columns = np.tile(mesh.tetrahedra, (1, 4)).ravel()
    pairs, place = np.unique(rows * count + columns, return_inverse=True)
    entries = local.reshape(-1, 9)
    blocks = np.empty((len(pairs), 9))
    for entry in range(9):
        blocks[:, entry] = np.bincount(place, entries[:, entry], len(pairs))
    start = np.searchsorted(pairs, np.arange(count + 1) * count).astype(np.int32)
    return bsr_array(
        (blocks.reshape(-1, 3, 3), (pairs % count).astype(np.int32), start),
        shape=(3 * count, 3 * count),
    )


def drop_fixed_nodes(matrix: bsr_array, fixed: NDArray[np.bool_]) -> bsr_array:
    """Return the stiffness without the rows and columns of fixed (N,) nodes."""
    rows = np.repeat(np.arange(len(fixed)), np.diff(matrix.indptr))
    kept = ~fixed[rows] & ~fixed[matrix.indices]
    number = np.cumsum(~fixed) - 1
    count = int((~fixed).sum())
    start = np.searchsorted(number[rows[kept]], np.arange(count + 1)).astype(np.int32)
    columns = number[matrix.indices[kept]].astype(np.int32)
    return bsr_array((matrix.data[kept], columns, start), shape=(3 * count, 3 * count))


def require_held(mesh: TetrahedralMesh, fixed: NDArray[np.bool_]) -> None:
    """Check that no part of the mesh can move as a rigid body.

    Tetrahedra of a part hang together by faces (`check_mesh` refuses
    hinges), so that three of its nodes hold all of it.

    Raises:
        SolverError: a connected part has no three fixed nodes off one line.
    """
    nodes = np.flatnonzero(fixed)
    nodes = nodes[np.argsort(mesh.parts[nodes], kind="stable")]
    bounds = np.searchsorted(mesh.parts[nodes], np.arange(mesh.parts.max() + 2))
    for part, (first, last) in enumerate(itertools.pairwise(bounds)):
        held = mesh.nodes[nodes[first:last]]
        spread = np.zeros(3)
        if len(held) > 2:
            spread = np.linalg.svd(held - held.mean(axis=0), compute_uv=False)
        if spread[1] <= 1e-9 * spread[0]:
            line = " on one line" if len(held) > 2 else ""
            raise SolverError(
                f"the tissue can move as a whole: the part of the mesh around node "
                f"{np.argmax(mesh.parts == part)} has {len(held)} fixed nodes{line}; fix at least "
                f"three that are not on one line, such as the face `bottom`"
            )


def nodal_shear_stiffness(mesh: TetrahedralMesh, materials: TissueMaterials) -> NDArray[np.float64]:
    """Return (N,) N/m, how firmly each node resists a displacement of itself alone by shear."""
    shear = materials.young_modulus / (2 * (1 + materials.poisson_ratio))
    resists = (shear * mesh.volumes)[:, None] * (shape_gradients(mesh) ** 2).sum(axis=2)
    total = np.zeros(len(mesh.nodes))
    np.add.at(total, mesh.tetrahedra, resists)
    return total


@dataclass(frozen=True, eq=False)
class AveragedPressure:
    """The matrices of the two equations; P nodes have a pressure."""

    element: bsr_array | csr_array  # (3N, 3N) N/m, K, of shear and the tetrahedra's own bulk
    coupling: csr_array  # (P, 3N) N/m2 m2, B, change of volume around each node times its stiffness
    capacity: NDArray[np.float64]  # (P,) N m, C, volume around each node times its stiffness
    pressure_nodes: NDArray[np.int32]  # (P,)

    @cached_property
    def stiffness(self) -> csr_array:
        """(3N, 3N) N/m, with the pressures eliminated."""
        scaled = dia_array((1 / self.capacity[None], [0]), shape=2 * self.capacity.shape)
        return (self.element + self.coupling.T @ (scaled @ self.coupling)).tocsr()

    def compute_forces(self, displacement: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (N, 3, ...) N, external forces that hold nodes at displacements (N, 3, ...) m."""
        moved = displacement.reshape(3 * len(displacement), -1)
        pressure = (self.coupling @ moved) / self.capacity[:, None]
        held = self.element @ moved + self.coupling.T @ pressure
        return held.reshape(displacement.shape)

    def restrict_to(self, nodes: NDArray[np.integer]) -> AveragedPressure:
        """Return the equations of some nodes (K,); all others stay."""
        kept = (3 * nodes[:, None] + np.arange(3)).ravel()
        # Rows of numbers are faster than blocks for many displacements at once.
        element, coupling = self.element.tocsr()[kept][:, kept], self.coupling[:, kept]
        return replace(self, element=element, coupling=coupling)


def assemble_averaged_pressure(
    mesh: TetrahedralMesh, materials: TissueMaterials
) -> AveragedPressure:
    """Assemble the equations of a mesh."""
    split = volumetric_split(materials)
    element = assemble_lame_stiffness(mesh, split.element - split.shear, split.shear)
    weight = split.nodal * mesh.volumes / 4
    # A nodal part this small is the rounding of zero: it gets no pressure.
    weight[split.nodal <= 1e-9 * split.element] = 0.0
    capacity: NDArray[np.float64] = np.bincount(
        mesh.tetrahedra.ravel(), np.repeat(weight, 4), len(mesh.nodes)
    ).astype(np.float64)
    with_pressure = np.flatnonzero(capacity > 0).astype(np.int32)
    number = np.cumsum(capacity > 0) - 1
    near = np.flatnonzero(weight > 0)
    corners = mesh.tetrahedra[near]
    divergence = weight[near, None, None] * shape_gradients(mesh)[near]
    rows = np.broadcast_to(number[corners][:, :, None, None], (len(near), 4, 4, 3))
    columns = np.broadcast_to(
        (3 * corners[:, :, None] + np.arange(3))[:, None], (len(near), 4, 4, 3)
    )
    values = np.broadcast_to(divergence[:, None], (len(near), 4, 4, 3))
    coupling = csr_array(
        (values.ravel(), (rows.ravel(), columns.ravel())),
        shape=(len(with_pressure), 3 * len(mesh.nodes)),
    )
    coupling.sum_duplicates()
    return AveragedPressure(element, coupling, capacity[with_pressure], with_pressure)
