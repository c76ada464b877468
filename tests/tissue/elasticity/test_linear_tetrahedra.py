"""The assembled stiffness against the laws of elasticity and against scikit-fem."""

import numpy as np
import pytest
from scipy.sparse.linalg import spsolve
from tissue_block import SOFT, block_mesh, irregular

from us_sim.errors import SolverError
from us_sim.tissue.elasticity.linear_tetrahedra import (
    assemble_stiffness,
    drop_fixed_nodes,
    require_held,
)
from us_sim.tissue.elasticity.materials import TissueMaterials, make_uniform_materials
from us_sim.tissue.mesh.tetrahedral_mesh import TetrahedralMesh, box_mesh

MESH = irregular(block_mesh((6, 5, 4)))
MATRIX = assemble_stiffness(MESH, make_uniform_materials(MESH, SOFT))
ON_BOUNDARY = np.isin(np.arange(len(MESH.nodes)), MESH.boundary)


@pytest.mark.parametrize("seed", range(3))
def test_constant_strain_patch(seed):
    gradient = np.random.default_rng(seed).uniform(-0.1, 0.1, (3, 3))
    exact = MESH.nodes @ gradient.T
    held = np.repeat(ON_BOUNDARY, 3)
    matrix = MATRIX.tocsr()
    found = np.zeros(exact.size)
    found[held] = exact.ravel()[held]
    found[~held] = spsolve(matrix[~held][:, ~held].tocsc(), -matrix[~held][:, held] @ found[held])
    np.testing.assert_allclose(found.reshape(-1, 3), exact, atol=1e-9 * abs(exact).max())

    strain = (gradient + gradient.T) / 2
    modulus, ratio = SOFT.young_modulus, SOFT.poisson_ratio
    first = modulus * ratio / ((1 + ratio) * (1 - 2 * ratio))
    second = modulus / (2 * (1 + ratio))
    density = first / 2 * np.trace(strain) ** 2 + second * (strain * strain).sum()
    assert found @ (MATRIX @ found) / 2 == pytest.approx(density * 0.002, rel=1e-9)


def test_held_nodes_are_removed_from_the_equations():
    fixed = MESH.nodes[:, 2] == 0.1
    free = np.repeat(~fixed, 3)
    expected = MATRIX.tocsr()[free][:, free].toarray()
    np.testing.assert_array_equal(drop_fixed_nodes(MATRIX, fixed).toarray(), expected)


def test_agrees_with_scikit_fem():
    skfem = pytest.importorskip("skfem")
    elasticity = pytest.importorskip("skfem.models.elasticity")
    random = np.random.default_rng(5)
    count = len(MESH.tetrahedra)
    materials = TissueMaterials(
        random.uniform(300, 2e4, count), random.uniform(0.1, 0.49, count), np.ones(count)
    )
    basis = skfem.Basis(
        skfem.MeshTet(MESH.nodes.T, MESH.tetrahedra.T.astype(np.int64)),
        skfem.ElementVector(skfem.ElementTetP1()),
    )
    first, second = elasticity.lame_parameters(materials.young_modulus, materials.poisson_ratio)
    theirs = elasticity.linear_elasticity(first[:, None], second[:, None]).assemble(basis)
    order = basis.nodal_dofs.T.ravel()
    expected = theirs.tocsr()[order][:, order].toarray()
    ours = assemble_stiffness(MESH, materials).toarray()
    np.testing.assert_allclose(ours, expected, atol=1e-10 * abs(expected).max())


@pytest.mark.parametrize(
    ("held", "words"),
    [
        ([], "has 0 fixed nodes"),
        ([0, 1], "has 2 fixed nodes"),
        ([0, 2, 4], "3 fixed nodes on one line"),
    ],
)
def test_tissue_that_can_move_as_a_whole_is_refused(held, words):
    mesh = box_mesh([0.0, 1.0], [0.0, 1.0], [0.0, 1.0, 2.0, 3.0, 4.0])
    with pytest.raises(SolverError, match=words):
        require_held(mesh, np.isin(np.arange(len(mesh.nodes)), held))


def test_every_part_must_be_held():
    one = box_mesh([0.0, 1.0], [0.0, 1.0], [0.0, 1.0])
    both = TetrahedralMesh(
        np.vstack([one.nodes, one.nodes + 5]), np.vstack([one.tetrahedra, one.tetrahedra + 8])
    )
    fixed = np.arange(16) < 4
    with pytest.raises(SolverError, match="around node 8 has 0 fixed nodes"):
        require_held(both, fixed)
    require_held(both, fixed | (np.arange(16) > 11))
