"""The offset of two clocks: known shifts, error statistics, and refusals."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from us_sim.errors import CalibrationError
from us_sim.tracking.calibration.time_offset import (
    PositionSignal,
    find_time_offset,
)


def strokes(times):
    """m, uneven strokes of about a second, as a hand makes them."""
    return 0.01 * (np.sin(5.9 * times + np.sin(0.7 * times)) + 0.4 * np.sin(2.3 * times))


def recorded(rate, seconds, offset=0.0, noise=0.0, seed=0, start=0.0):
    rng = np.random.default_rng(seed)
    times = start + np.arange(0.0, seconds, 1.0 / rate)
    return PositionSignal(times + offset, strokes(times) + noise * rng.standard_normal(len(times)))


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(offset=st.floats(-0.4, 0.4), scale=st.sampled_from([-400.0, 0.3, 7.0]))
def test_a_shift_is_found_whatever_the_scale_and_direction(offset, scale):
    moving = recorded(50, 22, offset=-offset)
    clean = recorded(12, 20, start=1.0)
    fixed = PositionSignal(clean.times, scale * clean.values + 3.0)
    found = find_time_offset(moving, fixed)
    assert found.offset == pytest.approx(offset, abs=1e-4)
    assert np.sign(found.correlation) == np.sign(scale)
    assert find_time_offset(fixed, moving).offset == pytest.approx(-offset, abs=1e-4)


@pytest.mark.slow
def test_errors_are_as_large_as_the_deviation_says():
    errors, deviations = [], []
    for seed in range(40):
        moving = recorded(50, 22, offset=-0.07)
        fixed = recorded(12, 20, start=1.0, noise=2e-3, seed=seed)
        found = find_time_offset(moving, fixed)
        errors.append(found.offset - 0.07)
        deviations.append(found.deviation)
    # Forty errors scatter by 11 %, a jackknife of ten blocks by 24 % each.
    scatter = np.sqrt(np.mean(np.square(errors)))
    assert np.sqrt(np.mean(np.square(deviations))) == pytest.approx(scatter, rel=0.3)
    assert scatter < 3e-3


def test_what_lies_in_a_gap_is_not_made_up():
    moving = recorded(50, 22, offset=-0.07)
    seen = (moving.times < 6) | (moving.times > 8.3)
    found = find_time_offset(
        PositionSignal(moving.times[seen], moving.values[seen]), recorded(12, 20, start=1.0)
    )
    assert found.offset == pytest.approx(0.07, abs=1e-4)
    assert found.correlation > 0.9999


TENTHS, NOISE = np.arange(1, 21, 0.1), np.random.default_rng(0).standard_normal(200)


@pytest.mark.parametrize(
    ("moving", "fixed", "largest", "problem"),
    [
        (recorded(50, 0.5), recorded(12, 20), 0.5, "30 samples"),
        (recorded(50, 20), recorded(12, 20, start=19.0), 0.5, "overlap"),
        (recorded(50, 22, offset=0.4), recorded(12, 20, start=1.0), 0.2, "-0.40 s"),
        (recorded(50, 22), PositionSignal(TENTHS, np.zeros(200)), 0.5, "move"),
        (recorded(50, 22), PositionSignal(TENTHS, NOISE), 0.5, "alike"),
    ],
)
def test_recordings_that_cannot_tell_are_refused(moving, fixed, largest, problem):
    with pytest.raises(CalibrationError, match=problem):
        find_time_offset(moving, fixed, largest=largest)


def test_strokes_as_regular_as_a_pendulum_are_refused():
    times = np.arange(0, 30, 0.02)
    noise = 0.02 * np.random.default_rng(1).standard_normal((2, len(times)))
    pendulum = np.sin(2 * np.pi * 2.0 * times) + noise
    with pytest.raises(CalibrationError, match="so regular"):
        find_time_offset(PositionSignal(times, pendulum[0]), PositionSignal(times, pendulum[1]))
