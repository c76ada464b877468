"""Fields of forces against products of matrices."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.tissue.linear_algebra.compliance import DenseFields


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 150), st.sampled_from([np.float32, np.float64]))
def test_a_sum_is_the_product_with_the_forces(seed, surface, precision):
    random = np.random.default_rng(seed)
    exact = random.normal(size=(40, 3, 3 * surface))
    nodes = random.permutation(40)[:33]
    made = DenseFields.compute_at(
        nodes,
        surface,
        lambda chosen: exact.reshape(40, 3, -1, 3)[:, :, chosen].reshape(40, 3, -1),
        precision,
    )
    forces = random.normal(size=3 * surface) * (random.random(3 * surface) < 0.5)
    displacement = np.ones((40, 3))
    made.add_displacement(forces, displacement)
    expected = np.ones((40, 3))
    expected[nodes] += exact[nodes] @ forces
    np.testing.assert_allclose(displacement, expected, atol=1e-4)
