"""Vertex normals in both precisions, and the middles of triangles' parts."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from us_sim.geometry.triangles import TriangleParts, compute_vertex_normals


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
    normals = compute_vertex_normals(corners.astype(dtype), triangles)
    assert normals.dtype == dtype
    np.testing.assert_array_equal(normals, corners)


def test_normals_are_weighted_by_area(dtype):
    """Two right triangles share a vertex: 0.5 m² facing z, and 2 m² facing x."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 2, 0], [0, 0, 2]], dtype=dtype)
    normals = compute_vertex_normals(vertices, np.array([[0, 1, 2], [0, 3, 4]]))
    np.testing.assert_allclose(normals[0], np.array([4, 0, 1]) / np.sqrt(17), rtol=1e-6)


@given(st.lists(st.floats(1e-3, 7.9), min_size=1, max_size=6))
def test_middles_are_those_of_equal_parts_of_each_triangle(longest):
    parts = TriangleParts(np.array(longest), 1.0)
    counts = np.diff(parts.first)
    np.testing.assert_array_equal(counts, np.ceil(np.array(longest) - 1e-9) ** 2)
    np.testing.assert_array_equal(parts.triangle, np.repeat(np.arange(len(longest)), counts))
    np.testing.assert_allclose(parts.weights.sum(axis=1), 1.0)
    assert parts.weights.min() > 0.0
    for one, end in zip(parts.first, parts.first[1:], strict=False):
        middles = parts.weights[one:end]
        np.testing.assert_allclose(middles.mean(axis=0), 1 / 3)
        # Of n parts a side, middles are thirds of an n-th apart.
        thirds = 3 * np.sqrt(len(middles)) * middles
        np.testing.assert_allclose(thirds, thirds.round(), atol=1e-9)
        assert len(np.unique(thirds.round(), axis=0)) == len(middles)
