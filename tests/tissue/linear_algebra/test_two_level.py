"""Conjugate gradients with springs, and what preconditions them, against dense solves."""

import functools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tissue_block import block

from us_sim.tissue.elasticity.neo_hookean import NeoHookean
from us_sim.tissue.linear_algebra.two_level import CoarseGrid, TwoLevel, solve_conjugate_gradients

MODEL = block((7, 5, 5))
COUNT = len(MODEL.mesh.nodes)
FIXED = np.flatnonzero(MODEL.fixed)
GRIDS = pytest.mark.parametrize("coarse", [False, True])

springs_at = st.lists(
    st.tuples(
        st.integers(0, len(MODEL.movable_contact_nodes) - 1),
        st.floats(-1, 1),
        st.floats(-1, 1),
        st.floats(0.0, 1e6),
    ),
    max_size=12,
    unique_by=lambda spring: spring[0],
)


@functools.cache
def tissue():
    return NeoHookean(MODEL.mesh, MODEL.materials, np.float64)


def grid(dtype=np.float64):
    return CoarseGrid(MODEL.mesh, MODEL.fixed, tissue().tangent_product, dtype)


def two_level(coarse, springs, dtype=np.float64, made=None):
    """Prepared, and its springs: nodes, normals, stiffness in N/m."""
    made = made or TwoLevel(grid(dtype) if coarse else None, FIXED, 1.0)
    nodes = MODEL.movable_contact_nodes[[s[0] for s in springs]].astype(np.int64)
    normals = np.array([[s[1], s[2], 1.0] for s in springs]).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    stiffness = np.array([s[3] for s in springs], dtype=float)
    made.set_matrix(tissue().diagonal_blocks().astype(dtype), nodes, normals, stiffness)
    return made, nodes, normals, stiffness


def dense(function, count=COUNT):
    columns = []
    for unit in np.eye(3 * count).reshape(-1, 3, count):
        out = np.empty((3, count))
        function(np.ascontiguousarray(unit), out)
        columns.append(out.ravel())
    return np.array(columns).T


@functools.cache
def stiffness_matrix():
    return dense(tissue().tangent_product)


MOVABLE = np.repeat(~MODEL.fixed[None], 3, axis=0).ravel()


def with_springs(nodes, normals, stiffness):
    whole = stiffness_matrix().copy()
    for node, normal, k in zip(nodes, normals, stiffness, strict=True):
        rows = node + COUNT * np.arange(3)
        whole[np.ix_(rows, rows)] += k * np.outer(normal, normal)
    return whole


def add_springs(nodes, normals, stiffness):
    """A function that adds the forces of such springs."""

    def add(field, image):
        for node, normal, k in zip(nodes, normals, stiffness, strict=True):
            image[:, node] += (k * (normal @ field[:, node]) * normal).astype(image.dtype)

    return add


SPRINGS = [(0, 0.3, -0.2, 1e4), (3, 0.0, 0.0, 1e6), (11, -1.0, 0.5, 1.0), (5, 0.0, 0.1, 0.0)]


@GRIDS
def test_the_solution_is_that_of_a_dense_solve(coarse):
    made, *springs = two_level(coarse, SPRINGS)
    force = np.random.default_rng(0).normal(size=(3, COUNT))
    force[:, FIXED] = 0.0
    solved = solve_conjugate_gradients(
        tissue().tangent_product, made, force.copy(), 500, 1e-12, add_springs(*springs)
    )
    whole = with_springs(*springs)[np.ix_(MOVABLE, MOVABLE)]
    expected = np.zeros(3 * COUNT)
    expected[MOVABLE] = np.linalg.solve(whole, force.ravel()[MOVABLE])
    assert not solved.curved
    np.testing.assert_allclose(solved.solution.ravel(), expected, atol=1e-9 * abs(expected).max())
    image = tissue().tangent_product(solved.solution)
    np.testing.assert_allclose(solved.image, image, atol=1e-9 * abs(image).max())


def test_the_coarse_level_saves_iterations_with_and_without_springs():
    force = np.zeros((3, COUNT))
    force[2, MODEL.movable_contact_nodes] = 1.0
    firm = [(i, 0.0, 0.0, 1e4) for i in range(12)]
    counts = []
    for coarse in (False, True):
        for springs in ([], firm):
            made, *given_springs = two_level(coarse, springs)
            add = add_springs(*given_springs)
            solved = solve_conjugate_gradients(
                tissue().tangent_product, made, force.copy(), 500, 1e-6, add
            )
            counts.append(solved.iterations)
    assert counts[2] < 0.8 * counts[0]
    assert counts[3] < 0.8 * counts[1]


def test_negative_curvature_ends_it_with_what_came_before():
    made, *_ = two_level(False, [])
    force = np.random.default_rng(1).normal(size=(3, COUNT))
    force[:, FIXED] = 0.0
    shift = 2e-2 * np.linalg.eigvalsh(stiffness_matrix())[-1]

    def indefinite(field, image):
        tissue().tangent_product(field, image)
        image -= shift * field

    solved = solve_conjugate_gradients(indefinite, made, force.copy(), 500, 1e-12)
    assert solved.curved
    direction, image = solved.direction, np.empty_like(force)
    indefinite(direction, image)
    assert np.vdot(direction, image) <= 0.0
    assert np.vdot(direction, force) > 0.0  # and it leads down
    indefinite(solved.solution, image)
    decrease = np.vdot(solved.solution, 0.5 * image - force)
    assert decrease < 0.0 or not solved.solution.any()


@settings(max_examples=25, deadline=None)
@given(springs_at, st.booleans(), st.integers(0, 2**32 - 1))
def test_the_preconditioner_is_symmetric_and_positive(springs, coarse, seed):
    made, *_ = two_level(coarse, springs, made=kept(coarse))
    a, b = np.random.default_rng(seed).normal(size=(2, 3, COUNT))
    a[:, FIXED] = b[:, FIXED] = 0.0
    to_a, to_b = np.empty_like(a), np.empty_like(b)
    made.apply(a, to_a)
    made.apply(b, to_b)
    assert np.vdot(a, to_a) > 0.0
    size = np.sqrt(np.vdot(a, to_a) * np.vdot(b, to_b))
    assert np.vdot(a, to_b) == pytest.approx(np.vdot(b, to_a), abs=1e-9 * size)
    assert not to_a[:, FIXED].any()


@functools.cache
def kept(coarse):
    return TwoLevel(grid() if coarse else None, FIXED, 1.0)
