"""What a slider covers: the value always, the range where it can, by factors where that is wide."""

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from us_sim.viewer.panels.controls import slider_span


@pytest.mark.parametrize(
    ("low", "high", "value", "is_whole", "covered"),
    [
        (-60.0, 60.0, 6.0, False, (-60.0, 60.0, 0.2, False)),  # gain, dB
        (5.0, 400.0, 40.0, False, (5.0, 400.0, 0.0, True)),  # depth, mm
        (10.0, 120.0, 60.0, False, (10.0, 120.0, 0.2, False)),  # dynamic range, dB
        (1e-6, 1e10, 12.0, False, (0.12, 1200.0, 0.0, True)),  # Young's modulus, kPa
        (0.0, 1e5, 20.0, False, (0.0, 100.0, 0.2, False)),  # a coefficient of a filter
        (0.0, 400.0, None, False, (0.0, 400.0, 1.0, False)),  # focus, mm, not given
        (1, 10_000, 20, True, (1, 100, 1.0, False)),  # iterations
        (1, 15, 1, True, (1, 15, 1.0, False)),  # planes
    ],
)
def test_sliders_cover_what_a_person_would_turn_through(low, high, value, is_whole, covered):
    span = slider_span(low, high, value, is_whole)
    assert (span.low, span.high, span.step, span.is_logarithmic) == pytest.approx(covered)


def test_there_is_no_slider_without_a_range():
    assert slider_span(0.0, float("inf"), 1.0) is None
    assert slider_span(3.0, 3.0, 3.0) is None
    assert slider_span(0.0, 5e-324, 5e-324) is None


@settings(deadline=None)  # the first call may come while the machine is busy
@example(-5e-324, 1.0, 0.0, False)
@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e7), st.floats(0.0, 1.0), st.booleans())
def test_the_value_is_on_the_slider_and_the_slider_within_the_range(low, width, place, is_whole):
    high = low + width
    value = min(max(low + place * width, low), high)
    span = slider_span(low, high, round(value) if is_whole else value, is_whole)
    assert low <= span.low < span.high <= high
    assert is_whole or span.holds(value)
    assert span.holds(None)
    assert span.is_logarithmic or span.step > 0.0
