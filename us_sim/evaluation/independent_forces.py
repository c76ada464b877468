"""Forces that hold tissue at its displacements, by the equations of each method, in NumPy.

They are written a second time, in double precision, and share no code with a solver, so that they
show a solver's rounding and omissions: see `bound_imbalance`.

>>> from us_sim.tissue.elasticity.material import Material
>>> from us_sim.tissue.model import TissueModel
>>> block = TissueModel.make_block(nodes=(2, 2, 2), material=Material(10e3, 0.25))
>>> pulled = block.mesh.nodes * [0.0, 0.0, 0.01]  # one percent of strain along z
>>> forces = compute_hooke_forces(block.mesh, block.materials, pulled)
>>> f"{forces[block.mesh.nodes[:, 2] > 0.05, 2].sum():.3f} N"  # 1.2 E of strain on 0.01 m2
'1.200 N'
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from us_sim.tissue.elasticity.materials import TissueMaterials
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh
from us_sim.tissue.model import Deformation, TissueModel

Array: TypeAlias = NDArray[np.float64]
Forces: TypeAlias = Callable[[Array], Array]
"""Forces (N, 3) N that hold the nodes at displacements (N, 3) m."""

_ELEMENT_BULK = 5.0
"""Greatest (lambda + mu) / mu within tetrahedra; the rest acts on averages around nodes."""

_ROUNDED = 10.0
"""Bound of the forces of rounding, over those of one random rounding of the nodes."""


def bound_imbalance(
    model: TissueModel, forces: Forces, deformation: Deformation
) -> tuple[float, float, float]:
    """Return bounds in N: the unbalanced force from below, its rounding and the load from above.

    These are norms over all nodes. Nodes that the probe does not touch must balance by themselves;
    the contact forces are not known here. If the reported residual (unbalanced over contact forces)
    is true, the contact forces are at most the load.
    """
    displacement = deformation.nodes - model.mesh.nodes
    touched = np.zeros(len(displacement), dtype=bool)
    touched[deformation.contact_nodes] = True
    noise = np.random.default_rng(0).standard_normal(displacement.shape)
    noise *= np.finfo(np.float64).eps * np.abs(model.mesh.nodes).max()
    with np.errstate(all="ignore"):
        holding = forces(displacement)
        rounding = _ROUNDED * np.linalg.norm((forces(displacement + noise) - holding)[~model.fixed])
        pushed = np.linalg.norm(holding[touched & ~model.fixed])
        unbalanced = np.linalg.norm(holding[~touched & ~model.fixed])
    load = pushed / max(1.0 - deformation.residual, 1e-300)
    return float(unbalanced), float(rounding), float(load)


def compute_hooke_forces(
    mesh: TetrahedralMesh,
    materials: TissueMaterials,
    displacement: Array,
    *,
    averaged: bool = False,
) -> Array:
    """Compute forces (N, 3) N that hold Hooke's material at displacements (N, 3) m.

    If ``averaged``, the greater part of a high bulk stiffness acts on averages around nodes
    (J. Bonet and A. J. Burton, A simple average nodal pressure tetrahedral element for
    incompressible and nearly incompressible dynamic explicit applications, Commun. Numer. Meth.
    Engng. 14, 1998).
    """
    shear, own, nodal = _split_moduli(materials, _ELEMENT_BULK if averaged else np.inf)
    gradient = _compute_gradients(mesh)
    slope = _compute_slopes(mesh, gradient, displacement)
    pressure = (own - shear) * _trace(slope) + _average_around_nodes(mesh, nodal, _trace(slope))
    stress = shear[:, None, None] * (slope + slope.transpose(0, 2, 1))
    return _gather_forces(mesh, gradient, stress + pressure[:, None, None] * np.eye(3))


def compute_neo_hookean_forces(
    mesh: TetrahedralMesh, materials: TissueMaterials, displacement: Array
) -> Array:
    """Compute forces (N, 3) N that hold a stable neo-Hookean material; pressures are averaged.

    They are the energy's derivative at displacements (N, 3) m, without lumens (B. Smith, F. de Goes
    and T. Kim, Stable Neo-Hookean Flesh Simulation, ACM Trans. Graph. 37, 2018, without its
    logarithmic barrier).
    """
    shear, own, nodal = _split_moduli(materials, _ELEMENT_BULK)
    gradient = _compute_gradients(mesh)
    slope = _compute_slopes(mesh, gradient, displacement)
    # J - 1 as a polynomial in the displacement's gradient, so that nothing cancels.
    minors = (_trace(slope) ** 2 - _trace(slope @ slope)) / 2
    swelling = _trace(slope) + minors + np.linalg.det(slope)
    pressure = own * swelling + _average_around_nodes(mesh, nodal, swelling)
    pressure += _compute_wall_modulus(mesh, shear) * _differentiate_wall(1 + swelling)
    # mu F - mu cof F, again without cancelling: cof F - F = tr(H) I - H' - H + cof H.
    difference = (
        _trace(slope)[:, None, None] * np.eye(3)
        - slope.transpose(0, 2, 1)
        - slope
        + _cofactors(slope)
    )
    stress = pressure[:, None, None] * _cofactors(slope + np.eye(3))
    return _gather_forces(mesh, gradient, stress - shear[:, None, None] * difference)


def compute_spring_forces(
    edges: NDArray[np.int32], stiffness: Array, rest: Array, displacement: Array
) -> Array:
    """Compute forces (N, 3) N that hold springs of (E,) N/m along edges (E, 2), slack at rest."""
    before = rest[edges[:, 1]] - rest[edges[:, 0]]
    moved = displacement[edges[:, 1]] - displacement[edges[:, 0]]
    now = before + moved
    length, rest_length = np.linalg.norm(now, axis=1), np.linalg.norm(before, axis=1)
    # The difference of the squares does not cancel.
    longer = np.einsum("ij,ij->i", moved, now + before) / np.maximum(length + rest_length, 1e-300)
    pull = stiffness * longer / np.maximum(length, 1e-300)
    force = np.zeros_like(rest)
    np.add.at(force, edges[:, 1], pull[:, None] * now)
    np.add.at(force, edges[:, 0], -pull[:, None] * now)
    return force


def _split_moduli(materials: TissueMaterials, limit: float) -> tuple[Array, Array, Array]:
    """Return mu, the elements' part of lambda + mu, at most ``limit`` mu, and the nodes' part."""
    shear = materials.young_modulus / (2 + 2 * materials.poisson_ratio)
    whole = shear / (1 - 2 * materials.poisson_ratio)
    own = np.minimum(whole, limit * shear)
    return shear, own, whole - own


def _compute_gradients(mesh: TetrahedralMesh) -> Array:
    """Compute gradients (M, 4, 3) 1/m of the shape functions of each corner."""
    corners = mesh.nodes[mesh.tetrahedra]
    gradient = np.empty_like(corners)
    for corner, (a, b, c) in enumerate(((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))):
        face = np.cross(corners[:, b] - corners[:, a], corners[:, c] - corners[:, a])
        height = np.einsum("ij,ij->i", corners[:, corner] - corners[:, a], face)
        gradient[:, corner] = face / height[:, None]
    return gradient


def _compute_slopes(mesh: TetrahedralMesh, gradient: Array, displacement: Array) -> Array:
    """Compute gradients (M, 3, 3) of the displacement, component by direction.

    They are relative to one corner, so that translations cancel exactly.
    """
    moved = displacement[mesh.tetrahedra]
    return np.einsum("mai,maj->mij", moved - moved[:, :1], gradient)


def _gather_forces(mesh: TetrahedralMesh, gradient: Array, stress: Array) -> Array:
    force = np.zeros((len(mesh.nodes), 3))
    corners = np.einsum("m,mij,maj->mai", mesh.volumes, stress, gradient)
    np.add.at(force, mesh.tetrahedra, corners)
    return force


def _average_around_nodes(mesh: TetrahedralMesh, modulus: Array, value: Array) -> Array:
    """Return (M,) Pa: modulus times the mean over the corners of weighted means around each."""
    weight = modulus * mesh.volumes / 4
    weights, sums = np.zeros(len(mesh.nodes)), np.zeros(len(mesh.nodes))
    np.add.at(weights, mesh.tetrahedra, weight[:, None])
    np.add.at(sums, mesh.tetrahedra, (weight * value)[:, None])
    mean = np.divide(sums, weights, out=np.zeros_like(sums), where=weights > 0)
    return np.asarray(modulus * mean[mesh.tetrahedra].mean(axis=1))


def _trace(matrices: Array) -> Array:
    return np.asarray(np.trace(matrices, axis1=1, axis2=2))


def _cofactors(matrices: Array) -> Array:
    a, b, c = np.moveaxis(matrices, 1, 0)
    return np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)


_CROWDED, _CRUSHED = 1 / 4, 1 / 50
"""Volume ratios below which a nonlinear tetrahedron resists crushing, and does so linearly."""

_WALL = 5.0
"""Modulus of that resistance, over the geometric mean of a tetrahedron's own shear modulus and the
largest among the tetrahedra with which it shares a node."""


def _compute_wall_modulus(mesh: TetrahedralMesh, shear: Array) -> Array:
    """Compute the modulus (M,) Pa of each tetrahedron's resistance to crushing."""
    largest = np.zeros(len(mesh.nodes))
    np.maximum.at(largest, mesh.tetrahedra, shear[:, None])
    return np.asarray(_WALL * np.sqrt(shear * largest[mesh.tetrahedra].max(axis=1)))


def _differentiate_wall(ratio: Array) -> Array:
    """Differentiate (J0 - J)**3 / 3 J0 J by J below J0; go on linearly where J is tiny."""
    held = np.clip(ratio, _CRUSHED, _CROWDED)
    missing = _CROWDED - held
    slope = -(missing**2) * (2 * held + _CROWDED) / (3 * _CROWDED * held**2)
    square = held**2 + _CROWDED * held + _CROWDED**2
    rise = 2 * missing * square / (3 * _CROWDED * held**3)
    return np.asarray(slope + rise * np.minimum(ratio - _CRUSHED, 0))
