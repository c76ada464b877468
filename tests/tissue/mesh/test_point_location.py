"""Points are found where they were put, on any mesh, and their distance outside is Euclid's."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tissue_block import block_mesh

from us_sim.errors import MeshError
from us_sim.tissue.mesh.embedding import locate
from us_sim.tissue.mesh.file import read_mesh


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_barycentric_coordinates_give_the_point_back(seed):
    random = np.random.default_rng(seed)
    mesh = block_mesh((5, 4, 3))
    points = random.uniform([-0.15, -0.1, -0.05], [0.15, 0.1, 0.15], (200, 3))
    where = locate(mesh, points)
    np.testing.assert_allclose(where.weights.sum(axis=1), 1.0, atol=1e-12)
    corners = mesh.nodes[mesh.tetrahedra[where.tetrahedra]]
    np.testing.assert_allclose(np.einsum("pa,pax->px", where.weights, corners), points, atol=1e-12)
    beyond = np.maximum([-0.1, -0.05, 0.0] - points, points - [0.1, 0.05, 0.1]).clip(0.0)
    np.testing.assert_allclose(where.outside, np.linalg.norm(beyond, axis=1), atol=1e-12)
    assert (where.weights[where.outside == 0.0] >= -1e-9).all()


def test_points_made_inside_real_tetrahedra_are_found_in_them(shared_data):
    mesh, _ = read_mesh(shared_data / "meshes-sofa" / "raptorTetra_8418.vtu", 0.01)
    random = np.random.default_rng(2)
    which = random.integers(0, len(mesh.tetrahedra), 4000)
    weights = random.dirichlet([2.0] * 4, len(which))
    points = np.einsum("pa,pax->px", weights, mesh.nodes[mesh.tetrahedra[which]])
    where = locate(mesh, points)
    assert not where.outside.any()
    # This mesh does not overlap itself, so a point strictly inside is in one tetrahedron only.
    np.testing.assert_array_equal(where.tetrahedra, which)
    np.testing.assert_allclose(where.weights, weights, atol=1e-9)


def test_outside_an_organ_it_is_the_nearest_tetrahedron(shared_data):
    mesh, _ = read_mesh(shared_data / "meshes-sofa" / "liver2.msh", 0.01)
    a, b, c = np.moveaxis(mesh.nodes[mesh.boundary], 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    lifted = (a + b + c) / 3 + 1e-5 * normal
    where = locate(mesh, lifted)
    np.testing.assert_allclose(where.outside, 1e-5, rtol=1e-6)
    np.testing.assert_array_equal(where.tetrahedra, mesh.boundary_tetrahedra)


@pytest.mark.parametrize("points", [np.zeros((3, 2)), [[0.0, np.nan, 0.0]], np.zeros(3)])
def test_what_is_no_point_is_refused(points):
    with pytest.raises(MeshError, match="cannot be located"):
        locate(block_mesh((3, 3, 3)), points)
