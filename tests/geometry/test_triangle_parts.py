"""Triangles in parts: how many there are, and where their middles are."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from us_sim.geometry.triangles import TriangleParts, part_size


def test_parts_are_as_large_as_the_rounding_between_the_spacing_and_a_quarter_of_it():
    assert part_size(0.004, 0.01) == pytest.approx(0.004)
    assert part_size(0.05, 0.01) == pytest.approx(0.01)
    assert part_size(1e-5, 0.01) == pytest.approx(0.0025)


def test_no_triangle_has_no_parts():
    parts = TriangleParts(np.zeros(0), 1.0)
    assert parts.weights.shape == (0, 3)
    assert parts.first.tolist() == [0]


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
