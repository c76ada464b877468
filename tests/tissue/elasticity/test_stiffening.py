"""Tissue that stiffens: against closed forms, Yeoh's law, finite differences, and its limits."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from neo_hookean_meshes import BOTH, CELLS, assert_cells_are_tetrahedra, assert_slopes, random_field
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from tissue_block import at, block, block_mesh, pressed

from us_sim.errors import MaterialError
from us_sim.evaluation.independent_forces import neo_hookean_forces
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import (
    LabelFractions,
    TissueMaterials,
    average_over_labels,
    uniform_material,
)
from us_sim.tissue.elasticity.neo_hookean import NeoHookean
from us_sim.tissue.solvers.fem_nonlinear import FemNonlinear

SOFT = Material(10e3, 0.45)
STIFFENING = Material(10e3, 0.45, stiffening=0.7)


def stiffening(mesh=CELLS, seed=3):
    """Tetrahedra of several moduli and stiffenings, some without."""
    rng = np.random.default_rng(seed)
    count = len(mesh.tetrahedra)
    return TissueMaterials(
        10 ** rng.uniform(3, 5, count),
        rng.choice([0.0, 0.3, 0.45, 0.499], count),
        np.full(count, 1000.0),
        stiffening=rng.choice([0.0, 0.0, 0.2, 1.0, 20.0], count),
    )


def nominal_stress(stretch, across, material):
    """Pa, of a block stretched along z by ``stretch`` and across by ``across``."""
    mesh = block_mesh((3, 3, 3))
    tissue = NeoHookean(mesh, uniform_material(mesh, material), np.float64)
    moved = mesh.nodes.T * np.array([[across - 1], [across - 1], [stretch - 1]])
    forces = tissue.forces(np.ascontiguousarray(moved))
    side, top = mesh.nodes[:, 0] > 0.1 - 1e-9, mesh.nodes[:, 2] > 0.1 - 1e-9
    return forces[2, top].sum() / (0.2 * 0.1), forces[0, side].sum() / (0.1 * 0.1)


@pytest.mark.parametrize("stretch", [0.4, 0.6, 0.9, 1.2, 1.8])
def test_a_block_that_keeps_its_volume_has_the_stress_of_yeohs_third_term(stretch):
    # sigma_z - sigma_x = 2 (dW/dI1) (stretch^2 - 1/stretch), W = C10 (I1 - 3) + C30 (I1 - 3)^3
    material = Material(10e3, 0.3, stiffening=0.7)
    along, across = nominal_stress(stretch, stretch**-0.5, material)
    shear = 10e3 / 2.6
    first, third = shear / 2, shear * 0.7 / 24
    invariant = stretch**2 + 2 / stretch - 3
    slope = first + 3 * third * invariant**2
    expected = 2 * slope * (stretch**2 - 1 / stretch)
    assert along * stretch - across * stretch**-0.5 == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("stretch", [0.35, 0.5, 1.6])
def test_a_nearly_incompressible_block_that_is_free_across_has_the_uniaxial_stress(stretch):
    material = Material(10e3, 0.4999, stiffening=0.7)

    def side(across):
        return nominal_stress(stretch, across, material)[1]

    across = brentq(side, 0.9 * stretch**-0.5, 1.1 * stretch**-0.5)
    growth = 1 + 0.7 * ((stretch**2 + 2 / stretch - 3) / 2) ** 2
    expected = 10e3 / 3 * growth * (stretch - stretch**-2)
    assert nominal_stress(stretch, across, material)[0] == pytest.approx(
        expected, rel=4e-3
    )  # it is compressible


@pytest.mark.parametrize("size", [1e-4, 2e-3, 0.02])
@BOTH
def test_forces_and_tangent_are_slopes_also_where_tissue_is_inverted(mesh, size):
    tissue = NeoHookean(mesh, stiffening(), np.float64)
    assert_slopes(tissue, size)
    one, other = random_field(1.0, 5), random_field(1.0, 6)
    across = np.vdot(one, tissue.tangent_product(other))
    size = np.linalg.norm(one) * np.linalg.norm(tissue.tangent_product(other))
    assert across == pytest.approx(np.vdot(other, tissue.tangent_product(one)), abs=1e-12 * size)
    if tissue.inverted(random_field(0.02)):
        assert np.isfinite(tissue.forces(random_field(0.02))).all()


@BOTH
def test_forces_are_those_of_independent_equations(mesh):
    tissue = NeoHookean(mesh, stiffening(), np.float64)
    for size in (1e-5, 1e-3, 0.01):
        field = random_field(size)
        expected = neo_hookean_forces(mesh, stiffening(), field.T).T
        error = np.linalg.norm(tissue.forces(field) - expected)
        # Kernels round a fiftieth, below which a wall is simpler, to single precision.
        assert error < (1e-11 if size < 0.005 else 1e-6) * np.linalg.norm(expected)


@given(st.integers(0, 10**6), st.floats(1e-5, 0.01))
@settings(max_examples=10)
def test_cells_are_their_tetrahedra(seed, size):
    assert_cells_are_tetrahedra(stiffening(seed=seed), size, seed)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_blocks_of_the_tangent_are_its_own(dtype):
    mesh, count = CELLS, len(CELLS.nodes)
    # Without averages around nodes, of which the blocks count those at rest.
    materials = uniform_material(mesh, Material(10e3, 0.3, stiffening=5.0))
    tissue = NeoHookean(mesh, materials, dtype)
    tissue.linearise(random_field(0.003).astype(dtype))
    blocks = tissue.diagonal_blocks()
    for node in range(count):
        for axis, entries in enumerate([(0, 1, 2), (1, 3, 4), (2, 4, 5)]):
            unit = np.zeros((3, count), dtype)
            unit[axis, node] = 1.0
            column = tissue.tangent_product(unit)[:, node]
            expected = blocks[list(entries), node]
            assert column == pytest.approx(expected, abs=1e-4 * float(abs(expected).max()))


def test_a_turn_changes_no_energy_and_turns_the_forces():
    mesh = CELLS
    tissue = NeoHookean(mesh, stiffening(), np.float64)
    field, turn = random_field(0.003), Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    turned = turn @ (mesh.nodes.T + field) - mesh.nodes.T
    assert tissue.energy(turned) == pytest.approx(tissue.energy(field), rel=1e-11)
    error = np.linalg.norm(tissue.forces(turned) - turn @ tissue.forces(field))
    assert error < 1e-10 * np.linalg.norm(tissue.forces(field))


def test_at_rest_it_is_the_same_material():
    change = random_field(1.0)
    plain, stiff = (
        NeoHookean(CELLS, uniform_material(CELLS, material), np.float64)
        for material in (SOFT, STIFFENING)
    )
    assert np.array_equal(plain.tangent_product(change), stiff.tangent_product(change))


@given(
    st.lists(st.floats(-2.5, 2.5), min_size=9, max_size=9),
    st.integers(0, 10**6),
    st.floats(0.0, 100.0),
)
@settings(max_examples=60)
def test_the_stiffening_is_elliptic_at_any_deformation(entries, seed, constant):
    # Of one tetrahedron whose deformation changes by a rank-one matrix, the energy beyond the
    # neo-Hookean one never curves downwards (Legendre and Hadamard's condition).
    mesh = block_mesh((2, 2, 2))
    shape = np.array(entries).reshape(3, 3)
    rng = np.random.default_rng(seed)
    a, b = rng.normal(size=(2, 3))
    change = np.ascontiguousarray((mesh.nodes @ np.outer(b, a)).T)
    field = np.ascontiguousarray((mesh.nodes @ shape.T).T)
    curvature = []
    for stiffness in (0.0, constant):
        material = Material(1.0, 0.0, stiffening=stiffness)
        tissue = NeoHookean(mesh, uniform_material(mesh, material), np.float64)
        tissue.linearise(field)
        curvature.append(np.vdot(change, tissue.tangent_product(change)))
    assert curvature[1] - curvature[0] >= -1e-9 * (abs(curvature[0]) + abs(curvature[1]))


@pytest.mark.slow
def test_a_pressed_block_pushes_back_harder_the_deeper_the_more():
    soft, stiff = (
        FemNonlinear(block((17, 9, 9), materials=uniform_material(block_mesh((17, 9, 9)), each)))
        for each in (SOFT, Material(10e3, 0.45, stiffening=20.0))
    )
    ratios = []
    for depth in (0.005, 0.02, 0.035):
        forces = []
        for solver in (soft, stiff):
            deformation = pressed(solver, at(z=depth), 60)
            assert deformation.residual < 1e-3
            forces.append(-deformation.force[2])
        ratios.append(forces[1] / forces[0])
    assert 1.0 < ratios[0] < ratios[1] < ratios[2]
    assert ratios[0] < 1.02
    assert ratios[2] > 1.2


def test_labels_that_share_a_tetrahedron_stiffen_it_by_their_moduli():
    fractions = LabelFractions(np.array([1, 2], np.uint8), np.array([[0.25, 0.75], [1.0, 0.0]]))
    materials = {1: Material(30e3, stiffening=2.0), 2: Material(10e3)}
    made = average_over_labels(fractions, materials)
    assert made.stiffening == pytest.approx([0.25 * 30 * 2 / 15, 2.0])


@pytest.mark.parametrize("value", [-0.1, np.nan, np.inf])
def test_a_stiffening_that_would_soften_is_refused(value):
    with pytest.raises(MaterialError, match="stiffening"):
        Material(10e3, stiffening=value)
    ones = np.ones(2)
    with pytest.raises(MaterialError, match=r"stiffening of tetrahedron 1 .*soften"):
        TissueMaterials(ones, 0.3 * ones, ones, stiffening=np.array([0.0, value]))
