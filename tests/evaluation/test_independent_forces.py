"""Forces that judge solvers, against hand-made numbers, scikit-fem, and derivatives of energies."""

import numpy as np
import pytest
import skfem
from skfem.models.elasticity import lame_parameters, linear_elasticity

from us_sim.evaluation.independent_forces import (
    bound_imbalance,
    compute_hooke_forces,
    compute_neo_hookean_forces,
    compute_spring_forces,
)
from us_sim.evaluation.stability.cases import StabilityCase, make_mesh, make_model
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import TissueMaterials, make_uniform_materials
from us_sim.tissue.model import Deformation

pytestmark = pytest.mark.slow
RANDOM = np.random.default_rng(2)


def materials_of(mesh, ratio):
    count = len(mesh.tetrahedra)
    modulus = 10 ** RANDOM.uniform(3, 6, count)
    return TissueMaterials(modulus, np.full(count, ratio), np.full(count, 1e3))


def test_hookes_forces_are_those_of_scikit_fem():
    mesh = make_mesh("delaunay")
    materials = make_uniform_materials(mesh, Material(2e4, 0.4))
    grid = skfem.MeshTet(mesh.nodes.T, mesh.tetrahedra.T)
    basis = skfem.Basis(grid, skfem.ElementVector(skfem.ElementTetP1()))
    matrix = linear_elasticity(*lame_parameters(2e4, 0.4)).assemble(basis)
    displacement = 1e-3 * RANDOM.standard_normal(mesh.nodes.shape)
    expected = (matrix @ displacement.ravel()).reshape(-1, 3)
    forces = compute_hooke_forces(mesh, materials, displacement)
    assert np.abs(forces - expected).max() < 1e-10 * np.abs(expected).max()


def test_neo_hookean_forces_are_the_derivative_of_their_energy():
    mesh = make_mesh("perturbed")
    materials = materials_of(mesh, 0.49)
    displacement = 2e-3 * RANDOM.standard_normal(mesh.nodes.shape)
    direction = RANDOM.standard_normal(mesh.nodes.shape)
    h = 1e-7
    difference = (
        _energy(mesh, materials, displacement + h * direction)
        - _energy(mesh, materials, displacement - h * direction)
    ) / (2 * h)
    forces = compute_neo_hookean_forces(mesh, materials, displacement)
    assert (forces * direction).sum() == pytest.approx(difference, rel=1e-6)


def test_one_spring_by_hand():
    rest = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]])
    moved = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]])  # twice as long: 5 m more
    force = compute_spring_forces(np.array([[0, 1]]), np.array([10.0]), rest, moved)
    assert force == pytest.approx(np.array([[-30.0, -40.0, 0.0], [30.0, 40.0, 0.0]]))


def test_a_tetrahedron_resists_being_crushed_by_its_stiffest_neighbour():
    mesh = make_mesh("perturbed")
    modulus = np.full(len(mesh.tetrahedra), 1e3)
    stiff = mesh.tetrahedra[0]
    modulus[0] = 1e7
    crushed = np.flatnonzero(np.isin(mesh.tetrahedra, stiff).any(axis=1))[1:]
    materials = TissueMaterials(modulus, np.zeros(len(modulus)), np.full(len(modulus), 1e3))
    flat = mesh.nodes * [0.0, 0.0, -0.9]  # J = 0.1 everywhere
    forces = compute_neo_hookean_forces(mesh, materials, flat)
    # cof F is one along z: the stress there is mu F + p - mu, where p is (lambda + mu) (J - 1),
    # lambda being zero, and the wall's modulus times -(J0 - J)^2 (2 J + J0) / (3 J0 J^2).
    slope = -(0.15**2) * 0.45 / (3 * 0.25 * 0.01)
    shear = modulus / 2
    wall = 5 * shear
    wall[crushed] = 5 * np.sqrt(500.0 * 5e6)
    stress = shear * 0.1 + shear * (0.1 - 1) - shear + wall * slope
    # The work at a virtual displacement by z along z, whose gradient is one.
    virtual = (forces[:, 2] * mesh.nodes[:, 2]).sum()
    assert virtual == pytest.approx((mesh.volumes * stress).sum(), rel=1e-9)


def test_what_is_unbalanced_is_what_nodes_away_from_the_probe_are_held_by():
    model = make_model(StabilityCase("plain", collider="plate"))
    node = int(model.movable_contact_nodes[5])
    other = int(np.flatnonzero(~model.fixed)[0])
    force = np.zeros_like(model.mesh.nodes)
    force[node] = [0.0, 0.0, 4.0]
    force[other] = [0.0, 0.4, 0.0]
    force[model.fixed] = 9.0
    touched, zero = np.array([node], np.int32), np.zeros(3)
    deformation = Deformation(model.mesh.nodes, touched, zero, zero, 0.2)
    unbalanced, rounding, load = bound_imbalance(model, lambda _: force, deformation)
    assert (unbalanced, rounding, load) == pytest.approx((0.4, 0.0, 4 / 0.8))


def _energy(mesh, materials, displacement):
    """The stable neo-Hookean energy with averaged pressures, J, tetrahedron by tetrahedron."""
    weight, mean, energy = np.zeros(len(mesh.nodes)), np.zeros(len(mesh.nodes)), 0.0
    for i, corners in enumerate(mesh.tetrahedra):
        rest, now = mesh.nodes[corners], (mesh.nodes + displacement)[corners]
        edges = (rest[1:] - rest[0]).T
        gradient = (now[1:] - now[0]).T @ np.linalg.inv(edges)
        volume, swollen = np.linalg.det(edges) / 6, np.linalg.det(gradient)
        shear = materials.young_modulus[i] / (2 + 2 * materials.poisson_ratio[i])
        whole = shear / (1 - 2 * materials.poisson_ratio[i])
        own = min(whole, 5 * shear)
        energy += volume * (
            shear / 2 * ((gradient**2).sum() - 3)
            - shear * (swollen - 1)
            + own / 2 * (swollen - 1) ** 2
        )
        weight[corners] += (whole - own) * volume / 4
        mean[corners] += (whole - own) * volume / 4 * (swollen - 1)
    return energy + 0.5 * (mean**2 / weight).sum()
