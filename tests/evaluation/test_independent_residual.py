"""Forces that judge solvers, against hand-made numbers, scikit-fem, and derivatives of energies."""

import functools
from dataclasses import replace

import numpy as np
import pytest
import skfem
from skfem.models.elasticity import lame_parameters, linear_elasticity

from us_sim.evaluation.independent_forces import (
    hooke_forces,
    neo_hookean_forces,
    spring_forces,
    volume_forces,
)
from us_sim.evaluation.independent_residual import (
    IndependentResidual,
    contact_directions,
    flared_distance,
)
from us_sim.evaluation.stability.cases import StabilityCase, mesh_named, model_of
from us_sim.geometry.collider import Capsule, Convex, RoundedBox, Sphere
from us_sim.geometry.pose import Pose
from us_sim.tissue.contact.probe_gap import FlaredProbe, push_out
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import TissueMaterials, uniform_material
from us_sim.tissue.model import Deformation, TissueModel
from us_sim.tissue.solvers.fem_nonlinear import FemNonlinear

pytestmark = pytest.mark.slow
RANDOM = np.random.default_rng(2)


def materials_of(mesh, ratio):
    count = len(mesh.tetrahedra)
    modulus = 10 ** RANDOM.uniform(3, 6, count)
    return TissueMaterials(modulus, np.full(count, ratio), np.full(count, 1e3))


def test_hookes_forces_are_those_of_scikit_fem():
    mesh = mesh_named("delaunay")
    materials = uniform_material(mesh, Material(2e4, 0.4))
    grid = skfem.MeshTet(mesh.nodes.T, mesh.tetrahedra.T)
    basis = skfem.Basis(grid, skfem.ElementVector(skfem.ElementTetP1()))
    matrix = linear_elasticity(*lame_parameters(2e4, 0.4)).assemble(basis)
    displacement = 1e-3 * RANDOM.standard_normal(mesh.nodes.shape)
    expected = (matrix @ displacement.ravel()).reshape(-1, 3)
    forces = hooke_forces(mesh, materials, displacement)
    assert np.abs(forces - expected).max() < 1e-10 * np.abs(expected).max()


def test_neo_hookean_forces_are_the_derivative_of_their_energy():
    mesh = mesh_named("perturbed")
    materials = materials_of(mesh, 0.49)
    displacement = 2e-3 * RANDOM.standard_normal(mesh.nodes.shape)
    direction = RANDOM.standard_normal(mesh.nodes.shape)
    h = 1e-7
    difference = (
        _energy(mesh, materials, displacement + h * direction)
        - _energy(mesh, materials, displacement - h * direction)
    ) / (2 * h)
    forces = neo_hookean_forces(mesh, materials, displacement)
    assert (forces * direction).sum() == pytest.approx(difference, rel=1e-6)


def test_one_spring_and_one_tetrahedron_by_hand():
    rest = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]])
    moved = np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]])  # twice as long: 5 m more
    force = spring_forces(np.array([[0, 1]]), np.array([10.0]), rest, moved)
    assert force == pytest.approx(np.array([[-30.0, -40.0, 0.0], [30.0, 40.0, 0.0]]))

    mesh = mesh_named("tetrahedron")
    one = np.ones(1)
    stretched = mesh.nodes * [0.0, 0.0, 0.1]  # J = 1.1
    for element, nodal in ((3e4 * one, 0 * one), (0 * one, 3e4 * one)):
        force = volume_forces(mesh, element, nodal, stretched)
        # A pressure of 3000 Pa pulls back. On the bottom, of 0.06 * 0.07 / 2 m2, it takes that
        # times the area; the sides take as much upwards, two thirds of it at the bottom's nodes.
        assert force[1:, 2].sum() == pytest.approx(3000 * 0.06 * 0.07 / 2 / 3, rel=1e-9)


@pytest.mark.parametrize(
    "collider",
    [Sphere(0.03), Sphere(0.001), Capsule(0.012, 0.04), RoundedBox(0.06, 0.05, 0.05, 0.02)],
)
def test_contact_directions_follow_the_rule_of_contact(collider):
    pose = Pose([0.002, -0.001, 0.01], [0.2, -0.1, 0.3, 0.9])
    points = pose.apply(RANDOM.uniform([-0.02, -0.02, -0.03], [0.02, 0.02, 0.01], (200, 3)))
    gap, normal = push_out(collider, pose, points, 0.002)
    found = contact_directions(collider, pose, points, 0.002)
    assert found[np.isfinite(gap)] == pytest.approx(normal[np.isfinite(gap)], abs=1e-12)


@pytest.mark.parametrize("spacing", [0.001, 0.006, 0.012])
@pytest.mark.parametrize(
    "collider",
    [
        Sphere(0.03),
        Sphere(0.001),
        Capsule(0.012, 0.04),
        RoundedBox(0.06, 0.05, 0.05, 0.02),
        RoundedBox(0.04, 0.014, 0.03, 0.004),
        RoundedBox(0.02, 0.03, 0.05, 1e-5),
        Convex(0.06, 0.06, 0.02, 0.05, 0.004),
        Convex(0.06, 0.09, 0.02, 0.05, 0.004),  # 47 degrees steep at its ends
        Convex(0.015, 0.025, 0.02, 0.05, 0.003),  # 52
        Convex(0.02, 0.036, 0.02, 0.05, 0.003),  # 62: steeper than flanks lean
    ],
)
def test_the_flared_probe_is_what_its_outlines_say(collider, spacing):
    pose = Pose([0.002, -0.001, 0.01], [0.2, -0.1, 0.3, 0.9])
    points = pose.apply(RANDOM.uniform([-0.04, -0.04, -0.06], [0.04, 0.04, 0.01], (3000, 3)))
    gap, normal = FlaredProbe(collider, spacing).distance(pose, points)
    assert (gap < 0).sum() > 1 or collider == Sphere(0.001)
    found, directions = flared_distance(collider, pose, points, spacing)
    np.testing.assert_allclose(found, gap, atol=1e-12)
    np.testing.assert_allclose(directions, normal, atol=1e-9)


def test_a_tetrahedron_resists_being_crushed_by_its_stiffest_neighbour():
    mesh = mesh_named("perturbed")
    modulus = np.full(len(mesh.tetrahedra), 1e3)
    stiff = mesh.tetrahedra[0]
    modulus[0] = 1e7
    crushed = np.flatnonzero(np.isin(mesh.tetrahedra, stiff).any(axis=1))[1:]
    materials = TissueMaterials(modulus, np.zeros(len(modulus)), np.full(len(modulus), 1e3))
    flat = mesh.nodes * [0.0, 0.0, -0.9]  # J = 0.1 everywhere
    forces = neo_hookean_forces(mesh, materials, flat)
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


def test_the_residual_is_unbalanced_over_contact_force():
    model = model_of(StabilityCase("plain", collider="plate"))
    node = int(model.movable_contact_nodes[5])
    other = int(np.flatnonzero(~model.fixed)[0])
    force = np.zeros_like(model.mesh.nodes)
    force[node] = [0.3, 0.0, 4.0]  # 4 N of push, 0.3 N along the surface
    force[other] = [0.0, 0.4, 0.0]
    check = IndependentResidual(model, lambda _: force, 0.0)
    deformation = Deformation(
        model.mesh.nodes, np.array([node], np.int32), np.zeros(3), np.zeros(3), 0.0
    )
    assert check.check(deformation, Pose())[0] == pytest.approx(0.5 / 4)
    force[node, 2] = -4.0  # a pull is not balanced, and refers to the push before
    assert check.check(deformation, Pose())[0] == pytest.approx(np.hypot(4.0, 0.5) / 4)


# A probe with an edge that the nodes do not see, one with a rounding that they see, and a ball.
PRESSING = [
    (RoundedBox(0.05, 0.03, 0.05, 0.004), Pose([0.003, 0.001, 0.008], [0.05, 0.03, 0.1, 1.0])),
    (RoundedBox(0.06, 0.06, 0.06, 0.028), Pose([0.003, 0.001, 0.008], [0.05, 0.03, 0.1, 1.0])),
    (Sphere(0.03), Pose([0.003, 0.001, 0.02])),
]


@functools.cache
def settled(number):
    """The tissue, pose and result of one of `PRESSING` after 60 frames."""
    collider, pose = PRESSING[number]
    solver = FemNonlinear(TissueModel.block(nodes=(9, 9, 6), collider=collider))
    for _ in range(60):
        deformation = solver.deform(pose)
    assert solver.is_settled
    return solver.model, pose, deformation


@pytest.mark.parametrize("number", range(len(PRESSING)))
def test_a_settled_press_is_balanced_by_contact_on_the_surface(number):
    model, pose, deformation = settled(number)
    check = surface_check(model)
    check.check(deformation, pose)  # a leap from rest
    residual, rounding = check.check(deformation, pose)
    assert 0.3 * deformation.residual < residual < 1.01 * deformation.residual < 1.1e-5
    assert rounding < 1e-5
    assert check.is_least

    # Nothing is pushed but what is touched.
    none = replace(deformation, contact_nodes=np.zeros(0, np.int32))
    assert surface_check(model).check(none, pose)[0] == 1.0
    # Away from the probe, what was pushed is not held.
    away = Pose(pose.position - [0.0, 0.0, 0.03], pose.orientation)
    assert surface_check(model).check(deformation, away)[0] == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("number", range(len(PRESSING)))
@pytest.mark.parametrize("along", [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
def test_a_touched_node_that_is_moved_is_noticed(number, along):
    model, pose, deformation = settled(number)
    touched = deformation.contact_nodes
    node = touched[np.argmin(np.linalg.norm(model.mesh.nodes[touched], axis=1))]
    nodes = deformation.nodes.copy()
    nodes[node] += 1e-3 * np.array(along)  # of 12.5 to its neighbours
    residual, _ = surface_check(model).check(replace(deformation, nodes=nodes), pose)
    assert residual > 0.015  # little, where a surface is bent: it is pushed in many directions


def test_a_pull_at_the_surface_is_not_balanced():
    model = TissueModel.block(collider=RoundedBox(0.4, 0.4, 0.1, 0.001))
    touched = model.movable_contact_nodes[5:6]
    force, pose = np.zeros_like(model.mesh.nodes), Pose([0.0, 0.0, 1e-4])
    for held, unbalanced in (([0.3, 0.0, 4.0], 0.3), ([0.0, 0.0, -4.0], 4.0)):
        force[touched] = held
        check = IndependentResidual(model, lambda _: force, 0.0, surface=True)
        deformation = Deformation(model.mesh.nodes, touched, np.zeros(3), np.zeros(3), 0.0)
        expected = unbalanced / np.linalg.norm(held)
        assert check.check(deformation, pose)[0] == pytest.approx(expected)


def test_how_tissue_is_pushed_is_not_known_where_a_probe_came_down_deep():
    model = TissueModel.block(collider=Sphere(0.03))
    pose = Pose([0.0, 0.0, 0.02])
    check = surface_check(model)

    def rounding(residual, pose):
        pressed = model.mesh.nodes + [0.0, 0.0, 0.02] * (1 - model.mesh.nodes[:, 2:] / 0.1)
        zero, touched = np.zeros(3), model.contact_nodes
        return check.check(Deformation(pressed, touched, zero, zero, residual), pose)[1]

    assert rounding(1e-3, pose) == np.inf  # 20 mm of 30 at once
    assert rounding(1e-6, pose) == np.inf  # settled on planes
    assert rounding(1e-3, pose) < 1e-9  # these are gone now
    assert rounding(1e-3, Pose([0.0, 0.0, 0.022])) < 1e-9  # 2 mm more
    assert rounding(1e-3, Pose([-0.3, 0.0, 0.04])) < 1e-9  # beside the tissue
    assert rounding(1e-3, Pose([0.3, 0.0, 0.04])) == np.inf  # beyond it, having gone through


def surface_check(model):
    def forces(displacement):
        return neo_hookean_forces(model.mesh, model.materials, displacement)

    return IndependentResidual(model, forces, 1e-12, surface=True)


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
