"""The points of a surface: what they share with its nodes, and what the two agree on."""

import functools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skfem import ElementTriP1, InteriorBasis, LinearForm, MeshTri
from tissue_block import block

from us_sim.tissue.contact.surface_points import (
    SurfacePoints,
    add_springs,
    add_turns,
    make_surface_contact,
)
from us_sim.tissue.elasticity.linear_tetrahedra import nodal_shear_stiffness
from us_sim.tissue.model import TissueModel

MODEL = block((5, 4, 3))
COUNT = len(MODEL.mesh.nodes)
SIZES = st.sampled_from([0.01, 0.02, 0.05, 1.0])  # m, of a mesh whose sides are 33 to 60 mm
seeds = st.integers(0, 2**32 - 1)
EXAMPLES = settings(deadline=None, max_examples=30)


@functools.cache
def points_of(size):
    return SurfacePoints(MODEL, size)


def top_triangles(model):
    mesh = model.mesh
    return mesh.boundary[np.isin(mesh.boundary, model.contact_nodes).all(axis=1)]


def with_contact_nodes(nodes):
    nodes = np.asarray(nodes, dtype=int)
    return TissueModel(MODEL.mesh, MODEL.materials, MODEL.fixed, MODEL.collider, nodes)


@pytest.mark.parametrize("size", [0.01, 0.02, 0.05, 1.0])
def test_points_stand_for_equal_parts_no_longer_than_the_size(size):
    points, corners = points_of(size), MODEL.mesh.nodes[top_triangles(MODEL)]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    parts = np.ceil(longest / size - 1e-9)
    assert (longest / parts <= size * (1 + 1e-9)).all() or size == 1.0
    assert len(points.rest) == (parts**2).sum() + 20  # and one at each node
    np.testing.assert_allclose(points.weights.sum(axis=1), 1.0)
    assert points.weights.min() >= 0.0
    # The top of the block is 0.2 by 0.1 m, where z is 0.
    assert points.sum_at_nodes(points.spread_to_points(np.ones(COUNT))).sum() == pytest.approx(
        5 * 4
    )
    np.testing.assert_array_equal(points.rest[:, 2], 0.0)


@EXAMPLES
@given(SIZES, seeds)
def test_what_is_spread_has_the_same_sum(size, seed):
    values = np.random.default_rng(seed).normal(size=COUNT)
    spread = points_of(size).spread_to_points(values)
    assert spread.sum() == pytest.approx(values[MODEL.contact_nodes].sum(), abs=1e-12)


@pytest.mark.parametrize("size", [0.01, 0.05, 1.0])
def test_a_uniform_pressure_gives_the_nodal_forces_of_linear_shape_functions(size):
    points, triangles = points_of(size), top_triangles(MODEL)
    nodes, local = np.unique(triangles, return_inverse=True)
    mesh = MeshTri(MODEL.mesh.nodes[nodes, :2].T, local.reshape(-1, 3).T)
    load = LinearForm(lambda v, _: 1.0 * v)
    exact = np.zeros(COUNT)
    exact[nodes] = load.assemble(InteriorBasis(mesh, ElementTriP1()))
    triangle = MODEL.mesh.nodes[points.nodes]
    normal = np.cross(triangle[:, 1] - triangle[:, 0], triangle[:, 2] - triangle[:, 0])
    whole = 0.5 * np.linalg.norm(normal, axis=1)
    _, which, count = np.unique(points.nodes, axis=0, return_inverse=True, return_counts=True)
    pressure = whole / count[which.ravel()]  # of 1 Pa, on equal parts
    np.testing.assert_allclose(points.sum_at_nodes(pressure), exact, atol=1e-15)


@EXAMPLES
@given(SIZES, seeds)
def test_force_and_torque_of_the_points_are_those_of_the_nodes(size, seed):
    points, rng = points_of(size), np.random.default_rng(seed)
    displacement, force = rng.normal(size=(3, COUNT)), rng.normal(size=points.rest.shape)
    places = points.rest + points.interpolate_field(displacement)
    nodes, pushes = MODEL.mesh.nodes + displacement.T, np.zeros((3, COUNT))
    points.add_to_nodes(force, pushes, np.arange(len(force)))
    np.testing.assert_allclose(pushes.sum(axis=1), force.sum(axis=0), atol=1e-9)
    torque = np.cross(nodes, pushes.T).sum(axis=0)
    np.testing.assert_allclose(torque, np.cross(places, force).sum(axis=0), atol=1e-9)
    np.testing.assert_allclose(points.sum_at_nodes(force), pushes.T, atol=1e-12)


@EXAMPLES
@given(SIZES, seeds)
def test_moving_and_adding_are_adjoint_for_some_points_too(size, seed):
    points, rng = points_of(size), np.random.default_rng(seed)
    some = np.flatnonzero(rng.random(len(points.rest)) < 0.5)
    field, vectors = rng.normal(size=(3, COUNT)), rng.normal(size=points.rest.shape)
    moved, image = points.interpolate_field(field, some), np.zeros((3, COUNT))
    points.add_to_nodes(vectors, image, some)
    assert (moved * vectors).sum() == pytest.approx((field * image).sum())
    assert not np.delete(moved, some, axis=0).any()


@EXAMPLES
@given(seeds)
def test_springs_and_turns_are_dense_matrices_of_the_points(seed):
    points, rng = points_of(0.05), np.random.default_rng(seed)
    active = rng.choice(len(points.rest), 20, replace=False)
    directions = rng.normal(size=(20, 3))
    stiffness, turn = rng.uniform(0.0, 1e4, 20), rng.normal(size=(20, 3, 3))
    field = rng.normal(size=(3, COUNT))
    moved = points.interpolate_field(field)[active]
    own = points.nodes[active], points.weights[active]
    for tensors, add, given_ in [
        (np.einsum("k,ki,kj->kij", stiffness, directions, directions), add_springs, directions),
        (turn, add_turns, turn),
    ]:
        forces = np.zeros_like(points.rest)
        forces[active] = np.einsum("kij,kj->ki", tensors, moved)
        expected, image = np.ones((3, COUNT)), np.ones((3, COUNT))
        points.add_to_nodes(forces, expected, active)
        add(*own, given_, *([stiffness] if add is add_springs else []), field, image)
        np.testing.assert_allclose(image, expected, atol=1e-9 * abs(expected).max())


@EXAMPLES
@given(seeds)
def test_lumped_springs_are_a_little_less_than_the_tensors_of_the_nodes(seed):
    points, rng = points_of(0.05), np.random.default_rng(seed)
    active = rng.choice(len(points.rest), 20, replace=False)
    directions = rng.normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    stiffness = rng.uniform(1.0, 1e4, 20)
    tensors, lumped = np.zeros((2, COUNT, 3, 3))
    for p, n, k in zip(active, directions, stiffness, strict=True):
        for node, weight in zip(points.nodes[p], points.weights[p], strict=True):
            tensors[node] += 0.5 * k * weight * np.outer(n, n)
    nodes, along, firm = points.lump_springs(active, directions, stiffness)
    for node, n, k in zip(nodes, along, firm, strict=True):
        lumped[node] += k * np.outer(n, n)
    assert (np.diff(np.flatnonzero(np.diff(nodes, prepend=-1))) <= 3).all()  # of a node in a row
    for node in range(COUNT):
        left = np.linalg.eigvalsh(tensors[node] - lumped[node])
        size = np.trace(tensors[node])
        assert left.min() >= -1e-9 * size
        assert left.sum() <= 0.4 * size + 1e-12  # two that are weaker than a fifth of all


def test_a_node_that_is_no_triangles_is_a_point_by_itself():
    lone = MODEL.contact_nodes[7]
    points = SurfacePoints(with_contact_nodes([lone]), 0.01)
    np.testing.assert_array_equal(points.rest, MODEL.mesh.nodes[[lone]])
    values = np.arange(COUNT, dtype=float)
    np.testing.assert_allclose(points.spread_to_points(values), [lone])
    np.testing.assert_allclose(points.sum_at_nodes(np.array([2.0]))[lone], 2.0)
    gap, normal, softness = points.merge_springs(
        np.array([50.0]), np.array([-0.001]), np.array([[0.0, 0.6, 0.8]])
    )
    assert gap[lone] == pytest.approx(-0.001)
    assert softness[lone] == pytest.approx(1 / 50)
    np.testing.assert_allclose(normal[lone], [0.0, 0.6, 0.8])
    assert np.isinf(np.delete(gap, lone)).all()


def test_triangles_that_cannot_move_at_all_have_no_points():
    everything = np.unique(MODEL.mesh.boundary)
    some = SurfacePoints(with_contact_nodes(everything), 1.0)
    model = with_contact_nodes(everything)
    bottom = model.fixed[model.mesh.boundary].all(axis=1)
    assert bottom.any()
    inside = some.weights.max(axis=1) < 1.0
    assert inside.sum() == (~bottom).sum()
    assert not model.fixed[some.nodes].all(axis=1).any()
    # Nor have fixed nodes by themselves.
    assert len(SurfacePoints(with_contact_nodes(np.flatnonzero(model.fixed)), 1.0).rest) == 0


def test_the_springs_of_a_contact_are_as_firm_as_the_tissues_shear():
    points, contact = make_surface_contact(MODEL)
    own = nodal_shear_stiffness(MODEL.mesh, MODEL.materials)
    assert contact.stiffness.sum() == pytest.approx(40 * own[MODEL.contact_nodes].sum())
    assert len(contact.gap) == len(points.rest)
