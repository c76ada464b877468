"""Numbers with units.

Numbers for a person: in a handy unit, and read back as the number they are.
"""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from us_sim.settings.quantity import Quantity, format_quantity


@pytest.mark.parametrize(
    ("dimension", "text", "si"),
    [
        ("length", "40 mm", 0.04),
        ("length", "-1.5e1 um", -15e-6),
        ("pressure", "12 kPa", 12e3),
        ("angle", "180 deg", math.pi),
        ("density", "1.06 g/cm3", 1060.0),
    ],
)
def test_units(dimension, text, si):
    assert Quantity(dimension).parse(text) == pytest.approx(si)


@pytest.mark.parametrize("text", ["40 parsec", "mm", "", "1 2 mm", None, [1], True, "40 Pa"])
def test_what_is_no_length(text):
    with pytest.raises(ValueError, match="length"):
        Quantity("length").parse(text)


@pytest.mark.parametrize("number", [math.nan, math.inf, 10**400, -(10**400), "1e999"])
def test_what_is_not_finite(number):
    with pytest.raises(ValueError, match="finite"):
        Quantity("length").parse(number)


@given(
    st.sampled_from(["length", "pressure", "time", "angle", "stiffness", "number", "density"]),
    st.floats(-1e13, 1e13, allow_subnormal=False),
)
def test_what_is_written_is_read_back(dimension, value):
    back = Quantity(dimension).parse(format_quantity(value, dimension))
    assert math.isclose(back, value, rel_tol=1e-12)


@pytest.mark.parametrize(
    ("value", "dimension", "text"),
    [
        (0.04, "length", "40 mm"),
        (1e-9, "length", "0.001 um"),
        (1e7, "pressure", "10 MPa"),
        (0.999999, "number", "0.999999"),
    ],
)
def test_the_unit_is_the_one_that_people_use(value, dimension, text):
    assert format_quantity(value, dimension) == text
