"""A moving picture has every moment once, however frames come."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from us_sim.slicing.drawing.sweep_picture import SweepPicture


def picture(rows=32, columns=100, sweep=2.0):
    return SweepPicture(rows, columns, sweep, (1.0, -1.0, "m"))


@given(st.lists(st.floats(0.0, 0.7), min_size=1, max_size=20), st.integers(0, 2 * 10**9))
def test_moments_follow_each_other_evenly_and_none_is_there_twice(steps, start):
    made = picture()
    asked = start + np.concatenate([[0.0], np.cumsum(steps)])
    moments = np.concatenate([made.moments(time) for time in asked])
    assert np.diff(moments) == pytest.approx(0.02, abs=1e-6)
    assert moments[-1] <= asked[-1] + 1e-6
    assert moments[-1] > asked[-1] - 0.02 - 1e-6


def test_it_begins_anew_when_time_goes_back_or_stops_for_long():
    made = picture()
    made.add(np.full((32, len(made.moments(10.0))), 255, np.uint8))
    assert made.grey[:, -1].all()
    assert len(made.moments(5.0)) == 1
    assert not made.grey.any()
    made.add(np.full((32, 1), 255, np.uint8))
    assert len(made.moments(60.0)) == 1
    assert not made.grey.any()


def test_the_zero_of_its_scale_is_a_line_across():
    drawn = picture(rows=64).drawn()
    lit = np.flatnonzero((drawn[:64, :100] > 0).all(axis=(1, 2)))
    assert lit.tolist() == [32]
