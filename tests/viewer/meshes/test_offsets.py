"""Positions as steps: no farther from the truth than half a step, which is said."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from us_sim.viewer.surfaces import FINEST, Offsets

quick = settings(max_examples=50, deadline=None)
points = arrays(np.float64, (7, 3), elements=st.floats(-0.3, 0.3))


@quick
@given(points, points)
def test_what_the_page_has_is_half_a_step_from_the_truth(rest, positions):
    offsets = Offsets.between(positions, rest)
    error = np.abs(offsets.positions(rest) - positions).max()
    assert error <= 0.5 * offsets.resolution * (1 + 1e-9) + 1e-12
    assert offsets.steps.dtype == np.int16


@quick
@given(st.floats(0.0, 2.0))
def test_steps_are_as_fine_as_the_farthest_point_allows(farthest):
    offsets = Offsets.between(np.array([[farthest, 0.0, 0.0]]), np.zeros((1, 3)))
    assert offsets.resolution == FINEST or farthest / (offsets.resolution - FINEST) > 32766
