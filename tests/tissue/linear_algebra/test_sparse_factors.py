"""The factored stiffness against dense algebra, and as a preconditioner where others stall."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tissue_block import block, block_mesh

from us_sim.tissue.elasticity.linear_tetrahedra import shape_gradients
from us_sim.tissue.elasticity.material import Material
from us_sim.tissue.elasticity.materials import TissueMaterials, make_uniform_materials
from us_sim.tissue.elasticity.neo_hookean import NeoHookean
from us_sim.tissue.linear_algebra.sparse_factors import FactoredStiffness
from us_sim.tissue.linear_algebra.two_level import CoarseGrid, TwoLevel, solve_conjugate_gradients

NODES = (5, 4, 4)
MESH = block_mesh(NODES)
COUNT = len(MESH.nodes)
MODEL = block(NODES, materials=make_uniform_materials(MESH, Material(10e3, 0.0, 1000.0)))
FREE = np.flatnonzero(~MODEL.fixed)
NONE = (np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0))
FACTORED = FactoredStiffness(MODEL)


def solved(factored, force):
    out = np.empty_like(force)
    factored.apply(force, out)
    return out


def test_at_rest_it_solves_a_stiffness_of_its_own_shear_and_bulk():
    # The neo-Hookean energy's slope at rest without its geometric part:
    # mu grad u : grad v + (lambda + mu) div u div v.
    FACTORED.factor_at(np.zeros((3, COUNT)), *NONE)
    force = np.random.default_rng(0).normal(size=(3, COUNT))
    moved = solved(FACTORED, force)
    assert not moved[:, MODEL.fixed].any()
    shear, whole = 5e3, 5e3  # at a ratio of zero lambda is zero
    gradients = shape_gradients(MESH)
    matrix = np.zeros((COUNT, 3, COUNT, 3))
    for nodes, volume, g in zip(MESH.tetrahedra, MESH.volumes, gradients, strict=True):
        flat = volume * whole * np.multiply.outer(g, g)
        flat += volume * shear * np.einsum("ac,ij->aicj", g @ g.T, np.eye(3))
        matrix[np.ix_(nodes, range(3), nodes, range(3))] += flat
    own = matrix[FREE][:, :, FREE].reshape(3 * len(FREE), -1)
    left = own @ moved[:, FREE].T.ravel() - force[:, FREE].T.ravel()
    assert abs(left).max() < 1e-9 * abs(force).max()


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.05), st.floats(0.0, 1e7))
def test_it_is_symmetric_and_positive_even_where_tissue_is_inside_out(seed, size, firmness):
    rng = np.random.default_rng(seed)
    displacement = rng.normal(size=(3, COUNT)) * size
    displacement[:, MODEL.fixed] = 0.0
    nodes = MODEL.movable_contact_nodes[:4].astype(np.int64)
    normals = rng.normal(size=(4, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    FACTORED.factor_at(displacement, nodes, normals, np.full(4, firmness))
    a, b = rng.normal(size=(2, 3, COUNT))
    a[:, MODEL.fixed] = b[:, MODEL.fixed] = 0.0
    to_a, to_b = solved(FACTORED, a), solved(FACTORED, b)
    assert np.vdot(a, to_a) > 0.0
    scale = np.sqrt(np.vdot(a, to_a) * np.vdot(b, to_b))
    assert np.vdot(a, to_b) == pytest.approx(np.vdot(b, to_a), abs=1e-8 * scale)


def test_springs_add_their_stiffness():
    node = MODEL.movable_contact_nodes[:1].astype(np.int64)
    normal = np.array([[0.6, 0.0, 0.8]])
    force = np.zeros((3, COUNT))
    force[:, node[0]] = normal[0]
    FACTORED.factor_at(np.zeros((3, COUNT)), *NONE)
    soft = normal[0] @ solved(FACTORED, force)[:, node[0]]  # m/N
    FACTORED.factor_at(np.zeros((3, COUNT)), node, normal, np.array([700.0]))
    # In parallel to the tissue: 1 / (1 / soft + 700).
    assert normal[0] @ solved(FACTORED, force)[:, node[0]] == pytest.approx(
        soft / (1 + 700 * soft), rel=1e-9
    )


@pytest.mark.slow
def test_where_local_corrections_stall_it_takes_few_iterations():
    nodes = (9, 5, 9)
    mesh = block_mesh(nodes)
    layer = (mesh.nodes[mesh.tetrahedra].mean(axis=1)[:, 2] * 80).astype(int) % 2 == 0
    materials = TissueMaterials(
        np.where(layer, 1e3, 1e9), np.full(len(layer), 0.4), np.full(len(layer), 1e3)
    )
    model = block(nodes, materials=materials)
    tissue = NeoHookean(mesh, materials, np.float64)
    fixed = np.flatnonzero(model.fixed)
    grid = CoarseGrid(mesh, model.fixed, tissue.tangent_product, np.float64)
    local, factored = TwoLevel(grid, fixed, 1.0), FactoredStiffness(model)
    local.set_matrix(tissue.diagonal_blocks(), *NONE)
    factored.factor_at(np.zeros((3, len(mesh.nodes))), *NONE)
    force = np.zeros((3, len(mesh.nodes)))
    force[2, model.movable_contact_nodes] = 1.0
    counts = [
        solve_conjugate_gradients(tissue.tangent_product, each, force.copy(), 400, 1e-4).iterations
        for each in (local, factored)
    ]
    assert counts[1] < 40
    assert counts[0] > 3 * counts[1], counts
