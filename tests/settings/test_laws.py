"""Laws of all settings: written and read they are the same, in whatever unit, and as a copy."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

import us_sim.nodes.settings
import us_sim.volume.cases.settings  # noqa: F401 - their settings are some of all
from us_sim.settings import quantity as quantities
from us_sim.settings.quantity import Quantity


@pytest.mark.parametrize("dimension", quantities._UNITS)
@given(number=st.floats(-1e9, 1e9))
def test_a_number_is_the_same_in_si_and_in_each_unit(dimension, number):
    quantity = Quantity(dimension)
    assert quantity.parse(number) == quantity.parse(str(number)) == number
    assert quantity.parse(f"{number!r} {quantity.unit}") == number
    for unit, factor in quantities._UNITS[dimension].items():
        assert quantity.parse(f"{number / factor!r}{unit}") == pytest.approx(number, rel=1e-12)


@given(st.floats(-1e9, 1e9), st.floats(-1e9, 1e9), st.floats(-2e9, 2e9))
def test_exactly_the_numbers_of_a_range_are_taken(a, b, number):
    low, high = min(a, b), max(a, b)
    quantity = Quantity("length", low, high)
    if low <= number <= high:
        assert quantity.parse(number) == number
    else:
        with pytest.raises(ValueError, match="outside"):
            quantity.parse(number)
