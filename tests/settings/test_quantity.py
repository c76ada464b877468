"""Numbers with units."""

import math

import pytest

from us_sim.settings.quantity import Quantity


@pytest.mark.parametrize(
    ("dimension", "text", "si"),
    [
        ("length", "40 mm", 0.04),
        ("length", "4cm", 0.04),
        ("length", 0.04, 0.04),
        ("length", "-1.5e1 um", -15e-6),
        ("pressure", "12 kPa", 12e3),
        ("angle", "180 deg", math.pi),
        ("density", "1.06 g/cm3", 1060.0),
        ("number", 3, 3.0),
        ("time", "5 ms", 5e-3),
    ],
)
def test_units(dimension, text, si):
    assert Quantity(dimension).parse(text) == pytest.approx(si)


@pytest.mark.parametrize("text", ["40 parsec", "mm", "", "1 2 mm", None, [1], True, "40 Pa"])
def test_what_is_no_length(text):
    with pytest.raises(ValueError, match="is not a length"):
        Quantity("length").parse(text)


@pytest.mark.parametrize("number", [math.nan, math.inf, 10**400, -(10**400), "1e999"])
def test_what_is_not_finite(number):
    with pytest.raises(ValueError, match="is not finite"):
        Quantity("length").parse(number)
