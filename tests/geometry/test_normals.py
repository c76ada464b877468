"""Vertex normals in both precisions."""

import numpy as np
import pytest

from us_sim.geometry.triangles import vertex_normals


@pytest.fixture(params=[np.float32, np.float64])
def dtype(request):
    return request.param


def test_an_octahedron_s_normals_are_its_corners(dtype):
    corners = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
    triangles = np.array(
        [
            [x, 2 + y, 4 + z] if (x + y + z) % 2 == 0 else [x, 4 + z, 2 + y]
            for x in (0, 1)
            for y in (0, 1)
            for z in (0, 1)
        ]
    )
    normals = vertex_normals(corners.astype(dtype), triangles)
    assert normals.dtype == dtype
    np.testing.assert_array_equal(normals, corners)


def test_normals_are_weighted_by_area(dtype):
    """Two right triangles share a vertex: 0.5 m² facing z, and 2 m² facing x."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 2, 0], [0, 0, 2]], dtype=dtype)
    normals = vertex_normals(vertices, np.array([[0, 1, 2], [0, 3, 4]]))
    np.testing.assert_allclose(normals[0], np.array([4, 0, 1]) / np.sqrt(17), rtol=1e-6)


def test_normals_that_cancel_are_zero(dtype):
    vertices = np.eye(3, dtype=dtype)
    np.testing.assert_array_equal(vertex_normals(vertices, [[0, 1, 2], [0, 2, 1]]), 0)
