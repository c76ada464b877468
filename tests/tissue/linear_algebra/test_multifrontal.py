"""The fields of unit forces against a sparse direct solver (SuperLU), and the stiffness's laws."""

import numpy as np
import pytest
from scipy.sparse.linalg import splu
from tissue_block import block, block_mesh, irregular

from us_sim.errors import SolverError
from us_sim.tissue.elasticity.linear_tetrahedra import assemble_averaged_pressure
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import TissueMaterials, make_uniform_materials
from us_sim.tissue.linear_algebra.multifrontal import eliminate


def sparse_fields(system, fixed, nodes):
    """(N, 3, 3K) m/N, by SuperLU."""
    free = np.repeat(~fixed, 3)
    unknowns = (3 * nodes[:, None] + np.arange(3)).ravel()
    loads = np.zeros((len(free), len(unknowns)))
    loads[unknowns, np.arange(len(unknowns))] = 1.0
    fields = np.zeros_like(loads)
    fields[free] = splu(system.stiffness[free][:, free].tocsc()).solve(loads[free])
    return fields.reshape(len(fixed), 3, -1)


def mixed(mesh):
    """Moduli over four decades; Poisson's ratios with and without averaged pressures."""
    random = np.random.default_rng(1)
    count = len(mesh.tetrahedra)
    return TissueMaterials(
        10 ** random.uniform(3, 7, count), random.uniform(-0.2, 0.4999, count), np.ones(count)
    )


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [0.0, 0.3, 0.45, 0.499, None])
def test_agrees_with_a_sparse_solver(ratio):
    mesh = block_mesh((9, 6, 7))
    model = block((9, 6, 7))
    materials = mixed(mesh) if ratio is None else make_uniform_materials(mesh, Material(1e4, ratio))
    system = assemble_averaged_pressure(mesh, materials)
    loaded = np.random.default_rng(0).permutation(model.movable_contact_nodes)[:30]
    eliminated = eliminate(mesh, system, model.fixed, loaded)
    found = np.concatenate(
        [eliminated.compute_fields(loaded[:7]), eliminated.compute_fields(loaded[7:])], axis=2
    )

    expected = sparse_fields(system, model.fixed, loaded)
    np.testing.assert_allclose(found, expected, atol=1e-8 * abs(expected).max())


@pytest.mark.slow
def test_single_precision_changes_little():
    model = block((9, 6, 7))
    system = assemble_averaged_pressure(model.mesh, model.materials)
    nodes = model.movable_contact_nodes
    found = eliminate(model.mesh, system, model.fixed, nodes, np.float32).compute_fields(nodes[:5])
    expected = sparse_fields(system, model.fixed, nodes[:5])
    np.testing.assert_allclose(found, expected, atol=1e-5 * abs(expected).max())


@pytest.mark.parametrize("ratio", [0.3, 0.45, 0.4999])
def test_constant_strain_patch(ratio):
    mesh = irregular(block_mesh((6, 5, 5)))
    gradient = np.random.default_rng(2).uniform(-0.1, 0.1, (3, 3))
    exact = (mesh.nodes @ gradient.T).ravel()
    matrix = assemble_averaged_pressure(
        mesh, make_uniform_materials(mesh, Material(10e3, ratio))
    ).stiffness
    free = np.repeat(~np.isin(np.arange(len(mesh.nodes)), mesh.boundary), 3)
    load = -(matrix[free][:, ~free] @ exact[~free])
    found = splu(matrix[free][:, free].tocsc()).solve(load)
    assert abs(found - exact[free]).max() <= 1e-10 * abs(exact).max()


def test_a_stiffness_that_is_not_positive_definite_is_refused():
    mesh = block_mesh((4, 4, 4))
    system = assemble_averaged_pressure(mesh, make_uniform_materials(mesh, Material(10e3, 0.3)))
    nothing = np.zeros(len(mesh.nodes), dtype=bool)
    with pytest.raises(SolverError, match="positive definite"):
        eliminate(mesh, system, nothing, np.array([0], np.int32))
