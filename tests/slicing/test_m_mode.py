"""M-mode, and moving pictures that have every moment once."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from us_sim.slicing.m_mode import MMode, SweepPicture
from us_sim.slicing.probe.probe import LinearProbe
from us_sim.slicing.settings import MModeSettings

PROBE = LinearProbe(aperture=0.04, depth=0.03, columns=80, rows=60)
COLUMNS, ROWS, SWEEP = 512, 384, 4.0


def test_a_wall_that_moves_is_where_it_was_at_each_moment():
    """One bright row, whose depth is a sine of a second: columns show it with the frames' steps."""
    m_mode = MMode(PROBE, MModeSettings(lateral=0.1, sweep=SWEEP))
    rate, image = 32.0, np.zeros((60, 80), np.uint8)
    for k in range(int(SWEEP * rate) + 1):
        row = 30 + round(20 * np.sin(2 * np.pi * k / rate))
        image[:] = 0
        image[row] = 250
        picture = m_mode.draw_sweep(image, 100.0 + k / rate)
    grey = picture[:ROWS, :COLUMNS, 0]
    brightest = (grey.argmax(axis=0) + 0.5) / ROWS * 60 - 0.5
    times = (np.arange(COLUMNS) - (COLUMNS - 1)) * SWEEP / COLUMNS
    frame = np.ceil(times * rate - 1e-6) / rate  # what a column shows came after it
    expected = 30 + np.rint(20 * np.sin(2 * np.pi * frame))
    assert brightest[4:] == pytest.approx(expected[4:], abs=0.6)


def picture(rows=32, columns=100, sweep=2.0):
    return SweepPicture(rows, columns, sweep, (1.0, -1.0, "m"))


@given(st.lists(st.floats(0.0, 0.7), min_size=1, max_size=20), st.integers(0, 2 * 10**9))
def test_moments_follow_each_other_evenly_and_none_is_there_twice(steps, start):
    made = picture()
    asked = start + np.concatenate([[0.0], np.cumsum(steps)])
    moments = np.concatenate([made.advance_to(time) for time in asked])
    assert np.diff(moments) == pytest.approx(0.02, abs=1e-6)
    assert moments[-1] <= asked[-1] + 1e-6
    assert moments[-1] > asked[-1] - 0.02 - 1e-6


def test_it_begins_anew_when_time_goes_back_or_stops_for_long():
    made = picture()
    made.append_columns(np.full((32, len(made.advance_to(10.0))), 255, np.uint8))
    assert made.grey[:, -1].all()
    assert len(made.advance_to(5.0)) == 1
    assert not made.grey.any()
    made.append_columns(np.full((32, 1), 255, np.uint8))
    assert len(made.advance_to(60.0)) == 1
    assert not made.grey.any()
