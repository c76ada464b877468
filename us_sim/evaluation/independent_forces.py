"""Forces that hold tissue at its displacements, by the equations of each method, in NumPy.

They are written down a second time, in double precision, and share no kernel with a solver, so
that rounding and omissions of a solver show: see `least_unbalanced`.

>>> from us_sim.tissue.elasticity.material import Material
>>> from us_sim.tissue.model import TissueModel
>>> block = TissueModel.block(nodes=(2, 2, 2), material=Material(10e3, 0.25))
>>> pulled = block.mesh.nodes * [0.0, 0.0, 0.01]  # one percent of strain along z
>>> forces = hooke_forces(block.mesh, block.materials, pulled)
>>> f"{forces[block.mesh.nodes[:, 2] > 0.05, 2].sum():.3f} N"  # 1.2 E of strain on 0.01 m2
'1.200 N'
>>> one = np.ones(3)
>>> pressures = lumen_pressure(np.array([0.0, -0.1, -0.5]), one, 1000 * one, one, one)
>>> pressures.round().tolist()
[0.0, -750.0, -1000.0]
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
"""(N, 3) N that hold the nodes at displacements (N, 3) m."""

_ELEMENT_BULK = 5.0
"""Greatest (lambda + mu) / mu within tetrahedra; the rest acts on averages around nodes."""

_ROUNDED = 10.0
"""How many times the forces of rounding may be those of one random rounding of the nodes."""


def least_unbalanced(
    model: TissueModel, forces: Forces, deformation: Deformation
) -> tuple[float, float, float]:
    """Return what is unbalanced at least, what may be rounding of it, and the load at most, N.

    These are norms over all nodes. Nothing balances the nodes that the probe does not touch; what
    it leaves at those that it touches is not known here, nor the size of its forces. If the
    reported residual is true, unbalanced over contact forces, they are at most the load.
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


def hooke_forces(mesh: TetrahedralMesh, materials: TissueMaterials, displacement: Array) -> Array:
    """(N, 3) N that hold linear tetrahedra of Hooke's material at displacements (N, 3) m."""
    shear, whole, volume, gradient = _elements(mesh, materials)
    slope = _slopes(mesh, gradient, displacement)
    stress = shear[:, None, None] * (slope + slope.transpose(0, 2, 1))
    return _gathered(mesh, volume, gradient, stress, (whole - shear) * _trace(slope))


def averaged_hooke_forces(
    mesh: TetrahedralMesh, materials: TissueMaterials, displacement: Array
) -> Array:
    """As `hooke_forces`, with the greater part of a high bulk stiffness averaged around nodes.

    (J. Bonet and A. J. Burton, A simple average nodal pressure tetrahedral element for
    incompressible and nearly incompressible dynamic explicit applications, Commun. Numer. Meth.
    Engng. 14, 1998.)
    """
    shear, whole, volume, gradient = _elements(mesh, materials)
    slope = _slopes(mesh, gradient, displacement)
    own, nodal = _bulk_parts(shear, whole)
    pressure = own * _trace(slope) + nodal * _around(mesh, nodal * volume / 4, _trace(slope))
    stress = shear[:, None, None] * (slope + slope.transpose(0, 2, 1))
    return _gathered(mesh, volume, gradient, stress, pressure - shear * _trace(slope))


def neo_hookean_forces(
    mesh: TetrahedralMesh, materials: TissueMaterials, displacement: Array
) -> Array:
    """Derivative of the stable neo-Hookean energy with averaged pressures, (N, 3) N.

    (B. Smith, F. de Goes and T. Kim, Stable Neo-Hookean Flesh Simulation, ACM Trans. Graph. 37,
    2018, without its logarithmic barrier, and with the third term of O. H. Yeoh, Some forms of the
    strain energy function for rubber, Rubber Chem. Technol. 66, 1993, where materials stiffen.)
    """
    shear, whole, volume, gradient = _elements(mesh, materials)
    slope = _slopes(mesh, gradient, displacement)
    swelling = _swelling(slope)
    own, nodal = _bulk_parts(shear, whole)
    hollow = materials.lumen_fraction > 0.0
    empties = emptied_fraction(materials)
    shear = shear * (1 - empties + LUMEN_SHEAR * empties)
    nodal = np.where(hollow, 0.0, nodal)
    pressure = own * swelling + nodal * _around(mesh, nodal * volume / 4, swelling)
    wall = wall_modulus(mesh, shear)
    pressure += wall * crowding(1 + swelling)
    pressure[hollow] = lumen_pressure(
        *(part[hollow] for part in (swelling, empties, materials.lumen_pressure, own, wall))
    )
    cofactor = _cofactors(slope + np.eye(3))
    # mu F - mu cof F, again without cancelling: cof F - F = tr(H) I - H' - H + cof H.
    difference = (
        _trace(slope)[:, None, None] * np.eye(3)
        - slope.transpose(0, 2, 1)
        - slope
        + _cofactors(slope)
    )
    stress = pressure[:, None, None] * cofactor - shear[:, None, None] * difference
    return _gathered(mesh, volume, gradient, stress, np.zeros(len(volume)))


def spring_forces(
    edges: NDArray[np.int32], stiffness: Array, rest: Array, displacement: Array
) -> Array:
    """(N, 3) N that hold springs of (E,) N/m along edges (E, 2), undeformed at ``rest`` (N, 3)."""
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


def _elements(
    mesh: TetrahedralMesh, materials: TissueMaterials
) -> tuple[Array, Array, Array, Array]:
    """mu and lambda + mu (M,) Pa, volumes (M,) m3 and shape gradients (M, 4, 3) 1/m."""
    ratio = materials.poisson_ratio
    shear = materials.young_modulus / (2 + 2 * ratio)
    first = materials.young_modulus * ratio / ((1 + ratio) * (1 - 2 * ratio))
    return shear, first + shear, mesh.volumes, _gradients(mesh)


def _bulk_parts(shear: Array, whole: Array) -> tuple[Array, Array]:
    own = np.minimum(whole, _ELEMENT_BULK * shear)
    return own, whole - own


def _gradients(mesh: TetrahedralMesh) -> Array:
    """(M, 4, 3) 1/m: each shape function falls from its corner to the face opposite."""
    corners = mesh.nodes[mesh.tetrahedra]
    gradient = np.empty_like(corners)
    for corner, (a, b, c) in enumerate(((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))):
        face = np.cross(corners[:, b] - corners[:, a], corners[:, c] - corners[:, a])
        height = np.einsum("ij,ij->i", corners[:, corner] - corners[:, a], face)
        gradient[:, corner] = face / height[:, None]
    return gradient


def _slopes(mesh: TetrahedralMesh, gradient: Array, displacement: Array) -> Array:
    """(M, 3, 3) gradient of the displacement, component by direction.

    Relative to one corner, so that a displacement of a whole tetrahedron cancels exactly.
    """
    moved = displacement[mesh.tetrahedra]
    return np.einsum("mai,maj->mij", moved - moved[:, :1], gradient)


def _gathered(
    mesh: TetrahedralMesh, volume: Array, gradient: Array, stress: Array, pressure: Array
) -> Array:
    whole = stress + pressure[:, None, None] * np.eye(3)
    force = np.zeros((len(mesh.nodes), 3))
    corners = np.einsum("m,mij,maj->mai", volume, whole, gradient)
    np.add.at(force, mesh.tetrahedra, corners)
    return force


def _around(mesh: TetrahedralMesh, weight: Array, value: Array) -> Array:
    """(M,) mean over a tetrahedron's nodes of the weighted means around each node."""
    total, sum_of = np.zeros(len(mesh.nodes)), np.zeros(len(mesh.nodes))
    np.add.at(total, mesh.tetrahedra, weight[:, None])
    np.add.at(sum_of, mesh.tetrahedra, (weight * value)[:, None])
    mean = np.divide(sum_of, total, out=np.zeros_like(total), where=total > 0)
    return np.asarray(mean[mesh.tetrahedra].mean(axis=1))


def _swelling(slope: Array) -> Array:
    """(M,) J - 1 as a polynomial in the displacement's gradient, so that nothing cancels."""
    minors = (_trace(slope) ** 2 - _trace(slope @ slope)) / 2
    return np.asarray(_trace(slope) + minors + np.linalg.det(slope))


def _trace(matrices: Array) -> Array:
    return np.asarray(np.trace(matrices, axis1=1, axis2=2))


def _cofactors(matrices: Array) -> Array:
    a, b, c = np.moveaxis(matrices, 1, 0)
    return np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)


_CROWDED, _CRUSHED = 1 / 4, 1 / 50
"""Volume ratios below which a nonlinear tetrahedron resists being crushed, and more simply so."""

_WALL = 5.0
"""Modulus of that resistance, over the geometric mean of a tetrahedron's own shear modulus and the
largest among the tetrahedra with which it shares a node."""

LUMEN_SHEAR, _LUMEN_SLACK, _LUMEN_TOUCHING, _LUMEN_PRESSED = 1 / 20, 1 / 5, 1 / 5, 5.0
"""Of lumens: shear modulus over that of the solid that stands in; strain until the wall is slack;
least volume ratio at which the walls touch; how much firmer than the solid is what is emptied."""


def emptied_fraction(materials: TissueMaterials) -> Array:
    """(M,), of each tetrahedron, that its lumen may lose."""
    return np.asarray(1 - (1 - materials.lumen_fraction) ** 2)


def wall_modulus(mesh: TetrahedralMesh, shear: Array) -> Array:
    """(M,) Pa, how firmly each tetrahedron resists being crushed."""
    nodes, modulus = mesh.tetrahedra.ravel(), np.repeat(shear, 4)
    order = np.argsort(modulus, kind="stable")
    largest = np.zeros(len(mesh.nodes))
    largest[nodes[order]] = modulus[order]  # of each node's values the last one written stays
    return np.asarray(_WALL * np.sqrt(shear * largest[mesh.tetrahedra].max(axis=1)))


def crowding(ratio: Array, onset: Array | float = _CROWDED) -> Array:
    """Derivative by J of (J0 - J)**3 / 3 J0 J below J0, straight on from where J is tiny."""
    held = np.clip(ratio, _CRUSHED, onset)
    missing = onset - held
    slope = -(missing**2) * (2 * held + onset) / (3 * onset * held**2)
    square = held**2 + onset * held + onset**2
    rise = 2 * missing * square / (3 * onset * held**3)
    return slope + rise * np.minimum(ratio - _CRUSHED, 0)


def lumen_pressure(
    swelling: Array, empties: Array, blood: Array, bulk: Array, wall: Array
) -> Array:
    """Pa, of tetrahedra of which a fraction ``empties`` can leave, at the pressure of the blood.

    Lumen and solid are in series: of a pressure p (m**2 - 1) the former swells by its fraction
    times 0.2 (m - 1), the latter, where the pressure is all of its bulk's, by what Hooke says.
    """
    solid = (1 - empties) * blood / bulk
    eased = _LUMEN_SLACK * empties
    left = np.maximum(solid + eased + swelling, 0.0)
    stretch = np.array(
        [
            np.roots([a, b, -rest]).max() if a > 1e-9 * b else rest / b
            for a, b, rest in zip(solid, eased, left, strict=True)
        ]
    ).reshape(left.shape)
    onset = np.maximum(1 - empties - solid, _LUMEN_TOUCHING)
    firm = np.maximum(wall, _LUMEN_PRESSED * (1 - empties) * bulk)
    return np.asarray(blood * (stretch**2 - 1) + firm * crowding(1 + swelling, onset))
