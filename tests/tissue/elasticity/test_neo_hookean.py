import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from neo_hookean_meshes import (
    BOTH,
    CELLS,
    TETRAHEDRA,
    assert_cells_are_tetrahedra,
    assert_slopes,
    random_field,
)
from skfem import Basis, ElementTetP1, ElementVector, LinearForm, MeshTet
from skfem.helpers import ddot, det, grad, identity, inv, transpose
from tissue_block import block_mesh, irregular

from us_sim.tissue.elasticity.linear_tetrahedra import shape_gradients
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import (
    TissueMaterials,
    make_uniform_materials,
    volumetric_split,
)
from us_sim.tissue.elasticity.neo_hookean import NeoHookean
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, box_mesh

RATIOS = pytest.mark.parametrize("ratio", [0.3, 0.49])
COUNT = len(CELLS.nodes)


def uniform(ratio, mesh=CELLS, modulus=10e3):
    return make_uniform_materials(mesh, Material(modulus, ratio, 1000.0))


def mixed(mesh=CELLS, decades=2.0):
    """Moduli over so many decades, some tetrahedra with a nodal part and some without."""
    rng = np.random.default_rng(5)
    count = len(mesh.tetrahedra)
    return TissueMaterials(
        10 ** rng.uniform(3, 3 + decades, count),
        rng.choice([-0.3, 0.0, 0.3, 0.45, 0.499], count),
        np.full(count, 1000.0),
    )


def deformation_gradients(mesh, displacement):
    moved = displacement.T[mesh.tetrahedra]
    return np.eye(3) + np.einsum("tai,taj->tij", moved, shape_gradients(mesh))


def tangent_matrix(tissue, count=COUNT):
    columns = np.eye(3 * count).reshape(-1, 3, count)
    return np.array([tissue.tangent_product(np.ascontiguousarray(c)).ravel() for c in columns])


@BOTH
@pytest.mark.parametrize("size", [1e-4, 1e-2])
def test_forces_are_the_slope_of_the_energy_and_the_tangent_theirs(mesh, size):
    tissue = NeoHookean(mesh, mixed(), np.float64)
    assert (tissue.count_inverted(random_field(size)) > 5) == (size == 1e-2)
    assert_slopes(tissue, size)


@BOTH
@RATIOS
def test_a_rigid_motion_has_no_forces_and_no_energy(mesh, ratio):
    tissue = NeoHookean(mesh, uniform(ratio), np.float64)
    turn, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    turn *= np.linalg.det(turn)
    moved = np.ascontiguousarray((mesh.nodes @ turn.T - mesh.nodes + [0.3, -0.2, 0.1]).T)
    scale = 10e3 * 0.01**2
    assert abs(tissue.compute_forces(moved)).max() < 1e-9 * scale
    assert abs(tissue.compute_energy(moved)) < 1e-9 * 10e3 * mesh.volumes.sum()
    # A deformed state, turned: the same energy, and its forces turned.
    deformed = random_field(2e-3)
    turned = turn @ (mesh.nodes.T + deformed) - mesh.nodes.T
    assert tissue.compute_energy(turned) == pytest.approx(
        tissue.compute_energy(deformed), rel=1e-12
    )
    forces = turn @ tissue.compute_forces(deformed)
    assert abs(tissue.compute_forces(turned) - forces).max() < 1e-9 * abs(forces).max()


@pytest.mark.parametrize("ratio", [0.3, 0.49, 0.4999])
def test_patch_of_uniform_stress(ratio):
    mesh = irregular(block_mesh((5, 4, 5)), 8e-3)
    tissue = NeoHookean(mesh, uniform(ratio, mesh), np.float64)
    gradient = np.eye(3) + np.array([[0.2, 0.1, -0.3], [0.05, -0.1, 0.2], [0.0, 0.4, 0.1]])
    displacement = np.ascontiguousarray((mesh.nodes @ gradient.T - mesh.nodes).T)
    forces = tissue.compute_forces(displacement)
    inner = np.ones(len(mesh.nodes), dtype=bool)
    inner[np.unique(mesh.boundary)] = False
    assert inner.sum() == 3 * 2 * 3
    assert abs(forces[:, inner]).max() < 1e-10 * abs(forces).max()
    # The first Piola-Kirchhoff stress on the rest area of the boundary, a third for each corner.
    shear = 10e3 / (2 * (1 + ratio))
    bulk = shear / (1 - 2 * ratio)
    volume = np.linalg.det(gradient)
    cofactor = volume * np.linalg.inv(gradient).T
    stress = shear * gradient + (bulk * (volume - 1) - shear) * cofactor
    a, b, c = np.moveaxis(mesh.nodes[mesh.boundary], 1, 0)
    traction = np.cross(b - a, c - a) / 6 @ stress.T
    expected = np.zeros_like(mesh.nodes)
    for corner in range(3):
        np.add.at(expected, mesh.boundary[:, corner], traction)
    assert abs(forces.T - expected).max() < 1e-10 * abs(expected).max()


@BOTH
def test_at_rest_it_is_linear_elasticity_with_averaged_pressure(mesh):
    materials = mixed()
    tissue = NeoHookean(mesh, materials, np.float64)
    split = volumetric_split(materials)
    gradients = shape_gradients(mesh)
    # Hooke's law with lambda = element - mu, and C d d' with d the mean divergence around a node.
    expected = np.zeros((3, COUNT, 3, COUNT))
    divergence = np.zeros((len(mesh.tetrahedra), 3, COUNT))
    for t, nodes in enumerate(mesh.tetrahedra):
        shear, volume = split.shear[t], mesh.volumes[t]
        divergence[t][:, nodes] = gradients[t].T
        for a in range(4):
            for b in range(4):
                ga, gb = gradients[t, a], gradients[t, b]
                block = (split.element[t] - shear) * np.outer(ga, gb) + shear * np.outer(gb, ga)
                block += shear * ga @ gb * np.eye(3)
                expected[:, nodes[a], :, nodes[b]] += volume * block
    weight = split.nodal * mesh.volumes / 4
    for node in range(COUNT):
        around = np.flatnonzero((mesh.tetrahedra == node).any(axis=1))
        total = weight[around].sum()
        if total > 0:
            mean = np.tensordot(weight[around], divergence[around], 1) / total
            expected += total * np.multiply.outer(mean, mean)
    expected = expected.reshape(3 * COUNT, 3 * COUNT)
    assert abs(tangent_matrix(tissue) - expected).max() < 1e-13 * abs(expected).max()
    diagonal = np.einsum("inin->in", expected.reshape(3, COUNT, 3, COUNT))
    np.testing.assert_allclose(tissue.diagonal_blocks()[[0, 3, 5]], diagonal, rtol=1e-12)


@BOTH
def test_diagonal_blocks_are_those_of_the_tangent(mesh):
    tissue = NeoHookean(mesh, uniform(0.3), np.float64)
    tissue.linearise(random_field(5e-3))
    matrix = tangent_matrix(tissue).reshape(3, COUNT, 3, COUNT)
    expected = np.einsum("injn->ijn", matrix)[[0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    assert abs(tissue.diagonal_blocks() - expected).max() < 1e-12 * abs(expected).max()


@given(seed=st.integers(0, 2**32 - 1), size=st.floats(0.0, 0.1))
@settings(max_examples=25, deadline=None)
def test_cells_are_five_tetrahedra(seed, size):
    assert_cells_are_tetrahedra(mixed(), size, seed)
    displacement = random_field(size, seed)
    ratios = np.linalg.det(deformation_gradients(CELLS, displacement))
    for mesh in (CELLS, TETRAHEDRA):
        tissue = NeoHookean(mesh, mixed(), np.float64)
        assert tissue.smallest_volume_ratio(displacement) == pytest.approx(ratios.min(), abs=1e-9)
        assert tissue.count_inverted(displacement) == (ratios <= 0).sum()


@given(seed=st.integers(0, 2**32 - 1), size=st.floats(0.0, 0.05), ratio=st.floats(0.0, 0.499))
@settings(max_examples=15, deadline=None)
def test_tangent_is_symmetric_and_at_rest_has_no_negative_eigenvalue(seed, size, ratio):
    mesh = box_mesh([0.0, 0.01, 0.03], [0.0, 0.02], [0.0, 0.01])
    tissue = NeoHookean(mesh, uniform(ratio, mesh), np.float64)
    eigenvalues = np.linalg.eigvalsh(tangent_matrix(tissue, len(mesh.nodes)))
    assert eigenvalues[0] > -1e-12 * eigenvalues[-1]
    tissue.linearise(random_field(size, seed, mesh))
    exact = tangent_matrix(tissue, len(mesh.nodes))
    assert abs(exact - exact.T).max() < 1e-13 * abs(exact).max()


@pytest.mark.slow
@BOTH
@pytest.mark.parametrize("size", [1e-8, 1e-5, 1e-3, 1e-2])
def test_single_precision_keeps_the_forces_to_a_millionth(mesh, size):
    single = NeoHookean(mesh, uniform(0.45))
    double = NeoHookean(mesh, uniform(0.45), np.float64)
    displacement = random_field(size).astype(np.float32)
    change = random_field(1.0, 2).astype(np.float32)

    def near(got, expected):
        assert got.dtype == np.float32
        assert np.linalg.norm(got - expected) < 1e-6 * np.linalg.norm(expected)

    near(single.compute_forces(displacement), double.compute_forces(displacement.astype(float)))
    single.linearise(displacement)
    double.linearise(displacement.astype(float))
    near(single.tangent_product(change), double.tangent_product(change.astype(float)))


@pytest.mark.slow
@pytest.mark.parametrize("modulus", [1.0, 1e12])
@pytest.mark.parametrize("length", [1e-3, 1.0])
@pytest.mark.parametrize("boxed", [True, False])
def test_single_precision_serves_every_size_and_stiffness(modulus, length, boxed):
    mesh = box_mesh(*([0.0, length / 2, length],) * 3)
    mesh = mesh if boxed else TetrahedralMesh(mesh.nodes, mesh.tetrahedra)
    displacement = random_field(0.05 * length, mesh=mesh).astype(np.float32)
    materials = uniform(0.49, mesh, modulus)
    expected = NeoHookean(mesh, materials, np.float64).compute_forces(displacement.astype(float))
    got = NeoHookean(mesh, materials).compute_forces(displacement)
    assert np.linalg.norm(got - expected) < 1e-6 * np.linalg.norm(expected)


@pytest.mark.slow
def test_a_contrast_of_1e9_leaves_the_soft_side_its_digits():
    mesh = box_mesh([0.0, 0.01, 0.02, 0.03], [0.0, 0.01], [0.0, 0.01])
    count = len(mesh.tetrahedra)
    soft = np.arange(count) < 10
    materials = TissueMaterials(
        np.where(soft, 1e3, 1e12), np.where(soft, 0.49, 0.2), np.full(count, 1000.0)
    )
    displacement = random_field(1e-4, mesh=mesh)
    got = NeoHookean(mesh, materials, np.float32).compute_forces(displacement.astype(np.float32))
    expected = NeoHookean(mesh, materials, np.float64).compute_forces(displacement)
    free = mesh.nodes[:, 0] < 0.015  # belongs to soft tetrahedra only
    for side in (free, ~free):
        error = np.linalg.norm((got - expected)[:, side])
        assert error < 2e-6 * np.linalg.norm(expected[:, side])


@pytest.mark.parametrize("ratio", [0.0, 0.3, 0.4])
def test_scikit_fem_has_the_same_forces(ratio):
    mesh = irregular(CELLS, 1e-3)
    shear = 10e3 / (2 * (1 + ratio))
    bulk = shear / (1 - 2 * ratio)

    @LinearForm
    def resistance(v, w):
        deformation = grad(w["displacement"]) + identity(grad(w["displacement"]))
        volume = det(deformation)
        cofactor = volume * transpose(inv(deformation))
        missing = np.maximum(0.25 - volume, 0.0)  # crowded below a quarter of the volume
        crowding = -(missing**2) * (2 * volume + 0.25) / (0.75 * volume**2)
        pressure = bulk * (volume - 1) + 5 * shear * crowding
        return ddot(shear * deformation + (pressure - shear) * cofactor, grad(v))

    basis = Basis(
        MeshTet(mesh.nodes.T, mesh.tetrahedra.T.astype(np.int64)), ElementVector(ElementTetP1())
    )
    displacement = random_field(1e-3)
    field = np.zeros(basis.N)
    for axis in range(3):
        field[basis.nodal_dofs[axis]] = displacement[axis]
    expected = resistance.assemble(basis, displacement=basis.interpolate(field))
    got = NeoHookean(mesh, uniform(ratio), np.float64).compute_forces(displacement)
    for axis in range(3):
        error = got[axis] - expected[basis.nodal_dofs[axis]]
        assert abs(error).max() < 1e-12 * abs(expected).max()


def test_one_tetrahedron_pulled_by_one_corner():
    mesh = TetrahedralMesh(np.vstack([np.zeros(3), np.eye(3)]) * 0.1, np.array([[0, 1, 2, 3]]))
    tissue = NeoHookean(mesh, uniform(0.25, mesh, 2.5), np.float64)  # mu 1 Pa, lambda + mu 2 Pa
    displacement = np.zeros((3, 4))
    displacement[2, 3] = 0.05
    # F = diag(1, 1, 1.5), J = 1.5, p = 1 Pa, cof F = diag(1.5, 1.5, 1): P = diag(1, 1, 1.5) Pa.
    area = 0.1**2 / 6
    expected = area * np.array([[-1, 1, 0, 0], [-1, 0, 1, 0], [-1.5, 0, 0, 1.5]])
    np.testing.assert_allclose(tissue.compute_forces(displacement), expected, atol=1e-16)
    # mu/2 (4.25 - 3) - mu 0.5 + (lambda + mu)/2 0.25
    assert tissue.compute_energy(displacement) == pytest.approx(0.1**3 / 6 * 0.375, rel=1e-12)
    assert tissue.smallest_volume_ratio(displacement) == pytest.approx(1.5)
    displacement[2, 3] = -0.15
    assert tissue.smallest_volume_ratio(displacement) == pytest.approx(-0.5)
    assert tissue.count_inverted(displacement) == 1


@pytest.mark.slow
@BOTH
def test_a_field_that_is_not_finite_is_seen_and_leaves_nothing_behind(mesh):
    tissue = NeoHookean(mesh, uniform(0.49))
    displacement = random_field(1e-4).astype(np.float32)
    before = tissue.compute_forces(displacement), tissue.compute_energy(displacement)
    broken = displacement.copy()
    broken[1, -1] = np.nan
    assert np.isnan(tissue.compute_forces(broken)).any()
    assert np.isnan(tissue.compute_energy(broken))
    assert np.isnan(tissue.smallest_volume_ratio(broken))
    assert tissue.count_inverted(broken) > 0
    assert tissue.compute_forces(displacement).tobytes() == before[0].tobytes()
    assert tissue.compute_energy(displacement) == before[1]
